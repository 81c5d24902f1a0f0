"""What bringup refuses on a command line, and what it reports on a drive and on its own errors."""

from __future__ import annotations

import os
import re
import sys
from contextlib import closing
from pathlib import Path

import pytest
from commands import run_command
from graphs import environment
from modbus_wire import Wire, acs880
from paper import VALVE, site_file
from places import CHECKOUT
from refusals import refusal

from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.live.devices.exchange import acquire_drive_lock, read_endpoint
from greenroof_ros.live.live_site import LiveSite, make_stopper
from greenroof_ros.live.live_site import make_parser as live_site_parser
from greenroof_ros.ros.domain import lock_bringup
from greenroof_ros.ros.parameters import node_parameter_files

EXTERNAL = ("--sensors", "external", "--pump", "external", "--weather", "external")
# A live site with a weather node, and the rest external; and a drive.
WEATHERED = "--controller mpc --sensors external --pump external"
DRIVE = "--drive abb_acs880 --drive-at tcp://127.0.0.1:1"
NO_VALVE = "parameter of the valve of the low outlet, which this site does not have"
WRONG = {
    "--weather external --pump external": "--sensors: is missing; what nodes of your own",
    f"{WEATHERED}": "--forecast, or a controller without a forecast, such as onoff: is missing",
    f"{' '.join(EXTERNAL)} --controller onoff --outlet drain": NO_VALVE,
    # Only one program can open a serial line, so the sensor or the drive would never answer.
    "--weather external --sensors serial.yaml --drive danfoss_fc202 --drive-at /dev/ttyS0,1":
        "--drive-at = '/dev/ttyS0,1': is also the serial line of a sensor",
    f"{' '.join(EXTERNAL)} --site site.yaml":
        "--valve, and --valve-at: is missing",
}


@pytest.mark.parametrize("words", WRONG)
def test_what_is_wrong_is_reported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    site_file(tmp_path, **VALVE)
    sensors = (CHECKOUT / "config" / "sensors.yaml").read_text()
    Path("serial.yaml").write_text(sensors.replace("tcp://127.0.0.1:5031", "/dev/ttyS0"))
    monkeypatch.setattr(sys, "argv", ["live", *words.split()])
    assert WRONG[words] in refusal(lambda: LiveSite(live_site_parser().parse_args()))


