"""A live site by bringup, with real processes, and as one command on simulated devices.

What follows from processes that are killed, ended or stopped, and from a full disk, is shown by the
fault campaign.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from datetime import timedelta
from itertools import pairwise
from pathlib import Path

import pytest
from disks import disk_that_hangs, full_pipe
from graphs import Process, alive, environment, summary_of, wait_for
from live_rig import QUICK, Hardware, live
from places import CONFIG
from ros_rig import Site, newest, write_forecast
from rosbags.highlevel import AnyReader

from greenroof_ros.interface.alarm import read_alarms

# Bytes of a serialized message before the rest of its content: CDR's header, and the time.
TIME_STAMP = 4 + 8
EXTERNAL = "--controller", "mpc", "--sensors", "external", "--pump", "external"
# Of a low roof and a full cistern.
LEVELS = {"/cistern/level": 2.4, "/roof/level": 0.03, "/pump/flow": 0.0}


def values_in(bag: Path, topic: str) -> list[tuple[float, float]]:
    """Return a topic's values in a bag, each with its time (s since 1970)."""
    with AnyReader([bag]) as reader:
        return [
            (stamp / 1e9, reader.deserialize(raw, connection.msgtype).data)
            for connection, stamp, raw in reader.messages() if connection.topic == topic
        ]


def until_printed(process: Process, site: Site, *printed: str) -> None:
    site.until(lambda: all(text in process.stderr() for text in printed), 90, f"{printed}")


def listen(path: Path) -> list[str]:
    """Return a list that collects what a service manager receives, from now on."""
    lines: list[str] = []
    receiver = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    receiver.bind(str(path))
    threading.Thread(
        target=lambda: lines.extend(iter(lambda: receiver.recv(4096).decode(), "")), daemon=True
    ).start()
    return lines


