"""Watchers beside real runs: alarms come and go, a stop holds, and the bag stays the same."""

from __future__ import annotations

import filecmp
import os
import signal
import socket
import time
from pathlib import Path

import pytest
from browsers import started_browser
from graphs import Process, bag_file, bring_up, wait_for
from test_watch_command import document, end, stop_on_page, watcher

pytest.importorskip("rclpy", reason="nodes need ROS 2")
pytest.importorskip("pymodbus", reason="drives are on Modbus")


def test_at_a_live_site_an_alarm_comes_and_goes_and_a_stop_holds(
    domain: int, tmp_path: Path
) -> None:
    """A stop also holds for another watcher, and after the controller is killed."""
    from faults.rig import SiteRig

    with SiteRig(tmp_path / "site", domain, "danfoss_fc202") as rig:
        process, port = watcher(domain, tmp_path)

        def silent() -> bool:
            return any(
                row["id"] == "/roof_sensor: sensor" and row["over"] is None
                and row["code"] == "sensor_lost" for row in document(port)["alarms"]
            )

        rig.until_running(120)
        wait_for(
            lambda: (level := document(port)["tiles"]["roof"]["number"]) is not None
            and abs(level - rig.levels()[1]) < 0.001, 30, "the roof's true level",
        )
        assert document(port)["mode"] == "live"
        rig.truth.inject_site("roof_silent")
        wait_for(silent, 60, "the alarm")
        rig.truth.inject_site("none")
        wait_for(lambda: not silent(), 60, "its end")
        rig.until_running()
        stop_on_page(port)
        wait_for(lambda: rig.truth.speed < 0.005, 60, "a pump that stands")
        end(process)
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
        assert (tile["state"], "a hold by the page" in tile["why"]) == ("held", True)
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
