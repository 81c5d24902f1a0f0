"""A live site by bringup: levels and weather from the test's node, real processes, systemd."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from itertools import pairwise
from pathlib import Path

import pytest
from commands import run_command
from disks import disk_that_hangs, fill, full_pipe, small_disk
from graphs import Process, alive, environment, summary_of, wait_for
from live_rig import QUICK, Hardware, live
from places import CONFIG
from ros_rig import OK, Site, newest, write_forecast
from rosbags.highlevel import AnyReader

from greenroof_ros.interface.alarm import read_alarms

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


class Systemd:
    """What a service manager receives, with the time of each line."""

    def __init__(self, path: Path) -> None:
        self.lines: list[tuple[float, str]] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        while True:
            self.lines.append((time.monotonic(), self._socket.recv(4096).decode()))

    def times(self, line: str) -> list[float]:
        return [at for at, text in list(self.lines) if text == line]


def test_a_site_is_kept_up_and_systemd_told(
    domain: int, tmp_path: Path, site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ready at once, alive all the time.

    The start does not wait for a forecast whose file and directory are missing: on/off pumps, and
    the loss is an alarm until it ends.
    """
    systemd = Systemd(tmp_path / "notify")
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
        assert systemd.times("READY=1") and not any(value for _, value in commands)
        site.values = {**LEVELS, "/gauge/temperature": 8.0}
        site.until(lambda: newest(commands) == 1.0, 90, "on/off")
        first_line = ": Weather: no forecast covers the current time"
        until_printed(process, site, f"\n{running}\n", first_line)
        file.parent.mkdir()
        write_forecast(file, timedelta(minutes=1), 0.0, 12.0)
        site.until(lambda: 0 < newest(commands) <= 0.4, 60, "mpc")
        until_printed(process, site, " s: Weather: no forecast covers")
        beats = systemd.times("WATCHDOG=1")
        assert max(b - a for a, b in pairwise(beats)) < 10  # WatchdogSec of greenroof.service
    wait_for(lambda: systemd.times("STOPPING=1"), 60, "STOPPING=1")
    assert systemd.times(f"STATUS={running}")
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
        counts = {name: topic.msgcount for name, topic in reader.topics.items()}
    assert counts["/pump/command"] == pytest.approx(len(commands), abs=30)
    assert 2 <= counts["/alarms"] < len(commands) / 2  # only changes
    assert "/diagnostics" not in counts


@contextmanager
def suspended(pid: int) -> Iterator[None]:
    """Suspend a process."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@pytest.fixture
def hardware(domain: int, tmp_path: Path) -> Iterator[Hardware]:
    hardware = Hardware(domain, tmp_path)
    yield hardware
    hardware.end()


def test_a_live_site_with_drive_and_sensors(
    domain: int, tmp_path: Path, hardware: Hardware
) -> None:
    """The controller pumps; an unstoppable drive is reported as running.

    Everything missing at the start has a line with what to do. In a namespace; at the end the
    drive's own timeout is off, so it stops nothing.
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
        # A pump node that hangs keeps the drive running until bringup stops it.
        os.kill(process.nodes()["pump"], signal.SIGSTOP)
        hardware.until_it_stands()
        hardware.until_it_pumps()
        hardware.inject("timeout_off")
        hardware.inject("refused")
    assert hardware.speed() > 0.9
    summary = summary_of(tmp_path / "run")
    for words in (
        "did not stop the drive; bringup commanded the drive to stop",
        "error: interrupted by SIGTERM; bringup could not stop the drive: ",
    ):
        assert words in process.stderr()
    for text in (process.stderr(), summary["reason"]):
        assert "THE PUMP MAY BE RUNNING" in text
    assert summary["status"] == "failed" and (tmp_path / "run" / "pump.json").is_file()


# Longer than a recorder waits for a flush (s), and for one that lasts.
HANG_S = 30


