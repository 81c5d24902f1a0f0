"""What bringup refuses on a command line and in ROS' environment, and what it says of a drive."""

from __future__ import annotations

import os
import re
import sys
from functools import partial
from pathlib import Path

import pytest
from commands import run_command
from graphs import environment
from paper import VALVE, site_file
from places import CHECKOUT, refusal

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.live.devices.exchange import read_endpoint
from greenroof_ros.live.live_site import LiveSite, describe_nodes, make_stopper
from greenroof_ros.live.live_site import make_parser as live_site_parser
from greenroof_ros.ros.domain import lock_bringup, prepare_ros
from greenroof_ros.ros.parameters import node_parameter_files

EXTERNAL = ("--sensors", "external", "--pump", "external", "--weather", "external")
# A live site with a weather node, and the rest external; and a drive.
WEATHERED = "--controller mpc --sensors external --pump external"
DRIVE = "--drive abb_acs880 --drive-at tcp://127.0.0.1:1"
WRONG = {
    "--weather external --pump external": "--sensors",
    f"{WEATHERED}": "--forecast, or a controller without a forecast, such as onoff",
    f"{' '.join(EXTERNAL)} --controller onoff --outlet drain": "outlet",
    # Only one program can open a serial line, so the sensor or the drive would never answer.
    "--weather external --sensors serial.yaml --drive danfoss_fc202 --drive-at /dev/ttyS0,1":
        "--drive-at",
    f"{' '.join(EXTERNAL)} --site site.yaml": "--valve, and --valve-at",
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
    with pytest.raises(ConfigurationError) as refused:
        LiveSite(live_site_parser().parse_args())
    assert refused.value.key == WRONG[words]


def test_what_a_valve_needs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Below the frost line no temperature; switches of external nodes if it may stay open."""
    monkeypatch.chdir(tmp_path)
    sensors = (CHECKOUT / "config" / "sensors_mqtt.yaml").read_text()
    sections = {text.partition(":")[0]: text for text in re.split(r"\n\n(?=\w)", sensors)}
    Path("sensors.yaml").write_text("\n".join(map(sections.get, ("cistern", "rain_gauge"))))
    valve = ["--valve", "tasmota", "--valve-at", "mqtt://127.0.0.1/valve", "--site", "site.yaml"]

    def site(*words: str, **given: object) -> LiveSite:
        site_file(tmp_path, **VALVE, **given)
        monkeypatch.setattr(sys, "argv", ["live", *valve, *words])
        return LiveSite(live_site_parser().parse_args())

    own = partial(site, "--sensors", "sensors.yaml", irrigation="none")
    refusal(partial(own, valve_closed_in_frost=True), match="^--forecast, or a thermometer")
    assert "pump" not in own(valve_closed_in_frost=False).nodes
    for without_power in ("closes", "may_stay_open"):
        external = site("--controller", "onoff", *EXTERNAL, valve_without_power=without_power)
        _, parameters = external.nodes["valve"]
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
    ("/**/pump", "drive: my_drive"): "line 3: /**/pump: drive",
    ("/pump", "min_off: 1.0"): "line 1: /pump: ",
    ("/**/pump", "max_volume_per_dai: 0.5"): "line 3: /**/pump: max_volume_per_dai",
}


@pytest.mark.parametrize(("section", "parameter"), NO_EFFECT)
def test_a_parameter_that_would_have_no_effect(
    tmp_path: Path, section: str, parameter: str
) -> None:
    """rclpy accepts a mistyped limit without a warning."""
    pytest.importorskip("rclpy")
    file = tmp_path / "nodes.yaml"
    options = ["--namespace", "site1", "--node-parameters", str(file)]
    arguments = live_site_parser().parse_args(options)
    described = partial(describe_nodes, MODULES, find_controller("onoff"), arguments.site)
    read = node_parameter_files, arguments, described, {"fraction": 0.9}
    refusal(*read, match="must be an existing file")
    file.write_text("/**:\n  ros__parameters: {recovery_time: 1}\n")
    assert node_parameter_files(*read[1:]) == [file]
    file.write_text(f"{section}:\n  ros__parameters:\n    {parameter}\n")
    assert refusal(*read).startswith(f"{file}, {NO_EFFECT[section, parameter]}")


# --- before and after the nodes -------------------------------------------------------------------


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
        "live.live_site", "--sensors", "external", "--weather", "external", *options.split(),
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
        done = run_command("live.live_site", *EXTERNAL, cwd=tmp_path, env=environment(0))
    assert (done.returncode, directory.exists()) == (3, False)
    assert done.stderr.startswith(f"error: a bringup is already running in {directory}; stop it")


def test_values_that_ros_would_replace(monkeypatch: pytest.MonkeyPatch) -> None:
    """With its own values, messages may leave this machine."""
    pytest.importorskip("rclpy", reason="it is about ROS 2")
    monkeypatch.setattr(os, "environ", {**os.environ})
    for variable, value, words in (
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "localhost", "did you mean LOCALHOST?"),  # rcl: SUBNET
        ("ROS_DOMAIN_ID", "abc", "must be a whole number from 0 to 101"),
    ):
        os.environ[variable] = value
        message = refusal(prepare_ros)
        assert message.startswith(f"{variable} = {value!r}: ") and words in message
