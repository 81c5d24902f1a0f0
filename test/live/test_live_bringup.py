"""A live site by bringup: levels and weather from the test's node, real processes, systemd."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from itertools import pairwise
from pathlib import Path

import pytest
from brokers import mosquitto, needs_mosquitto
from commands import run_command
from disks import disk_that_hangs, fill, full_pipe, small_disk
from graphs import Process, alive, environment, free_ports, summary_of, wait_for
from live_rig import QUICK, Hardware, live
from places import CONFIG
from ros_rig import FORECASTS, USUAL_EVAPOTRANSPIRATION, Site, newest, write_forecast
from rosbags.highlevel import AnyReader
from simulators import Simulator, serial_line

from greenroof_ros.base.files import read_yaml
from greenroof_ros.results.alarm_file import read_alarms

EXTERNAL = (
    "--controller", "mpc", "--sensors", "external", "--pump", "external", "--weather", "external",
)
# Of a low roof and a full cistern.
LEVELS = {"/cistern/level": 2.4, "/roof/level": 0.03, "/pump/flow": 0.0}


def values_in(bag: Path, topic: str) -> list[tuple[float, float]]:
    """Return a topic's values in a bag, each with its time (s since 1970)."""
    with AnyReader([bag]) as reader:
        return [
            (stamp / 1e9, reader.deserialize(raw, connection.msgtype).data)
            for connection, stamp, raw in reader.messages() if connection.topic == topic
        ]


class Systemd:
    """What a service manager receives, with the time of each datagram."""

    def __init__(self, path: Path) -> None:
        self.heard: list[tuple[float, list[str]]] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        while True:
            data = self._socket.recv(4096)
            self.heard.append((time.monotonic(), data.decode().splitlines()))

    def lines(self) -> list[str]:
        return [line for _, lines in list(self.heard) for line in lines]

    def times(self, line: str) -> list[float]:
        return [at for at, lines in list(self.heard) if line in lines]