def test_a_valve_below_the_frost_line_needs_no_temperature(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Above it, a thermometer or a forecast is asked for, as for a pump."""
    monkeypatch.chdir(tmp_path)
    sensors = (CHECKOUT / "config" / "sensors_mqtt.yaml").read_text()
    sections = {text.partition(":")[0]: text for text in re.split(r"\n\n(?=\w)", sensors)}
    Path("sensors.yaml").write_text("\n".join(map(sections.get, ("cistern", "rain_gauge"))))
    words = "--sensors sensors.yaml --valve tasmota --valve-at mqtt://127.0.0.1/valve"
    monkeypatch.setattr(sys, "argv", ["live", *words.split(), "--site", "site.yaml"])
    for closed in (True, False):
        site_file(tmp_path, **VALVE, irrigation="none", valve_closed_in_frost=closed)
        arguments = live_site_parser().parse_args()
        if closed:
            assert refusal(LiveSite, arguments).startswith("--forecast, or a thermometer")
        else:
            assert "pump" not in LiveSite(arguments).nodes


def test_a_valve_that_may_stay_open_needs_the_switches_of_external_nodes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """One that closes without power does not."""
    monkeypatch.chdir(tmp_path)
    words = "--valve tasmota --valve-at mqtt://127.0.0.1/valve --controller onoff --site site.yaml"
    monkeypatch.setattr(sys, "argv", ["live", *words.split(), *EXTERNAL])
    for without_power in ("closes", "may_stay_open"):
        site_file(tmp_path, **VALVE, valve_without_power=without_power)
        _, parameters = LiveSite(live_site_parser().parse_args()).nodes["valve"]
        assert parameters["has_switches"] == (without_power == "may_stay_open")


# --- a file of parameters -------------------------------------------------------------------------

MODULES = {
    name: f"greenroof_ros.live.{module}" for name, module in {
        "weather": "weather", "onoff": "controller", "pump": "pump", "recorder": "recorder",
    }.items()
}
# By its section and parameters: what is refused, beginning with its line.
NO_EFFECT = {
    # Only bringup sets the drive: otherwise the node could run one drive, and bringup stop another.
    ("/**/pump", "drive: my_drive"): "line 3: /**/pump: drive = 'my_drive': must not be set",
    ("/pump", "min_off: 1.0"): "line 1: /pump: applies to no node that bringup starts: /site1/",
    ("/**/pump", "max_volume_per_dai: 0.5"): "line 3: /**/pump: max_volume_per_dai = 0.5: there is "
        "no such parameter; did you mean max_volume_per_day?",
}


@pytest.mark.parametrize(("section", "parameter"), NO_EFFECT)
def test_a_parameter_that_would_have_no_effect(
    tmp_path: Path, section: str, parameter: str
) -> None:
    """rclpy accepts a mistyped limit without a warning."""
    pytest.importorskip("rclpy")
    file = tmp_path / "nodes.yaml"
    options = ["--namespace", "site1", "--node-parameters", str(file)]
    read = (
        node_parameter_files, live_site_parser().parse_args(options), MODULES,
        find_controller("onoff"), {"fraction": 0.9},
    )
    refusal(*read, match="must be an existing file")
    file.write_text("/**:\n  ros__parameters: {recovery_time: 1}\n")
    assert node_parameter_files(*read[1:]) == [file]
    file.write_text(f"{section}:\n  ros__parameters:\n    {parameter}\n")
    assert refusal(*read).startswith(f"{file}, {NO_EFFECT[section, parameter]}")


# --- before and after the nodes -------------------------------------------------------------------


def test_a_drive_of_another_program_is_left_to_it() -> None:
    """As at the end of a second bringup that was started with the same drive by mistake."""
    with closing(Wire(acs880())) as wire:
        drive = read_endpoint(find_drive_file("abb_acs880"), wire.gateway, "at")
        driver, stop = acquire_drive_lock(drive), make_stopper(drive)
        may_run, message = stop(1, True)
        assert may_run and message.startswith(f"another program (process {os.getpid()}) controls")
        assert wire.connections == 0
        message = "bringup commanded the drive to stop; the drive then reported: speed 0.0%"
        assert not stop(os.getpid(), True)[0] and stop(os.getpid(), True)[1].startswith(message)
        driver.close()
        assert not stop(1, True)[0] and stop(1, True)[1].startswith(message)


def test_only_a_drive_that_was_reached_may_run_on() -> None:
    """Its own timeout stops what was left on before; a cable that was never there warns no one."""
    drive = read_endpoint(find_drive_file("abb_acs880"), "tcp://127.0.0.1:9", "at")
    for reached in (False, True):
        may_run, message = make_stopper(drive)(1, reached)
        assert (may_run, "THE PUMP MAY BE RUNNING" in message) == (reached, reached)


@pytest.mark.parametrize(("pump", "options"), [("pump", DRIVE), ("pump_guard", "--pump external")])
def test_a_command_each_tick_is_never_too_old(tmp_path: Path, pump: str, options: str) -> None:
    """What a node would refuse is refused before anything starts, with what would be right."""
    pytest.importorskip("rclpy")
    file = tmp_path / "nodes.yaml"
    file.write_text(f"/**/{pump}:\n  ros__parameters: {{command_limit: 6.0}}\n")
    done = run_command(
        "bringup.live", "--sensors", "external", "--weather", "external", *options.split(),
        "--site", str(site_file(tmp_path, tau=60.0)), "--node-parameters", "nodes.yaml",
        cwd=tmp_path, env=environment(0),
    )
    assert done.returncode == 2 and not (tmp_path / "live").exists()
    wrong = f"parameter command_limit of {pump} = 6.0: must exceed tau of the site, 60 s"
    assert f"error: {wrong}" in done.stderr


def test_a_directory_in_use(tmp_path: Path) -> None:
    """Two bringups must not write into one directory; with another domain they would not notice."""
    directory = tmp_path / "live"
    with lock_bringup("/elsewhere", directory):
        done = run_command("bringup.live", *EXTERNAL, cwd=tmp_path, env=environment(0))
    assert (done.returncode, directory.exists()) == (3, False)
    assert done.stderr.startswith(f"error: a bringup is already running in {directory}; stop it")
