"""Addresses of brokers and their topics, and a client that reconnects."""

from __future__ import annotations

from pathlib import Path

import pytest
from places import refusal

from greenroof_ros.base.mqtt import Broker, make_client, parse_broker, parse_topic


def test_an_address_names_broker_and_topic() -> None:
    assert parse_broker("mqtt://roof.local", "broker") == Broker("roof.local", 1883)
    assert parse_broker("mqtts://[::1]:99", "broker") == Broker("::1", 99, tls=True)
    assert parse_topic("mqtt://h:1/a/b", "address") == (Broker("h", 1), "a/b")
    for wrong in ("roof.local", "mqtt://", "mqtt://no..where", "mqtt://h:0", "mqtt://h:70000", "http://h"):
        refusal(parse_broker, wrong, "broker", match=r"broker = .*: must be mqtt://HOST")
    for wrong in ("mqtt://h", "mqtt://h/", "mqtt://h/a/#", "mqtt://h/+/b"):
        refusal(parse_topic, wrong, "address", match=r"address = .*: must be mqtt://HOST")


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o602])
def test_a_login_that_others_may_know_is_refused(mode: int, tmp_path: Path) -> None:
    """As the page's token; it is the login of bridge, sensors and relay alike."""
    pytest.importorskip("paho.mqtt")
    file = tmp_path / "login.yaml"
    file.write_text("username: roof\npassword: secret\n")
    broker = parse_broker("mqtt://h", "broker", str(file))
    file.chmod(mode)
    message = refusal(
        make_client, broker, "roof", int, print, match="can be read or changed by other users"
    )
    assert str(file) in message and "secret\n" not in message
    file.chmod(0o600)
    make_client(broker, "roof", int, print).disconnect()