def test_a_site_is_kept_up_and_systemd_told(
    domain: int, tmp_path: Path, site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ready at once, alive all the time.

    The start does not wait for a forecast whose file and directory are missing: on/off pumps, and
    the loss is an alarm until it ends.
    """
    systemd = listen(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("HOME", "/proc/nohome")  # a service's user has no home
    commands = site.listen("/pump/command")
    (tmp_path / "nodes.yaml").write_text(QUICK)
    file = tmp_path / "from_service" / "forecast.csv"
    options = (
        *EXTERNAL, "--max-command", "0.4", "--forecast", "from_service/forecast.csv",
        "--bag-limit", "50", "--node-parameters", "nodes.yaml",
    )
    running = "running: cistern 2.400 m, roof 0.0300 m"
    with live(domain, tmp_path, *options) as process:
        until_printed(process, site, "  /mpc: inputs: /cistern/level has", "  /weather: forecast: ")
        assert "READY=1" in systemd and not any(value for _, value in commands)
        site.values = {**LEVELS, "/gauge/temperature": 8.0}
        site.until(lambda: newest(commands) == 1.0, 90, "on/off")
        first_line = ": Weather: no forecast covers the current time"
        until_printed(process, site, f"\n{running}\n", first_line)
        file.parent.mkdir()
        write_forecast(file, timedelta(minutes=1), 0.0, 12.0)
        site.until(lambda: 0 < newest(commands) <= 0.4, 60, "mpc")
        until_printed(process, site, " s: Weather: no forecast covers")
    wait_for(lambda: "STOPPING=1" in systemd, 60, "STOPPING=1")
    assert {f"STATUS={running}", "WATCHDOG=1"} <= {*systemd}
    summary = summary_of(tmp_path / "run")
    assert (summary["status"], summary["reason"]) == ("done", "interrupted by SIGTERM")
    assert process.stderr().endswith("\ndone: interrupted by SIGTERM\n")
    alarms = {(alarm["node"], alarm["part"]): alarm for alarm in summary["alarms"]}
    lost, consequence = alarms["/weather", "forecast"], alarms["/mpc", "forecast"]
    assert lost["since"] < lost["ended"] and not lost["follows"]
    assert (lost["code"], consequence["level"]) == ("forecast_missing", "warn")
    # Nothing for a normal start, nor for a return, although its inputs first have to recover.
    assert len(alarms) == 2
    with AnyReader([tmp_path / "run" / "bag"]) as reader:
        connections = [each for each in reader.connections if each.topic == "/alarms"]
        recorded = [raw[TIME_STAMP:] for *_, raw in reader.messages(connections)]
    assert len(recorded) >= 2
    assert all(one != other for one, other in pairwise(recorded))  # only changes


@pytest.fixture
def hardware(domain: int, tmp_path: Path) -> Iterator[Hardware]:
    hardware = Hardware(domain, tmp_path)
    yield hardware
    hardware.end()


def test_a_live_site_with_drive_and_sensors(
    domain: int, tmp_path: Path, hardware: Hardware
) -> None:
    """Everything missing at the start has a line with what to do; at the end, the drive runs on.

    In a namespace. The drive's own timeout is off, so nothing stops it, and that is reported.
    """
    options = *hardware.be_a_site(), "--namespace", "site1"
    with live(domain, tmp_path, *options, code=1) as process:
        for reason in (
            "/roof_sensor: sensor: tcp://127.0.0.1:", ", device 1: cannot connect. The sensor",
            "is older than 2 h. There is no forecast for the current time, so the roof is watered",
        ):
            process.until_printed(reason)
        # It lists neither consequences of these nor a drive that is there.
        lacking = process.stderr().rpartition("missing:\n")[2].splitlines()
        assert {line.partition(":")[0].rpartition("/")[2] for line in lacking} <= {
            "cistern_sensor", "roof_sensor", "weather"
        }
        hardware.begin()
        hardware.until_it_pumps()
        hardware.inject("timeout_off")
        hardware.inject("refused")
    assert hardware.speed() > 0.9
    summary = summary_of(tmp_path / "run")
    words = "error: interrupted by SIGTERM; bringup could not stop the drive: "
    assert words in process.stderr()
    for text in (process.stderr(), summary["reason"]):
        assert "THE PUMP MAY BE RUNNING" in text
    assert summary["status"] == "failed" and (tmp_path / "run" / "pump.json").is_file()


# Longer than a recorder waits for a flush (s), and for one that lasts.
HANG_S = 30


def test_a_disk_or_a_terminal_that_hangs_stops_no_pump(
    domain: int, tmp_path: Path, hardware: Hardware
) -> None:
    """Nor does it end a node; messages wait in memory, and are in the bag with their times.

    What replaces dead processes reads the files of the site's start, whatever they hold since, and
    if the copies were removed. The pump is off at the end without a pump node.
    """
    (tmp_path / "onoff.yaml").write_text("/**/onoff:\n  ros__parameters:\n    fraction: 0.95\n")
    (tmp_path / "site.yaml").write_text(f"extends: {CONFIG / 'site.yaml'}\n")
    options, run = hardware.be_a_site(), tmp_path / "run"
    options += "--parameters", "onoff.yaml", "--site", "site.yaml"
    hardware.begin()

    with disk_that_hangs(run) as hang, full_pipe() as (_, full):
        with live(domain, tmp_path, *options, stderr=full) as process:
            hardware.until_it_pumps()
            nodes = process.nodes()
            for file in (*tmp_path.glob("*.yaml"), Path(hardware.file)):
                file.write_text("of: tomorrow\n")
            environ = Path(f"/proc/{nodes['pump']}/environ").read_text()
            shutil.rmtree(environ.partition("GREENROOF_ROS_COPIES=")[2].partition("\0")[0])
            for node in ("controller", "pump"):
                os.kill(nodes[node], signal.SIGKILL)
            wait_for(lambda: hardware.speed() == 0, 60, "a pump that stands")
            hardware.until_it_pumps()
            known = len(read_alarms(run))
            nodes, hung = process.nodes(), time.time()
            hang(True)
            while time.time() < hung + HANG_S:
                assert hardware.speed() > 0.9
            assert process.nodes() == nodes
            hang(False)
            wait_for(
                lambda: any(
                    alarm.part == "recording" and alarm.ended for alarm in read_alarms(run)
                ), 60, "the end of the hang",
            )
            new = {alarm.code for alarm in read_alarms(run)[known:]}
            os.kill(nodes["pump"], signal.SIGKILL)
            began = time.monotonic()
        # The nodes' end, and at most 2 s for output that no one reads.
        assert time.monotonic() - began < 30 and hardware.speed() == 0
        stamps = [stamp for stamp, _ in values_in(run / "bag", "/pump/flow") if stamp > hung]
        assert {value for _, value in values_in(run / "bag", "/pump/command")} == {0.0, 0.95}
    # The site's tick is 1 s; a busy machine leaves out a few.
    assert stamps == sorted(set(stamps)) and max(b - a for a, b in pairwise(stamps)) < 5
    assert HANG_S / 2 < sum(stamp < hung + HANG_S for stamp in stamps) < HANG_S + 2
    assert "not_recorded" in new and {"node_silent", "node_failed"}.isdisjoint(new)


@pytest.mark.graph
def test_a_new_site_is_watered_within_a_minute(domain: int, tmp_path: Path) -> None:
    """Neither a broker nor a forecast is needed, and Ctrl-C leaves no process behind.

    The tick of a new site is 60 s.
    """
    (tmp_path / "my_site.yaml").write_text("extends: site.yaml\ntau: 60.0\n")
    site = Process(
        domain, "simulators live", "--site", "my_site.yaml", "--state", "run", cwd=tmp_path
    )
    site.until_printed("running:", 90)
    devices = int(site.stdout().split("process ")[1].split()[0])

    def pumps() -> bool:
        status = subprocess.run(
            [sys.executable, "-m", "greenroof_ros", "status"], env=environment(domain),
            capture_output=True, text=True, check=False,
        )
        return "pump: running" in status.stdout

    wait_for(pumps, 60, "the watering")
    site.process.send_signal(signal.SIGINT)
    assert site.wait(60) == 0, site.stderr()
    assert not alive(devices)
    summary = summary_of(tmp_path / "run")
    assert (summary["status"], summary["alarms"]) == ("done", [])