def test_what_hangs_and_dies_around_a_pump_that_runs(
    domain: int, tmp_path: Path, hardware: Hardware
) -> None:
    """A disk that hangs, and a terminal at Ctrl-S, stop no pump and end no node; messages wait in
    memory, and are in the bag afterwards with their times.

    The pump stops without the station, and status has an alarm without a pump node. What replaces
    dead processes reads the files of the site's start, whatever they hold since, and if the copies
    were removed. The station's restart is one alarm. The pump is off at the end without a pump
    node.
    """
    (tmp_path / "onoff.yaml").write_text("/**/onoff:\n  ros__parameters:\n    fraction: 0.95\n")
    (tmp_path / "site.yaml").write_text(f"extends: {CONFIG / 'site.yaml'}\n")
    options, run = hardware.be_a_site(), tmp_path / "run"
    options += "--parameters", "onoff.yaml", "--site", "site.yaml"
    hardware.begin()

    def status() -> tuple[int, list[str]]:
        done = run_command("status", cwd=tmp_path, env=environment(domain))
        return done.returncode, done.stdout.splitlines()

    with disk_that_hangs(run) as hang, full_pipe() as (_, full):
        with live(domain, tmp_path, *options, stderr=full) as process:
            hardware.until_it_pumps()
            wait_for(lambda: status()[0] < 2, 60, "a site without alarms")
            nodes = process.nodes()
            for file in (*tmp_path.glob("*.yaml"), Path(hardware.file)):
                file.write_text("of: tomorrow\n")
            environ = Path(f"/proc/{nodes['pump']}/environ").read_text()
            shutil.rmtree(environ.partition("GREENROOF_ROS_COPIES=")[2].partition("\0")[0])
            with suspended(process.process.pid):
                for node in ("controller", "pump"):
                    os.kill(nodes[node], signal.SIGKILL)
                code, lines = status()
            assert (code, len(lines) <= 15) == (2, True), lines
            assert any(line.startswith("Pump           unknown") for line in lines)
            hardware.until_it_pumps()
            with suspended(process.process.pid):
                os.kill(nodes["station"], signal.SIGKILL)
                hardware.until_it_stands()
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
        codes = [alarm["code"] for alarm in summary_of(run)["alarms"]]
        stamps = [stamp for stamp, _ in values_in(run / "bag", "/pump/flow") if stamp > hung]
        assert {value for _, value in values_in(run / "bag", "/pump/command")} == {0.0, 0.95}
    # The site's tick is 1 s; a busy machine leaves out a few.
    assert stamps == sorted(set(stamps)) and max(b - a for a, b in pairwise(stamps)) < 5
    assert HANG_S / 2 < sum(stamp < hung + HANG_S for stamp in stamps) < HANG_S + 2
    assert "not_recorded" in new and {"node_silent", "node_failed"}.isdisjoint(new)
    assert codes.count("station_restarted") == 1 and "sensor_lost" not in codes


def test_a_site_lives_on_a_full_disk_and_pumps_nothing(
    domain: int, tmp_path: Path, site: Site
) -> None:
    """After a power cut no one is there to make room. What cannot save a hold must not pump.

    A missing recording is an alarm, and does not end the recorder.
    """
    commands, disk = site.be_dry(), tmp_path / "run"
    with small_disk(disk, "64k"):
        (disk / "log").mkdir()
        fill(disk / "other")
        with live(domain, tmp_path, *EXTERNAL, "--weather", "external") as process:
            until_printed(process, site, "the file is not written", ": Recorder: nothing is being")
            site.until(site.shows("/mpc: inputs", OK), 60, "good inputs")
            site.during(3)
            assert {value for _, value in commands} == {0.0}
            assert not process.stderr().count("exit code")


@pytest.mark.parametrize("numbers", [[signal.SIGINT, signal.SIGINT], [signal.SIGKILL]])
def test_the_pump_is_off_and_no_process_is_left_at_any_end_of_bringup(
    domain: int, tmp_path: Path, hardware: Hardware, numbers: list[signal.Signals]
) -> None:
    options = hardware.be_a_site()
    hardware.begin()
    bringup = Process(domain, "bringup.live", "--state", "run", *options, cwd=tmp_path)
    hardware.until_it_pumps()
    pids = {*bringup.nodes().values(), bringup.process.pid}
    assert len(pids) == 4
    for number in numbers:
        bringup.process.send_signal(number)
    hardware.until_it_stands()
    bringup.wait(60)
    wait_for(lambda: not any(map(alive, pids)), 60, "the end of the nodes")
    time.sleep(2.0)
    assert hardware.speed() == 0
