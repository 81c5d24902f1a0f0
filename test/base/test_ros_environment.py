"""The environment that ROS 2 is loaded from."""

from __future__ import annotations

import pytest
from refusals import refusal

pytest.importorskip("rclpy", reason="it is about ROS 2")

from greenroof_ros.base.ros_environment import check_environment


@pytest.mark.parametrize(
    ("variable", "value", "words"),
    [
        ("ROS_DOMAIN_ID", "abc", "must be a whole number from 0 to 101"),
        ("ROS_DOMAIN_ID", "010", "must be a whole number"),  # rcl reads 8
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "localhost", "did you mean LOCALHOST?"),  # rcl: SUBNET
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
    for variable in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.setenv(variable, "")
    check_environment()
