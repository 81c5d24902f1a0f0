"""The core needs no ROS installation."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest
from places import CHECKOUT

IMPORT_ALL = r"""
import importlib, importlib.util, pkgutil, re, sys
import greenroof_ros

for name in ("rclpy", "rcl_interfaces", "std_msgs", "std_srvs", "rosgraph_msgs", "diagnostic_msgs",
             "builtin_interfaces", "ament_index_python", "launch", "rosbag2_py"):
    sys.modules[name] = None  # its import fails
graph = r"(nodes|ros|model|common|bringup\.composition)\b"  # see below
graph += r"|live\.(?!devices|pumping|simulators)"
if importlib.util.find_spec("gymnasium") is None:
    graph += r"|gym|analysis\.api\.(gym|vector)\b"
for module in pkgutil.walk_packages(greenroof_ros.__path__, "greenroof_ros."):
    if not re.match(rf"greenroof_ros\.({graph})", module.name):
        importlib.import_module(module.name)
        print(module.name)
"""


def test_every_module_but_the_graphs_imports_without_ros() -> None:
    """All modules, including new ones, are imported in a process that finds no ROS."""
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    imported = set(done.stdout.split())
    rooms = {path.name for path in (CHECKOUT / "greenroof_ros").iterdir() if path.is_dir()}
    rooms -= {"ros", "nodes", "__pycache__"}
    assert rooms >= {"base", "physics", "controllers", "simulation", "analysis", "commands"}
    assert {f"greenroof_ros.{name}" for name in rooms} <= imported
    assert "greenroof_ros.live.devices.exchange" in imported


def test_a_former_place_names_the_present_one() -> None:
    """Tutorials and examples had this import."""
    with pytest.raises(ImportError, match=r"^greenroof_ros\.model\.site is now (.*)$") as error:
        importlib.import_module("greenroof_ros.model.site")
    assert hasattr(importlib.import_module(str(error.value).split()[-1]), "Site")
