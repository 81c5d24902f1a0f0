"""The core needs no ROS installation."""

from __future__ import annotations

import subprocess
import sys

from places import CHECKOUT

IMPORT_ALL = """
import importlib, importlib.abc, importlib.util, pkgutil, sys

GRAPH = (
    "greenroof_ros.nodes", "greenroof_ros.graph", "greenroof_ros.live",
    "greenroof_ros.bringup.composition", "greenroof_ros.commands.checks",
)
if importlib.util.find_spec("gymnasium") is None:
    GRAPH += ("greenroof_ros.analysis.api.gym",)
ROS = {
    "rclpy", "rcl_interfaces", "std_msgs", "std_srvs", "rosgraph_msgs", "diagnostic_msgs",
    "builtin_interfaces", "ament_index_python", "launch", "rosbag2_py",
}
asked = []


class NoRos(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ROS:
            asked.append(name)
            raise ModuleNotFoundError("no ROS here: " + name)


def modules(package):
    for module in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
        if module.name in GRAPH:
            continue
        yield module.name
        imported = importlib.import_module(module.name)
        if module.ispkg:
            yield from modules(imported)


sys.meta_path.insert(0, NoRos())
try:
    import rclpy
except ModuleNotFoundError:
    assert asked.pop() == "rclpy"
else:
    raise AssertionError("ROS was not hidden")
import greenroof_ros
import greenroof_ros.live.devices, greenroof_ros.live.pumping, greenroof_ros.live.simulators
live = (getattr(greenroof_ros.live, part) for part in ("devices", "pumping", "simulators"))
print(*(name for package in (greenroof_ros, *live) for name in modules(package)), sep="\\n")
assert not asked, f"the core asks for {asked}"
"""


def test_every_module_but_the_graphs_imports_without_ros() -> None:
    """All modules, including new ones, are imported in a process that finds no ROS."""
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    imported = set(done.stdout.split())
    rooms = {path.name for path in (CHECKOUT / "greenroof_ros").iterdir() if path.is_dir()}
    rooms -= {"graph", "nodes", "live", "__pycache__"}
    assert rooms >= {"common", "model", "controllers", "experiment", "analysis", "commands"}
    assert {f"greenroof_ros.{name}" for name in rooms} <= imported
    assert "greenroof_ros.live.devices.exchange" in imported
