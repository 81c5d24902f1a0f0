"""A controller that is someone else's node, in a run: the example, and one in C."""

from __future__ import annotations

import re
import shutil
import subprocess
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from checked_nodes import changed, start_node
from graphs import Process, bag_file, bring_up, environment, summary_of
from places import CHECKOUT

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

import rclpy

# On a starved machine its command may be 3 s late; the flow would then be 0, in one of the bags.
DRIVER = (CHECKOUT / "examples" / "pump_driver.py").read_text().replace(
    "SILENCE = 3.0", "SILENCE = 300.0"
)
EXAMPLE = (CHECKOUT / "examples" / "controller_node.py").read_text()
CLASS = "examples.proportional:Proportional"
@contextmanager
def ending(process: subprocess.Popen[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    """End a node that a failed test leaves."""
    try:
        yield process
    finally:
        process.kill()
        process.wait(60)


@contextmanager
def driver(domain: int, directory: Path, pump: str) -> Iterator[None]:
    """Run the example's pump driver, which must end with the run, if the pump is external."""
    if pump == "internal":
        yield
        return
    with ending(start_node(domain, directory, "pump_driver", DRIVER)) as process:
        yield
        assert process.wait(60) == 0


def bags_outside_and_inside(
    domain: int, directory: Path, controller: subprocess.Popen[bytes], pump: str = "internal"
) -> list[bytes]:
    """Run a graph with an external controller, then with the same one inside; return the bags."""
    options = ("--hours", "0.1", "--pump", pump)
    with ending(controller), driver(domain, directory, pump):
        outside = bring_up(
            domain, directory, "--controller", "external", *options, output="outside"
        )
        assert controller.wait(60) == 0
    with driver(domain, directory, pump):
        inside = bring_up(domain, directory, "--controller", CLASS, *options, output="inside")
    assert outside["total_deviation_m3"] == inside["total_deviation_m3"]
    assert outside["max_command"] > 0
    return [bag_file(directory / run).read_bytes() for run in ("outside", "inside")]


@pytest.mark.parametrize("pump", ["internal", "external"])
def test_it_gives_the_bag_of_the_same_controller_inside(
    domain: int, tmp_path: Path, pump: str
) -> None:
    """Equal in every byte, though it is another process; the example needs only rclpy."""
    assert "greenroof_ros" not in EXAMPLE and len(EXAMPLE.splitlines()) <= 60
    controller = start_node(domain, tmp_path, "controller_node", EXAMPLE)
    outside, inside = bags_outside_and_inside(domain, tmp_path, controller, pump)
    assert outside == inside


def test_a_node_that_breaks_a_rule_ends_the_run(domain: int, tmp_path: Path) -> None:
    """It commands twice in a tick: its topic and name, exit code 1, and a closed bag."""
    publish = "publisher.publish(Float64(data=command()))"
    # Without its own check, which may be faster than the plant's.
    source = changed(EXAMPLE, "if topic in tick:", "if False:")
    source = changed(source, publish, f"{publish}, {publish}")
    with ending(start_node(domain, tmp_path, "controller_node", source)):
        process = Process(
            domain, "bringup", "--controller", "external", "--hours", "0.1", "--output", "run",
            cwd=tmp_path,
        )
        assert process.wait(120) == 1
    summary = summary_of(tmp_path / "run")
    assert re.search(r"/pump/command has a second message in tick \d+ \(contr", summary["reason"])
    assert summary["reason"] in process.stderr() and "Traceback" not in process.stderr()
    assert summary["status"] == "failed" and (tmp_path / "run/bag/metadata.yaml").exists()


def test_a_node_in_c_gives_the_same_bag_and_passes_the_check(domain: int, tmp_path: Path) -> None:
    program = build_with_rcl(Path(__file__).with_name("controller_node.c"), tmp_path)
    environ = environment(domain)
    controller = subprocess.Popen([program], cwd=tmp_path, env=environ)
    outside, inside = bags_outside_and_inside(domain, tmp_path, controller)
    assert outside == inside
    arguments = "--ros-args", "-r", "__ns:=/site1"
    with ending(subprocess.Popen([program, *arguments], cwd=tmp_path, env=environ)) as controller:
        check = Process(domain, "check_controller", "--node", "/site1/controller", cwd=tmp_path)
        assert check.wait(120) == 0, check.stdout()
        assert controller.wait(60) == 0


def build_with_rcl(source: Path, directory: Path) -> Path:
    """Compile and link a C program that needs rcl, ROS 2's client library in C."""
    prefix, compiler = Path(rclpy.__file__).parents[4], shutil.which("cc")
    if compiler is None or not (prefix / "include" / "rcl").is_dir():
        pytest.skip("needs a C compiler and the headers of rcl")
    program = directory / source.stem
    libraries = (
        "rcl", "rcutils", "rmw", "rosidl_runtime_c", "std_msgs__rosidl_generator_c",
        "std_msgs__rosidl_typesupport_c",
    )
    python = sysconfig.get_config_vars("LIBDIR", "LDVERSION")
    subprocess.run(
        [
            compiler, "-std=gnu11", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off",
            *(f"-I{path}" for path in (prefix / "include").iterdir()),
            source, "-o", program, f"-L{prefix / 'lib'}", "-Wl,--allow-shlib-undefined",
            *(f"-l{name}" for name in libraries), "-lm",
            # Some of ROS 2's wheels need symbols of Python's.
            "-Wl,--no-as-needed", f"-L{python[0]}", f"-Wl,-rpath,{python[0]}",
            f"-lpython{python[1]}",
        ],
        check=True,
    )
    return program
