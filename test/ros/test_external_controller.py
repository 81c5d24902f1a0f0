"""A controller that is someone else's node, in a run: the example, and one in C."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from checked_nodes import changed, start_node
from graphs import Process, bag_file, bring_up, environment, messages_of, summary_of
from paper import VALVE, site_file
from places import CHECKOUT

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

import rclpy

# On a starved machine its command may be 3 s late; the flow would then be 0, in one of the bags.
DRIVER = (CHECKOUT / "examples" / "pump_driver.py").read_text().replace(
    "SILENCE = 3.0", "SILENCE = 300.0"
)
EXAMPLE = (CHECKOUT / "examples" / "controller_node.py").read_text()
CLASS = "examples.proportional:Proportional"
# The example decides so if it commands a valve.
WITH_VALVE = """
from examples.proportional import Proportional

class WithValve(Proportional):
    outlet = 0.0

    def command(self, cistern_level, *inputs):
        self.outlet = 1.0 if cistern_level > 2.0 else 0.0
        return super().command(cistern_level, *inputs)
"""
VALVE_ARGUMENTS = "--ros-args", "-p", "valve:=true"


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


def valve_site(directory: Path) -> tuple[str, ...]:
    """Return the options of a site with a valve, from a level above which the example opens it."""
    return "--site", str(site_file(directory, **VALVE)), "--cistern", "50.02", "--roof", "2"


def bags_outside_and_inside(
    domain: int, directory: Path, controller: subprocess.Popen[bytes], pump: str = "internal",
    valve: bool = False,
) -> list[bytes]:
    """Run a graph with an external controller, then with the same one inside; return the bags."""
    options = ("--hours", "0.1", "--pump", pump, *(valve_site(directory) if valve else ()))
    (directory / "with_valve.py").write_text(WITH_VALVE)
    inner = "with_valve:WithValve" if valve else CLASS
    with ending(controller), driver(domain, directory, pump):
        outside = bring_up(
            domain, directory, "--controller", "external", *options, output="outside"
        )
        assert controller.wait(60) == 0
    with driver(domain, directory, pump):
        inside = bring_up(domain, directory, "--controller", inner, *options, output="inside")
    assert outside["total_deviation_m3"] == inside["total_deviation_m3"]
    assert outside["max_command"] > 0 and (outside["outflow_m3"] > 0) == valve
    return [bag_file(directory / run).read_bytes() for run in ("outside", "inside")]


@pytest.mark.parametrize(("pump", "valve"), [("internal", True), ("external", False)])
def test_it_gives_the_bag_of_the_same_controller_inside(
    domain: int, tmp_path: Path, pump: str, valve: bool
) -> None:
    """Equal in every byte, though it is another process; the example needs only rclpy."""
    assert "greenroof_ros" not in EXAMPLE and len(EXAMPLE.splitlines()) <= 72
    arguments = VALVE_ARGUMENTS if valve else ()
    controller = start_node(domain, tmp_path, "controller_node", EXAMPLE, *arguments)
    outside, inside = bags_outside_and_inside(domain, tmp_path, controller, pump, valve)
    assert outside == inside


PUBLISHED = "publisher.publish(Float64(data=command()))"
OPENED = "valve.publish(Float64(data=opening()))"
BAD = "{4: math.nan, 5: -0.1, 6: -math.inf, 7: math.inf, 8: 1e-9}"


def test_bad_commands_act_as_zero(domain: int, tmp_path: Path) -> None:
    """To the pump and to the valve: they are counted, never become a flow, and the run goes on."""
    wrong = f"(ticks.append(0), {BAD}.get(len(ticks) - 1, 1.0))[1]"
    source = changed(EXAMPLE, PUBLISHED, PUBLISHED.replace("command()", wrong))
    source = changed(source, OPENED, OPENED.replace("opening()", f"{BAD}.get(len(ticks) - 1, 1.0)"))
    source = changed(source, "tick = {}", "ticks, tick = [], {}")
    with ending(start_node(domain, tmp_path, "controller_node", source, *VALVE_ARGUMENTS)):
        summary = bring_up(
            domain, tmp_path, "--controller", "external", *valve_site(tmp_path), "--hours", "0.01"
        )
    assert summary["refused"] == {"/pump/command": 4, "/outlet/command": 4}
    for topic in ("/pump/flow", "/outlet/flow"):
        messages = messages_of(tmp_path / "run")[topic]
        flows = [struct.unpack("<d", message[4:12])[0] for message in messages]
        assert flows[4:8] == [0.0] * 4 and min(flows[:4] + flows[8:]) > 0, topic


@pytest.mark.parametrize(("changes", "arguments", "words"), [
    # Without its own check, which may be faster than the plant's.
    ({"if topic in tick:": "if False:", OPENED: f"{OPENED}, {OPENED}"}, VALVE_ARGUMENTS,
     r"/outlet/command has a second message in tick \d+ \(contr"),
    ({}, (), r"the run did not start within 30 s: /outlet/command from controller$"),
])
def test_a_node_that_breaks_a_rule_ends_the_run(
    domain: int, tmp_path: Path, changes: dict[str, str], arguments: tuple[str, ...], words: str
) -> None:
    """With the topic and its name, exit code 1, and a closed bag."""
    source = EXAMPLE
    for old, new in changes.items():
        source = changed(source, old, new)
    with ending(start_node(domain, tmp_path, "controller_node", source, *arguments)):
        process = Process(
            domain, "bringup", "--controller", "external", *valve_site(tmp_path), "--output", "run",
            cwd=tmp_path,
        )
        assert process.wait(120) == 1, process.stderr()
    summary = summary_of(tmp_path / "run")
    assert summary["status"] == "failed" and re.search(words, summary["reason"])
    assert summary["reason"] in process.stderr() and "Traceback" not in process.stderr()
    assert (tmp_path / "run/bag/metadata.yaml").exists()


def test_a_node_in_c_gives_the_same_bag_and_passes_the_check(domain: int, tmp_path: Path) -> None:
    program = build_with_rcl(Path(__file__).with_name("controller_node.c"), tmp_path)
    environ = environment(domain)
    controller = subprocess.Popen([program, "--valve"], cwd=tmp_path, env=environ)
    outside, inside = bags_outside_and_inside(domain, tmp_path, controller, valve=True)
    assert outside == inside
    arguments = "--valve", "--ros-args", "-r", "__ns:=/site1"
    site = valve_site(tmp_path)[:2]
    with ending(subprocess.Popen([program, *arguments], cwd=tmp_path, env=environ)) as controller:
        check = Process(
            domain, "check_controller", "--node", "/site1/controller", *site, cwd=tmp_path
        )
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
