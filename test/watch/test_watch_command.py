"""``greenroof watch`` and ``bringup --watch`` as processes."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from commands import run_command
from graphs import (
    Process,
    children_of,
    environment,
    free_ports,
    udp_addresses_of,
    wait_for,
)
from page_inputs import read_state, request
from simulators import Simulator

from greenroof_ros.watch.lines import read_histories

URL = re.compile(r"http://127\.0\.0\.1:(\d+)/\n")


def port_of(text: str) -> int:
    match = URL.search(text)
    return int(match[1]) if match else 0


def watcher(domain: int, cwd: Path, *arguments: str) -> tuple[Process, int]:
    """Start a watcher; return it with its port when it is ready."""
    process = Process(domain, "watch", *arguments, cwd=cwd)

    def ready() -> int:
        assert process.process.poll() is None, process.stderr()
        return port_of(process.stdout())

    return process, wait_for(ready, 60, "an address")


def refuses_other_addresses(port: int) -> bool:
    """Return whether nobody listens at another of this machine's addresses."""
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.2", port)) != 0


def end(process: Process, number: signal.Signals = signal.SIGINT) -> None:
    """End it, and check that it ends well."""
    process.process.send_signal(number)
    assert process.wait(300) == 0, process.stderr()
    assert "Traceback" not in process.stderr()


@contextmanager
def running_pump(
    domain: int, cwd: Path, *options: str, code: int = 0
) -> Iterator[tuple[Process, Simulator]]:
    """Run a live site in the namespace site1; its pump soon runs, for minutes."""
    pytest.importorskip("rclpy", reason="nodes need ROS 2")
    pytest.importorskip("pymodbus", reason="drives are on Modbus")
    from live_rig import Hardware, live

    with Hardware(domain, cwd) as hardware:
        chosen = hardware.be_a_site()
        hardware.begin()
        with live(domain, cwd, *chosen, "--namespace", "site1", *options, code=code) as process:
            yield process, hardware


def test_it_waits_for_a_graph_on_loopback_and_ends_soon(domain: int, tmp_path: Path) -> None:
    """Each on a separate port; on each signal, whoever is watching."""
    watchers = [watcher(domain, tmp_path) for _ in range(2)]
    ports = [port for _, port in watchers]
    assert ports[0] != ports[1] and min(ports) >= 8080
    for (process, port), number in zip(watchers, (signal.SIGINT, signal.SIGHUP), strict=True):
        assert read_state(port)["mode"] == "none"
        assert refuses_other_addresses(port)
        assert {*udp_addresses_of(process.process.pid)} <= {"127.0.0.1", "239.255.0.1"}
        with socket.create_connection(("127.0.0.1", port)):
            end(process, number)


def test_beyond_loopback_and_to_release_it_needs_its_token(domain: int, tmp_path: Path) -> None:
    """Each time with a new token, or with the one in a file, which the first start makes.

    Then the page's address survives a restart, and it needs the token on loopback, too.
    """
    (port,), file, tokens = free_ports(1), tmp_path / "token", []
    for options, warning in (
        (("--host", "0.0.0.0", "--token-file", file.name), "anyone who has the address"),
        (("--allow-release",), "anyone who has the address"), (("--token-file", file.name), ""),
    ):
        process = Process(domain, "watch", *options, "--port", str(port), cwd=tmp_path)
        url = wait_for(process.stdout, 60, "an address")
        token = re.fullmatch(rf"http://[^/]+:{port}/#token=([\w-]{{32}})\n", url)
        assert token and warning in process.stderr(), url
        tokens.append(token[1])
        host = "a.name" if "--host" in options else "localhost"
        for headers, status in (({}, 401), ({"Authorization": f"Bearer {token[1]}"}, 200)):
            answer = request(port, "POST", "/stop", host=host, X_Greenroof="1", **headers)
            assert answer.status == status
        end(process)
    assert tokens[0] == tokens[2] == file.read_text().strip() != tokens[1]
    assert file.stat().st_mode & 0o777 == 0o600


def child_of(process: Process, command: bytes = b"greenroof_ros\0watch") -> int:
    """Return the process with this command that another has started; 0 for none."""
    for pid in children_of(process.process.pid):
        with suppress(OSError):  # it has just ended
            if command in Path(f"/proc/{pid}/cmdline").read_bytes():
                return pid
    return 0


def test_a_stop_is_released_as_shown_and_a_killed_site_is_told_first(
    domain: int, tmp_path: Path
) -> None:
    """By a page that is not part of the site, and whose past survives a restart.

    The page's stop is released by the command that is shown, exactly as printed. A hold is a
    warning for greenroof status, and a site that was killed an alarm.
    """

    def past() -> bool:
        return bool(request(port, "GET", "/charts?hours=12").json()["lines"].get("roof"))

    def status() -> int:
        return run_command(
            "status", "--namespace", "site1", cwd=tmp_path, env=environment(domain)
        ).returncode

    with running_pump(domain, tmp_path, code=-signal.SIGKILL) as (process, drive):
        page, port = watcher(domain, tmp_path, "--namespace", "site1")
        wait_for(past, 60, "a chart")
        end(page)
        (file,) = Path(os.environ["XDG_STATE_HOME"]).rglob("watch_*.npz")
        assert read_histories(file)["roof"].rows.size
        page, port = watcher(domain, tmp_path, "--namespace", "site1")
        wait_for(
            lambda: read_state(port)["tiles"]["pump"]["state"] == "running", 60, "a running pump"
        )
        assert request(port, "POST", "/stop", X_Greenroof="1").json()["ok"]
        wait_for(lambda: read_state(port)["stop"]["stopped"], 60, "the stop")
        assert drive.speed() < 0.005
        wait_for(lambda: status() == 1, 90, "a warning")
        # For any terminal of this machine.
        command = read_state(port)["advice"].partition("release it with: ")[2]
        assert subprocess.run(command, shell=True, cwd=tmp_path, env=environment(0)).returncode == 0
        wait_for(lambda: not read_state(port)["stop"]["hold"], 60, "the pump released")
        process.process.kill()
        wait_for(
            lambda: "nobody waters the roof" in read_state(port)["tiles"]["summary"]["sentence"],
            60, "the end of the site",
        )
        end(page)
    assert status() == 2  # also by what is started later
