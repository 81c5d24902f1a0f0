"""Watchers beside real runs: alarms come and go, a stop holds, and the bag stays the same."""

from __future__ import annotations

import filecmp
import json
import os
import signal
import socket
import time
from pathlib import Path

import pytest
from brokers import Talker, mosquitto, needs_mosquitto
from browsers import started_browser
from graphs import Process, bag_file, bring_up, wait_for
from test_bridge import state_on
from test_watch_command import document, end, stop_on_page, watcher

from greenroof_ros.common.interface import read_conditions

pytest.importorskip("rclpy", reason="nodes need ROS 2")
pytest.importorskip("pymodbus", reason="drives are on Modbus")


@needs_mosquitto
def test_at_a_live_site_an_alarm_comes_and_goes_and_a_stop_holds(
    domain: int, tmp_path: Path
) -> None:
    """On the page, and by its code over MQTT; a stop holds until it is released at the pump node.

    It also holds for another watcher, and after the controller is killed. A broker that hangs does
    not affect the site.
    """
    from faults.rig import SiteRig

    with (
        mosquitto(tmp_path) as broker, Talker(broker) as heard,
        SiteRig(tmp_path / "site", domain, "danfoss_fc202") as rig,
    ):
        bridge = Process(domain, "bridge", "--broker", broker.address, cwd=tmp_path)
        process, port = watcher(domain, tmp_path)

        def silent() -> bool:
            rows = document(port)["alarms"]
            on_page = any(
                row["id"] == "/roof_sensor: sensor" and row["over"] is None
                and "no valid answer" in row["what"] for row in rows
            )
            state = state_on(heard)
            over_mqtt = (state["problem"], state["roof_level"]) == ("ON", None)
            return on_page and over_mqtt

        rig.until_running(120)
        wait_for(lambda: state_on(heard).get("pump") == "running", 60, "a running pump")
        wait_for(lambda: state_on(heard)["problem"] == "OFF", 60, "no alarm")
        assert state_on(heard)["mode"] == "live"
        wait_for(
            lambda: (level := state_on(heard)["roof_level"]) is not None
            and abs(level / 1000 - rig.levels()[1]) < 0.001, 10, "the roof's true level",
        )
        rig.truth.inject_site("roof_silent")
        wait_for(silent, 60, "the alarm")
        alarms = json.loads(heard.last("greenroof/roof/alarms"))["alarms"]
        codes = {row["code"] for row in alarms}
        assert state_on(heard)["condition"] in codes <= read_conditions().keys()
        rig.truth.inject_site("none")
        wait_for(lambda: state_on(heard)["problem"] == "OFF", 60, "the end of the alarm")
        wait_for(lambda: not silent(), 60, "its end on the page")
        rig.until_running()
        broker.pause()
        bridge.until_said("not connected to")
        stop_on_page(port)
        wait_for(lambda: rig.truth.speed < 0.005, 60, "a pump that stands")
        for ended in (bridge, process):
            end(ended)
        process, port = watcher(domain, tmp_path)
        wait_for(
            lambda: document(port)["tiles"]["controller"]["value"] == "onoff", 60, "a controller"
        )
        before = rig.pids()["controller"]
        os.kill(before, signal.SIGKILL)
        wait_for(lambda: rig.pids().get("controller", before) != before, 60, "another controller")
        wait_for(
            lambda: "/onoff was started again" in str(document(port)["events"]), 60, "the event"
        )
        time.sleep(5.0)  # it commands again
        tile = document(port)["tiles"]["pump"]
        assert (tile["state"], "on the page" in tile["why"]) == ("held", True)
        assert rig.truth.speed < 0.005
        assert rig.watcher.stop(False)
        rig.until_running()
        wait_for(
            lambda: document(port)["tiles"]["pump"]["state"] == "running", 60, "a running pump"
        )
    assert not rig.ended_badly
    wait_for(lambda: document(port)["mode"] == "ended", 60, "the end")
    assert not document(port)["stop"]["possible"]
    end(process)


def test_a_run_under_the_eyes_of_three_is_the_same_run(domain: int, tmp_path: Path) -> None:
    """A page that waits for it, one that never reads, and a slow one; the watcher is stopped."""
    options = ("--controller", "onoff", "--hours", "0.15")
    process, port = watcher(domain, tmp_path)
    request = b"GET /events?hours=12 HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with (
        started_browser() as browser, socket.create_connection(("127.0.0.1", port)) as deaf,
        socket.create_connection(("127.0.0.1", port)) as slow,
    ):
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        deaf.sendall(request)
        slow.sendall(request)
        page = browser.new_page()
        page.set_default_timeout(60_000)
        page.goto(f"http://127.0.0.1:{port}/")
        run = Process(
            domain, "bringup", *options, "--speed", "60", "--output", "run", cwd=tmp_path
        )
        page.wait_for_selector("#heading:has-text('Simulated run')")
        assert slow.recv(512)
        process.process.send_signal(signal.SIGSTOP)
        time.sleep(2.0)
        process.process.send_signal(signal.SIGCONT)
        assert run.wait(120) == 0, run.stderr()
        page.wait_for_selector("#heading:has-text('Ended run')")
        assert "ended" in page.locator("#events").inner_text()
    end(process, signal.SIGTERM)
    bring_up(domain, tmp_path, *options, output="alone")
    bags = [bag_file(tmp_path / name) for name in ("run", "alone")]
    assert filecmp.cmp(*bags, shallow=False)