def test_a_site_is_kept_up_and_systemd_told(
    domain: int, tmp_path: Path, site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ready when the sensors are there, alive all the time.

    The start does not wait for a forecast whose file and directory are missing: on/off pumps, and
    the loss is an alarm until it ends.
    """
    systemd = Systemd(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    # A service's user has no home.
    monkeypatch.setenv("HOME", "/proc/nohome")
    commands = site.listen("/pump/command")
    (tmp_path / "nodes.yaml").write_text(QUICK)
    file = tmp_path / "from_service" / "forecast.csv"
    options = (
        "--controller", "mpc", "--max-command", "0.4", "--sensors", "external",
        "--pump", "external", "--forecast", "from_service/forecast.csv", "--bag-limit", "50",
        "--node-parameters", "nodes.yaml",
    )
    with live(domain, tmp_path, *options) as process:
        site.until(lambda: systemd.times("EXTEND_TIMEOUT_USEC=30000000"), 60, "the start")
        for missing in ("  /mpc: inputs: /cistern/level has not", "  /weather: forecast: "):
            site.until(lambda missing=missing: missing in process.stderr(), 60, missing)
        assert "READY=1" not in systemd.lines()
        assert not any(value for _, value in commands)
        site.values = {**LEVELS, "/gauge/temperature": 8.0}
        site.until(lambda: "READY=1" in systemd.lines(), 60, "READY=1")
        site.until(lambda: newest(commands) == 1.0, 90, "on/off")
        # Only the levels: command and pump state may still be of other moments.
        running = "\nrunning: cistern 2.400 m, roof 0.0300 m\n"
        site.until(lambda: running in process.stderr(), 90, "the end of the start")
        first_line = f": Weather: there is no forecast; {file} cannot be read: No such"
        site.until(lambda: first_line in process.stderr(), 60, "the alarm")
        file.parent.mkdir()
        write_forecast(file, timedelta(minutes=1), 0.0, 12.0)
        site.until(lambda: 0 < newest(commands) <= 0.4, 60, "mpc")
        site.until(lambda: " s: Weather\n" in process.stderr(), 60, "its end")
        beats = systemd.times("WATCHDOG=1")
        # WatchdogSec of examples/greenroof.service.
        assert max(b - a for a, b in pairwise(beats)) < 10
    wait_for(lambda: "STOPPING=1" in systemd.lines(), 60, "STOPPING=1")
    assert systemd.lines().count("READY=1") == 1
    assert "STATUS=running: cistern 2.400 m, roof 0.0300 m" in systemd.lines()
    summary = summary_of(tmp_path / "run")
    assert (summary["status"], summary["reason"]) == ("done", "interrupted by SIGTERM")
    alarms = {(alarm["node"], alarm["part"]): alarm for alarm in summary["alarms"]}
    lost, consequence = alarms["/weather", "forecast"], alarms["/mpc", "forecast"]
    assert lost["since"] < lost["ended"] and not lost["follows"]
    assert (lost["code"], consequence["level"]) == ("forecast_missing", "warn")
    printed = process.stderr()
    assert "all nodes have joined" in printed
    # Nothing for a normal start, nor for a return, although its inputs first have to recover.
    assert len(alarms) == 2
    assert printed.endswith("are being stopped\ndone, with 1 alarm\n")
    with AnyReader([tmp_path / "run" / "bag"]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections if c.msgcount}
        stamps = [stamp / 1e9 for _, stamp, _ in reader.messages()]
    assert counts.keys() == {
        *LEVELS, *FORECASTS, "/gauge/temperature", "/weather/frost", "/weather/precipitation",
        "/weather/evapotranspiration", "/pump/command", "/pump/hold", "/pump/state",
        "/diagnostics", "/controller/cost", "/controller/solver_status", "/alarms",
    }
    assert counts["/pump/command"] == pytest.approx(len(commands), abs=30)
    assert stamps == sorted(stamps)
    assert abs(stamps[-1] - time.time()) < 60


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
    domain: int, tmp_path: Path, site: Site, hardware: Hardware
) -> None:
    """The controller pumps and the roof rises; an unstoppable drive is reported as running.

    Everything missing at the start has a line with what to do, and the list shrinks as things
    arrive. In a namespace; at the end the drive's own timeout is off, so it stops nothing.
    """
    options = hardware.be_a_site()
    levels = site.watcher.collect("/roof/level", namespace="/site1")
    options += ("--namespace", "site1", "--peer-limit", "60")

    def missing() -> str:
        return process.stderr().rpartition("missing:\n")[2]

    with live(domain, tmp_path, *options, code=1) as process:
        for reason in (
            "/roof_sensor: sensor: tcp://127.0.0.1:", ", device 1: cannot connect. The sensor",
            "is older than 2 h. There is no forecast for the current time, so the roof is watered",
        ):
            process.until_printed(reason)
        # It lists neither consequences of these nor a drive that is there.
        lacking = {line.partition(":")[0] for line in missing().splitlines()}
        nodes = "cistern_sensor", "roof_sensor", "weather"
        assert lacking <= {f"  /site1/{node}" for node in nodes}
        write_forecast(tmp_path / "forecast.csv", timedelta(minutes=1), 0.0, 12.0)
        wait_for(lambda: "/weather: " not in missing(), 60, "the forecast")
        assert "/roof_sensor: " in missing()
        hardware.begin()
        site.until(lambda: hardware.speed() > 0.9, 60, "the pump")
        assert levels[0] == pytest.approx(0.0457 / 1.3, abs=1e-3)  # the paper's low roof
        site.until(lambda: levels[-1] > levels[0] + 0.0005, 60, "a roof that rises")
        # A pump node that hangs keeps the drive running until bringup stops it.
        os.kill(process.nodes()["pump"], signal.SIGSTOP)
        site.until(lambda: hardware.speed() == 0, 60, "the stop of a pump node that hangs")
        site.until(lambda: hardware.speed() > 0.9, 60, "the pump after that")
        hardware.inject("timeout_off")
        hardware.inject("refused")
    assert hardware.speed() > 0.9
    printed = process.stderr()
    assert "did not stop the drive; bringup commanded the drive to stop" in printed
    assert "waiting for the pump to come to a standstill" in printed
    assert "error: interrupted by SIGTERM; bringup could not stop the drive: " in printed
    assert "THE PUMP MAY BE RUNNING" in printed
    summary = summary_of(tmp_path / "run")
    assert summary["status"] == "failed" and "THE PUMP MAY BE RUNNING" in summary["reason"]
    assert (tmp_path / "run" / "pump.json").is_file()


def test_both_level_sensors_on_one_serial_line(
    domain: int, tmp_path: Path, hardware: Hardware
) -> None:
    """The pump stops while their process is dead, and for one that is silent next to the other.

    A dead process is one alarm, and the sensor that answers is never lost.
    """
    options = hardware.be_a_site()
    with serial_line() as ends:
        for name, end in zip(("simulated", "sensors"), ends, strict=True):
            cistern, roof = (CONFIG / "sensors.yaml").read_text().split("\nroof:")
            text = f"{cistern}\nroof:{roof.replace('device_id: 1', 'device_id: 2')}"
            (tmp_path / f"{name}.yaml").write_text(re.sub(r"tcp://[\d.:]+", end, text))
        with Simulator(
            "site_simulator", "--sensors", str(tmp_path / "simulated.yaml"), "--workbench", "0",
            "--drive-at", hardware.workbench, "--rain", "0", "--initial", "high-low",
        ) as tanks:
            write_forecast(tmp_path / "forecast.csv", timedelta(minutes=5), 0.0, 12.0)
            with live(domain, tmp_path, *options) as process:
                hardware.until_it_pumps()
                # Bringup, suspended, cannot replace it before the levels are too old.
                with suspended(process.process.pid):
                    os.kill(process.nodes()["station"], signal.SIGKILL)
                    wait_for(lambda: hardware.speed() == 0, 60, "a pump that stands")
                process.until_printed("station: ended (SIGKILL); starts again in 1 s")
                hardware.until_it_pumps()
                process.until_printed(": Alarms: the program of the sensors, the weather, the rec")
                tanks.inject("roof_silent")
                process.until_printed(": Roof sensor: the sensor sends nothing, or an impossible v")
                wait_for(lambda: hardware.speed() == 0, 60, "a pump that stands")
                tanks.inject("none")
                hardware.until_it_pumps()
    codes = [
        (alarm["node"], alarm["code"]) for alarm in summary_of(tmp_path / "run")["alarms"]
        if alarm["node"].endswith(("sensor", "alarms"))
    ]
    assert codes == [("/alarms", "station_restarted"), ("/roof_sensor", "sensor_lost")]


@needs_mosquitto
def test_a_start_with_slow_gauges_is_no_alarm(
    domain: int, tmp_path: Path, hardware: Hardware
) -> None:
    """Rain gauge and thermometer publish every 12 s, a fifth of their ``max_age``.

    A drive simulator that a busy machine lets answer too late is not what is tested here.
    """
    options = hardware.be_a_site()[:-2]  # no time is shortened
    with mosquitto(tmp_path) as broker:
        text = (CONFIG / "sensors_mqtt.yaml").read_text()
        (tmp_path / "sensors.yaml").write_text(
            text.replace("mqtt://127.0.0.1:1883", broker.address)
        )
        hardware.begin()
        with live(domain, tmp_path, *options) as process:
            process.until_printed("running: cistern ", 120)
            hardware.until_it_pumps()
            time.sleep(15)
    codes = {alarm["code"] for alarm in summary_of(tmp_path / "run")["alarms"]}
    codes -= {"drive_lost", "start_failed"}
    assert codes == {"drive_file_unverified"}  # the test's drive file differs from the shipped one


def test_its_status_is_an_alarm_while_a_dead_pump_node_is_not_replaced(
    domain: int, tmp_path: Path, hardware: Hardware
) -> None:
    """A node that died earlier never reports. Here bringup is suspended, and cannot replace it.

    The nodes that replace dead ones read the drive and the parameters of the site's start, whatever
    their files hold since.
    """
    files = [Path(hardware.file), tmp_path / "onoff.yaml", tmp_path / "nodes.yaml"]
    files[1].write_text("/**/onoff:\n  ros__parameters:\n    fraction: 0.95\n")
    options = (*hardware.be_a_site(), "--parameters", "onoff.yaml")

    def status() -> tuple[int, list[str]]:
        done = run_command("status", cwd=tmp_path, env=environment(domain))
        return done.returncode, done.stdout.splitlines()

    with live(domain, tmp_path, *options) as process:
        hardware.begin()
        hardware.until_it_pumps()
        wait_for(lambda: status()[0] < 2, 60, "a site without alarms")
        for file in files:
            file.write_text("of: tomorrow\n")
        with suspended(process.process.pid):
            for node in ("controller", "pump"):
                os.kill(process.nodes()[node], signal.SIGKILL)
            code, lines = status()
        assert code == 2, lines
        assert len(lines) <= 15
        assert any(line.startswith("Pump           unknown") for line in lines)
        hardware.until_it_pumps()
        wait_for(lambda: status()[0] < 2, 60, "the site as before")
    commands = values_in(tmp_path / "run" / "bag", "/pump/command")
    assert {value for _, value in commands} == {0.0, 0.95}


# Longer than a recorder waits for a flush (s), and for one that lasts.
HANG_S = 30


def test_a_disk_that_hangs_and_a_terminal_at_ctrl_s_stop_no_pump(
    domain: int, tmp_path: Path, hardware: Hardware
) -> None:
    """While nothing can be written or printed, the pump keeps running, and no node ends.

    Messages wait in memory, and are in the bag afterwards with their times.
    """
    options = hardware.be_a_site()
    hardware.begin()
    run = tmp_path / "run"
    with disk_that_hangs(run) as hang, full_pipe() as (_, full):
        with live(domain, tmp_path, *options, stderr=full) as process:
            hardware.until_it_pumps()
            nodes = process.nodes()
            hung = time.time()
            hang(True)
            assert min(hardware.speeds_for(HANG_S)) > 0.9
            assert process.nodes() == nodes
            hang(False)
            wait_for(
                lambda: any(
                    alarm.part == "recording" and alarm.ended for alarm in read_alarms(run)
                ), 60, "the end of the hang",
            )
            began = time.monotonic()
        # The nodes' end, and at most 2 s for output that no one reads.
        assert time.monotonic() - began < 30
        summary = summary_of(run)
        stamps = [stamp for stamp, _ in values_in(run / "bag", "/pump/flow")]
    # The site's tick is 1 s; a busy machine leaves out a few.
    assert stamps == sorted(set(stamps)) and max(b - a for a, b in pairwise(stamps)) < 5
    assert HANG_S / 2 < sum(hung < stamp < hung + HANG_S for stamp in stamps) < HANG_S + 2
    alarms = {(alarm["node"], alarm["code"]) for alarm in summary["alarms"]}
    assert ("/recorder", "not_recorded") in alarms
    assert not any(code in ("not_heard", "node_failed") for _, code in alarms)


def test_nodes_read_what_the_site_was_started_with_on_a_full_disk(
    domain: int, tmp_path: Path, site: Site
) -> None:
    """Neither copies of an earlier start nor what is edited later, also after a restart.

    After a power cut no one is there to make room. A missing recording is an alarm, and does not
    end the recorder. In each file the site of before had another value: twice the evaporation, and
    other ports of the sensors. The nodes' copies may be removed meanwhile, and the broker's login
    be one that others may read.
    """
    disk, sensors, site_file = (tmp_path / name for name in ("run", "sensors.yaml", "site.yaml"))
    evapotranspiration = site.listen("/weather/evapotranspiration")
    here, before = free_ports(2), free_ports(2)
    login = tmp_path / "login.yaml"
    login.write_text("username: u\npassword: p\n")
    login.chmod(0o600)
    thermometer = (
        f"thermometer:\n  address: mqtt://127.0.0.1:1/t\n  login: {login}\n  scale: 1.0\n"
        "  low: -40.0\n  high: 60.0\n  median: 1\n  max_age: 60.0\n"
    )

    def write(sensors: Path, site_file: Path, ports: list[int], factor: float) -> None:
        text = (CONFIG / "sensors.yaml").read_text()
        text = text.replace("5030", str(ports[0])).replace("5031", str(ports[1]))
        sensors.write_text(text + thermometer)
        values = read_yaml(CONFIG / "site.yaml")["monthly_evapotranspiration"]
        site_file.write_text(
            f"extends: {CONFIG / 'site.yaml'}\n"
            f"monthly_evapotranspiration: {[factor * value for value in values]}\n"
        )

    def device() -> str:
        status = site.diagnoses.get("/roof_sensor: sensor")
        return "" if status is None else status.hardware_id

    with small_disk(disk, "64k"):
        (disk / "log").mkdir()
        old = disk / "configuration"
        for name in ("sensors", "site"):
            (old / name).mkdir(parents=True)
        write(old / "sensors" / "sensors.yaml", old / "site" / "site.yaml", before, 2.0)
        fill(disk / "other")
        write(sensors, site_file, here, 1.0)
        options = (
            "--controller", "onoff", "--sensors", "sensors.yaml", "--pump", "external", "--site",
            "site.yaml",
        )
        with live(domain, tmp_path, *options) as process:
            process.until_printed("for 0 MB of the bag, which is less than --bag-limit 10000", 60)
            process.until_printed("the configuration used for this start is not saved", 60)
            process.until_printed(": Recorder: nothing is recorded: ", 60)
            for restart in (True, False):
                site.until(lambda: f":{here[1]}" in device(), 60, "the sensor of this start")
                site.until(lambda: evapotranspiration, 60, "the evapotranspiration")
                assert {value for _, value in evapotranspiration} <= USUAL_EVAPOTRANSPIRATION
                if not restart:
                    break
                write(sensors, site_file, before, 2.0)
                login.chmod(0o644)
                environ = Path(f"/proc/{process.nodes()['station']}/environ").read_text()
                shutil.rmtree(environ.partition("GREENROOF_ROS_COPIES=")[2].partition("\0")[0])
                os.kill(process.nodes()["station"], signal.SIGKILL)
                site.until(lambda: "station" in process.nodes(), 60, "a restart")
                site.diagnoses.clear()
                evapotranspiration.clear()
            assert not process.stderr().count("exit code")
        assert str(before[1]) in (old / "sensors" / "sensors.yaml").read_text()


def test_a_site_whose_configuration_cannot_be_written_does_not_start(
    domain: int, tmp_path: Path
) -> None:
    """Memory for files that is full, in a mount namespace of its own."""
    command = (
        "mount -t tmpfs -o size=4k full /dev/shm && exec "
        + shlex.join([sys.executable, "-m", "greenroof_ros", "live", *EXTERNAL])
    )
    ended = subprocess.run(
        ["unshare", "--mount", "sh", "-c", command], cwd=tmp_path, env=environment(domain),
        capture_output=True, text=True, timeout=120, check=False,
    )
    if "unshare" in ended.stderr or "mount:" in ended.stderr:
        pytest.skip("only root can mount memory that is full")
    assert ended.returncode == 1
    assert re.fullmatch(
        r"error: /dev/shm/\S+: No space left on device", ended.stderr.splitlines()[-1]
    ), ended.stderr


def test_a_site_without_a_forecast(domain: int, tmp_path: Path, site: Site) -> None:
    """On/off pumps as soon as a thermometer shows that there is no frost; without alarms."""
    commands, rain = site.listen("/pump/command"), site.listen("/weather/precipitation")
    evapotranspiration = site.listen("/weather/evapotranspiration")
    (tmp_path / "nodes.yaml").write_text(f"{QUICK}    gauge_limit: 1.0\n")
    options = (
        "--sensors", "external", "--pump", "external", "--controller", "onoff",
        "--thermometer", "external", "--node-parameters", "nodes.yaml",
    )
    with live(domain, tmp_path, *options) as process:
        site.values = dict(LEVELS)
        frost = "  /weather: frost: the temperature is unknown, so there may be frost (no"
        site.until(lambda: frost in process.stderr(), 60, "what is missing")
        assert "/gauge/temperature" in process.stderr()
        site.until(lambda: len(commands) > 4, 60, "commands")
        assert not any(value for _, value in commands)
        assert newest(evapotranspiration) in USUAL_EVAPOTRANSPIRATION and not rain
        site.values |= {"/gauge/temperature": 8.0, "/gauge/precipitation": 5e-6}
        site.until(lambda: newest(rain) == 5e-6, 60, "rain")
        site.until(lambda: newest(commands) == 1.0, 60, "a command")
        site.until(lambda: "running: cistern 2.400 m" in process.stderr(), 60, "the end of it")
        assert "/weather: forecast" not in site.diagnoses
    summary = summary_of(tmp_path / "run")
    assert (summary["status"], summary["alarms"]) == ("done", [])
    assert summary["forecast"] is None
    assert "forecast:" not in process.stderr()


def test_a_controller_that_ends_its_process(domain: int, tmp_path: Path, site: Site) -> None:
    """On/off waters in its place after its restarts; an alarm names file and line of the class."""
    commands, file = site.listen("/pump/command"), tmp_path / "mine.py"
    file.write_text(
        "import os\nfrom greenroof_ros.controllers.onoff import OnOff\n\nclass Mine(OnOff):\n"
        "    parameters = ()\n    def __init__(self, site): super().__init__(site, 0.3)\n"
        "    def command(self, *inputs):\n        if os.path.exists('fault'): os._exit(1)\n"
        "        return super().command(*inputs)\n"
    )
    (tmp_path / "nodes.yaml").write_text(QUICK)
    options = (*EXTERNAL, "--controller", "mine:Mine", "--node-parameters", "nodes.yaml")
    with live(domain, tmp_path, *options, command=("restarting", "1")):
        site.values = {**LEVELS, "/weather/frost": 0.0}
        site.until(lambda: newest(commands) == 0.3, 60, "its commands")
        (tmp_path / "fault").touch()
        site.until(lambda: newest(commands) == 1.0, 60, "on/off")
        site.during(2.0)
        assert {value for _, value in commands} == {0.0, 0.3, 1.0}
    (alarm,) = (
        alarm for alarm in summary_of(tmp_path / "run")["alarms"]
        if alarm["code"] == "controller_failed"
    )
    assert (alarm["node"], alarm["part"]) == ("/mine", "command")
    assert f"ended (exit code 1) (mine:Mine is in {file}, line 7)" in alarm["sentence"]


def test_a_site_that_is_stopped_while_it_starts_ends_with_0(domain: int, tmp_path: Path) -> None:
    """Before any node is there, and while sensors are missing and it waits for them."""
    for early in (True, False):
        with live(domain, tmp_path, *EXTERNAL) as process:
            wait_for((tmp_path / "run").exists, 60, "the directory")
            if not early:
                process.until_printed("missing:", 60)
        shutil.rmtree(tmp_path / "run")


def test_a_killed_bringup_leaves_no_node(domain: int, tmp_path: Path) -> None:
    """The next bringup continues in the same directory, with a new file in the bag."""
    with live(domain, tmp_path, *EXTERNAL) as process:
        wait_for(lambda: len(process.nodes()) == 3, 60, "nodes")
        wait_for((tmp_path / "run" / "bag" / "bag_0.mcap").exists, 60, "a bag")
        nodes = list(process.nodes().values())
        process.process.kill()
        wait_for(lambda: not any(map(alive, nodes)), 60, "the end of the nodes")
        assert summary_of(tmp_path / "run")["status"] == "running"
        again = Process(domain, "bringup.live", "--state", "run", *EXTERNAL, cwd=tmp_path)
        wait_for((tmp_path / "run" / "bag" / "bag_1.mcap").exists, 60, "its next file")
        process.process = again.process
    with AnyReader([tmp_path / "run" / "bag"]) as reader:
        assert reader.message_count > 0
