"""The environment that ROS 2 is loaded from: one line says what is wrong, with exit code 2."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from graphs import environment
from refusals import refusal

pytest.importorskip("rclpy", reason="it is about ROS 2")

from greenroof_ros.base.ros_environment import check_environment

RUN = "greenroof_ros run --hours 0.01"
NODE = "greenroof_ros.nodes.plant"
FOREIGN = "_rclpy_pybind11.cpython-39-x86_64-linux-gnu.so"


def started(directory: Path, words: str, **variables: str) -> tuple[int, str]:
    """Start Python anew; return exit code and output."""
    done = subprocess.run(
        [sys.executable, "-m", *words.split()], cwd=directory, text=True, check=False,
        env={**environment(0), **variables}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )
    return done.returncode, done.stdout


@pytest.mark.parametrize("words", [RUN, NODE, "greenroof_ros status", "greenroof_ros.live.pump"])
def test_another_middleware(words: str, tmp_path: Path) -> None:
    """With one that is not installed, or misspelt, rcl ends the process with 102."""
    code, output = started(tmp_path, words, RMW_IMPLEMENTATION="rmw_zenoh")
    assert code == (3 if "status" in words else 2)
    assert output.startswith("error: RMW_IMPLEMENTATION = 'rmw_zenoh': is a middleware that")
    assert output.count("\n") == 1 and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [RUN, NODE])
@pytest.mark.parametrize("package", ["rclpy", "std_msgs"])
def test_a_ros_of_another_python(package: str, words: str, tmp_path: Path) -> None:
    """Its packages are first in PYTHONPATH when it is sourced."""
    (tmp_path / package).mkdir()
    (tmp_path / package / "__init__.py").touch()
    (tmp_path / package / FOREIGN).touch()
    code, output = started(tmp_path, words, PYTHONPATH=f"{tmp_path}", AMENT_PREFIX_PATH="/opt/x")
    assert code == 2
    assert output.startswith(
        f"error: {tmp_path / package}: is compiled for cpython-39-x86_64-linux-gnu, but this Python"
    )
    assert "unset PYTHONPATH" in output and output.count("\n") == 1


@pytest.mark.parametrize(
    ("variable", "value", "words"),
    [
        ("ROS_DOMAIN_ID", "abc", "must be a whole number from 0 to 101"),
        ("ROS_DOMAIN_ID", "010", "must be a whole number"),  # rcl reads 8
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "localhost", "did you mean LOCALHOST?"),  # rcl: SUBNET
        ("FASTRTPS_DEFAULT_PROFILES_FILE", "/no.xml", "must be an XML file of Fast DDS profiles"),
        ("FASTDDS_DEFAULT_PROFILES_FILE", __file__, "must be an XML file of Fast DDS profiles"),
    ],
)
def test_values_that_ros_would_replace(
    variable: str, value: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ROS would silently take another value, with which messages may leave this machine."""
    monkeypatch.setenv(variable, value)
    message = refusal(check_environment)
    assert message.startswith(f"{variable} = {value!r}: ") and words in message


def test_what_means_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    """ROS takes an empty variable as if it were not set."""
    for variable in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "RMW_IMPLEMENTATION"):
        monkeypatch.setenv(variable, "")
    check_environment()
