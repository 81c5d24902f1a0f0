"""The environment of ROS."""

from __future__ import annotations

import os

import pytest
from refusals import refusal

from greenroof_ros.ros.domain import prepare_ros


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
