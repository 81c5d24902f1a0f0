"""Watchers next to real runs: alarms come and go, a stop holds, and the bag stays the same."""

from __future__ import annotations

import filecmp
import re
import signal
import socket
import time
from pathlib import Path

import pytest
from browsers import started_browser
from graphs import Process, bag_file, bring_up, wait_for
from places import CONFIG
from test_foxglove import deaf_client, port_of
from test_watch_command import end, running_pump, watcher

from greenroof_ros.model.site import read_site

pytest.importorskip("rclpy", reason="nodes need ROS 2")
pytest.importorskip("pymodbus", reason="drives are on Modbus")


def test_a_run_under_the_eyes_of_four_is_the_same_run(domain: int, tmp_path: Path) -> None:
    """A page that waits for it, one that never reads, and a slow one; the watcher is stopped.

    And Foxglove, with a client that subscribes to everything and never reads.
    """
    options = ("--controller", "onoff", "--hours", "0.15")
    process, port = watcher(domain, tmp_path)
    viewer = Process(domain, "watch", "--foxglove", "0", cwd=tmp_path)
    request = b"GET /events?hours=12 HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with (
        started_browser() as browser, deaf_client(port_of(viewer.stdout)),
        socket.create_connection(("127.0.0.1", port)) as deaf,
        socket.create_connection(("127.0.0.1", port)) as slow,
    ):
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        deaf.sendall(request)
        slow.sendall(request)
        page = browser.new_page()
        page.set_default_timeout(60_000)
        page.goto(f"http://127.0.0.1:{port}/")
        run = Process(
            domain, "bringup", *options, "--speed", "60", "--foxglove", "0", "--output", "run",
            cwd=tmp_path,
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
    end(viewer)
    bring_up(domain, tmp_path, *options, output="alone")
    bags = [bag_file(tmp_path / name) for name in ("run", "alone")]
    assert filecmp.cmp(*bags, shallow=False)


def test_the_page_follows_a_dose_until_it_is_delivered(domain: int, tmp_path: Path) -> None:
    """At a live site, in a browser: limits and units, the question, and each answer.

    The controller fills the roof to half of its target only, so it asks for nothing.
    """
    file = tmp_path / "site.yaml"
    file.write_text(f"{(CONFIG / 'site.yaml').read_text()}greatest_dose: 0.2\n")
    site = read_site(file)
    options = ("--site", str(file), "--level", "0.5")
    with running_pump(domain, tmp_path, *options), started_browser() as browser:
        process = Process(
            domain, "watch", "--namespace", "site1", "--allow-release", cwd=tmp_path
        )
        address = wait_for(
            lambda: next((w for w in process.stdout().split() if w.startswith("http://")), ""),
            60, "an address",
        )
        page = browser.new_page()
        page.set_default_timeout(120_000)
        page.goto(address)
        page.wait_for_selector("#dose-button", state="visible")
        assert page.inner_text("#dose-label").strip() == "Dose (m³)"
        volume = page.locator("#dose-volume")
        minimum, most = (float(volume.get_attribute(name)) for name in ("min", "max"))
        assert 0 < minimum < 0.1 < most == 0.2
        depths = [f"{1000 * each / site.a2:.1f}\N{NO-BREAK SPACE}mm" for each in (minimum, most)]
        assert page.inner_text("#dose-limits") == (
            f"from {minimum:.3f} to 0.2 m³, which is {' to '.join(depths)} of water on the roof"
        )
        page.evaluate("""() => {
            const answer = document.getElementById("answer");
            window.answers = [];
            new MutationObserver(() => window.answers.push(answer.textContent))
                .observe(answer, { childList: true, characterData: true, subtree: true });
        }""")
        volume.fill("0.1")
        page.click("#dose-button")
        assert "Give a dose of 0.1 m³?" in page.inner_text("#ask")
        page.click("#ask-yes")
        page.locator("#answer", has_text="was delivered").wait_for()
        answers = page.evaluate("window.answers")
        assert re.search(r"starting|it may start|0\.000 of 0\.1 m³", " ".join(answers)), answers
        assert any(": A dose: 0.0" in answer for answer in answers), answers
        assert answers[-1].endswith(": The dose of 0.1 m³ was delivered.")
        assert not any("m3" in answer for answer in answers), answers
        end(process)
