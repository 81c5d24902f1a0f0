"""A page beside real runs: alarms come and go on it, runs end and begin, and no bag is another."""

from __future__ import annotations

import filecmp
import os
import signal
import socket
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from browsers import started_browser
from graphs import Process, bag_file, bring_up, free_ports, wait_for
from places import CHECKOUT

pytest.importorskip("rclpy", reason="nodes need ROS 2")
pytest.importorskip("pymodbus", reason="drives are on Modbus")


def watch(domain: int, cwd: Path, port: int) -> Process:
    process = Process(domain, "watch", "--port", str(port), cwd=cwd)
    wait_for(process.stdout, 60, "an address")
    return process


def opened(browser: Any, port: int) -> Any:
    page = browser.new_page()
    page.set_default_timeout(60_000)
    page.goto(f"http://127.0.0.1:{port}/")
    return page


def test_alarms_come_and_go_and_stop_holds(domain: int, tmp_path: Path) -> None:
    """At a live site; the stop holds until the pump node is told so.

    Through a reload, when the watcher is started again, and when the controller is killed. Every
    kind of alarm, with its time, is ``python tools/watch/alarms.py``.
    """
    sys.path.insert(0, str(CHECKOUT / "test" / "faults"))
    try:
        from rig import SiteRig
    finally:
        del sys.path[0]
    port = free_ports(1)[0]
    with started_browser() as browser:
        with SiteRig(tmp_path / "site", domain, "danfoss_fc202") as rig:
            watcher = watch(domain, tmp_path, port)
            rig.until_running(120)
            page = opened(browser, port)
            for inject, fault, part, words in (
                (rig.truth.inject_site, "roof_silent", "/roof_sensor: sensor", "no valid answer"),
                (rig.truth.inject_drive, "drive_fault", "/pump: drive", "brake check"),
            ):
                alarm = f"[data-alarm='{part}']:not([data-over]):has-text('{words}')"
                inject(fault)
                page.wait_for_selector(alarm)
                inject("none")
                assert rig.watcher.reset()  # what has latched
                page.wait_for_selector(alarm, state="detached")
                rig.until_running()
            page.locator("#stop-button:enabled").click()
            page.locator("#ask-yes").click()
            page.wait_for_selector("#answer:not(.failed):has-text('held')")
            held = (
                ".tile[data-key=pump][data-state=held]:has-text('somebody stopped it on the page')"
            )
            page.wait_for_selector(held)
            wait_for(lambda: rig.truth.speed < 0.005, 60, "a pump that stands")
            page.reload()
            page.wait_for_selector(held)
            page.wait_for_selector("#stop-button:disabled:has-text('The pump is held off')")
            watcher.process.send_signal(signal.SIGINT)
            assert watcher.wait(120) == 0
            page.wait_for_selector("#lost:has-text('Not connected')")
            watcher = watch(domain, tmp_path, port)
            page.wait_for_selector("#lost", state="hidden")
            page.wait_for_selector(held)
            before = rig.pids()["controller"]
            os.kill(before, signal.SIGKILL)
            wait_for(
                lambda: rig.pids().get("controller", before) != before, 60, "another controller"
            )
            page.wait_for_selector("#events:has-text('/onoff was started again')")
            time.sleep(5.0)  # it commands again
            page.wait_for_selector(held)
            assert rig.truth.speed < 0.005
            assert rig.watcher.stop(False)
            rig.until_running()
            page.wait_for_selector(".tile[data-key=pump][data-state=running]")
        assert not rig.ended_badly
        page.wait_for_selector("#heading:has-text('Ended run')")
        assert not page.locator("#stop-button:enabled").is_visible()
        watcher.process.terminate()
        assert watcher.wait(120) == 0


def test_runs_end_and_begin_under_the_eyes_of_three(domain: int, tmp_path: Path) -> None:
    """A page follows without a reload; it, one that never reads and one that is slow do no harm."""
    port = free_ports(1)[0]
    options = ("--controller", "lookahead", "--horizon", "12", "--hours", "0.1")
    watcher = watch(domain, tmp_path, port)
    request = b"GET /events?hours=12 HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with started_browser() as browser, socket.create_connection(("127.0.0.1", port)) as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        deaf.sendall(request)
        page = opened(browser, port)
        with socket.create_connection(("127.0.0.1", port)) as slow:
            slow.sendall(request)
            for name in ("first", "second"):
                run = Process(domain, "bringup", *options, "--speed", "60", "--output", name,
                              cwd=tmp_path)
                page.wait_for_selector("#heading:has-text('Simulated run')")
                assert slow.recv(512)
                assert run.wait(120) == 0, run.stderr()
                page.wait_for_selector("#heading:has-text('Ended run')")
                events = page.locator("#events").inner_text()
                assert "ended" in events
    watcher.process.terminate()
    assert watcher.wait(120) == 0
    bring_up(domain, tmp_path, *options, output="alone")
    for name in ("first", "second"):
        assert filecmp.cmp(bag_file(tmp_path / name), bag_file(tmp_path / "alone"), shallow=False)
