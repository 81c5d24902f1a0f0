"""The simulated site as a program: two tanks behind level sensors, and the drive's true speed."""

from __future__ import annotations

import csv
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from graphs import free_ports
from places import CONFIG
from simulators import Bus, Simulator, refusal, until

from greenroof_ros import site_simulator

# The cistern just up to its outlet of 3 m, the roof at 5 cm; nothing falls, nothing evaporates.
STILL = ("--cistern", "75", "--roof", "3.44", "--rain", "0", "--constant-evapotranspiration", "0")


def sensors_file(directory: Path, cistern: int, roof: int) -> Path:
    """Write a file of sensors on ports of our own."""
    text = (CONFIG / "sensors.yaml").read_text()
    file = directory / "sensors.yaml"
    file.write_text(text.replace(":5030", f":{cistern}").replace(":5031", f":{roof}"))
    return file


class Site:
    """A running site: its program, a connection to each sensor, and its table."""

    def __init__(self, program: Simulator, cistern: Bus, roof: Bus, table: Path) -> None:
        self.program, self.cistern, self.roof, self._table = program, cistern, roof, table

    def rows(self) -> list[dict[str, float]]:
        """Return the whole lines of the table, but the name of the fault."""
        lines = self._table.read_text().rpartition("\n")[0].splitlines()
        return [
            {key: float(value) for key, value in row.items() if key != "fault"}
            for row in csv.DictReader(lines)
        ]

    def at_tick(self, tick: int) -> dict[str, float]:
        """Return the line of a tick, when it has come."""
        until(lambda: len(self.rows()) >= tick, 10)
        return self.rows()[tick - 1]


@contextmanager
def site(directory: Path, *options: str) -> Iterator[Site]:
    cistern, roof = free_ports(2)
    file, table = sensors_file(directory, cistern, roof), directory / "levels.csv"
    with Simulator(
        "site_simulator", "--sensors", str(file), "--workbench", "0", "--output", str(table),
        *options,
    ) as program, Bus(cistern) as first, Bus(roof) as second:
        yield Site(program, first, second, table)


def test_levels_move_by_the_volume_that_the_drives_speed_stands_for(tmp_path: Path) -> None:
    """At 0.8 of rated speed, by hand, Eqs. (3b) and (3c) with the affinity laws.

    Head 0.64 x 55.2 + 3 - 16 = 22.328 m; resistance (3.56 x 18.4 / 0.2 + 0.6) / (2 x 9.81 x
    0.0314159^2) + 5.78e5 = 594945 s2/m5; flow (22.328 / 594945)^0.5 = 6.1261e-3 m3/s. In 40 s that
    is 0.2450 m3, and the level falls by 9.8 mm of 25 m2, which takes 0.02 % from the flow; the roof
    of 68.8 m2 rises by 3.56 mm.
    """
    with Simulator(
        "drive_simulator", "--drive", "abb_acs880", "--port", "0", "--workbench", "0", "--fault",
        "stuck_running=8000",
    ) as drive:
        at = f"tcp://127.0.0.1:{drive.ports[1]}"
        until(lambda: drive.speed() == pytest.approx(0.8))
        with site(tmp_path, *STILL, "--drive-at", at, "--factor", "40") as running:
            first, last = running.at_tick(1), running.at_tick(40)
            cistern = running.cistern.read(0, function=4)
            roof = running.roof.read(0, function=4)
            now = running.rows()[-1]
            running.program.inject("burst_pipe")
            time.sleep(0.1)
            rows = running.rows()
            before = rows[-1]
            after = running.at_tick(len(rows) + 20)
            drive.inject("none")  # the motor coasts
            until(lambda: running.rows()[-1]["speed"] == 0)
            until(lambda: running.rows()[-1]["pump_flow_m3_per_s"] == 0)
            at_rest = running.rows()[-1]["pumped_m3"]
            time.sleep(0.2)
            assert running.rows()[-1]["pumped_m3"] == at_rest
            drive.end()
            until(lambda: running.rows()[-1]["speed"] == 0)
        assert "the pump counts as standing" in running.program.said
    assert (first["time_s"], last["time_s"]) == (1, 40)
    assert first["pump_flow_m3_per_s"] == pytest.approx(6.1261e-3, rel=1e-4)
    assert last["pumped_m3"] == pytest.approx(0.2450, rel=5e-4)
    assert last["cistern_level_m"] == pytest.approx(3 - 0.2450 / 25, abs=1e-5)
    assert last["roof_level_m"] == pytest.approx(0.05 + 0.2450 / 68.8, abs=1e-5)
    # Through a burst pipe water leaves the cistern and does not arrive.
    lost = after["pumped_m3"] - before["pumped_m3"]
    assert lost > 0.1 and after["roof_level_m"] == before["roof_level_m"]
    assert after["cistern_level_m"] == pytest.approx(before["cistern_level_m"] - lost / 25)
    # Registers in 0.1 mm; a tick or two may lie between reading them and the table.
    assert cistern == pytest.approx(now["cistern_level_m"] * 1e4, abs=8)
    assert roof == pytest.approx(now["roof_level_m"] * 1e4, abs=4)


@pytest.mark.parametrize(
    ("options", "tick", "expected"),
    [
        # 36 mm/h is 1e-5 m/s, 86.4 mm a day 1e-6 m/s: the roof rises by 9e-6 m each second. The
        # cistern's inlet of 0.29225 m2 brings 2.9225e-6 m3/s into 25 m2; it began below its outlet.
        # A leak: 2000 ml/s out of 25 m2 are 0.08 mm/s.
        (
            ("--cistern", "50", "--roof", "3.44", "--rain", "36", "--constant-evapotranspiration",
             "86.4", "--fault", "leak=2000"),
            200,
            {"roof_level_m": 0.05 + 200 * 9e-6, "pumped_m3": 0,
             "cistern_level_m": 2 + 200 * (2.922467e-6 / 25 - 8e-5)},
        ),
        # The weather file's: on 7 July 2021 from 04:00 to 05:00 Toronto had 3.0 mm of rain.
        (("--start", "2021-07-07T04:00"), 3, {"precipitation_m_per_s": 3.0 / 3.6e6}),
    ],
    ids=["constants and a leak", "weather file"],
)
def test_levels_follow_weather_and_leak(
    tmp_path: Path, options: tuple[str, ...], tick: int, expected: dict[str, float]
) -> None:
    with site(tmp_path, *options, "--factor", "100") as running:
        row = running.at_tick(tick)
    for key, value in expected.items():
        assert row[key] == pytest.approx(value, rel=5e-9), key


def test_sensor_faults_change_what_one_sensor_says_and_no_level(tmp_path: Path) -> None:
    """The roof rises by 1 count (0.1 mm) in 2 s of rain at 180 mm/h; 100 times as fast here."""
    with site(
        tmp_path, "--cistern", "50", "--roof", "3.44", "--rain", "180",
        "--constant-evapotranspiration", "0", "--factor", "100",
    ) as running:

        def roof() -> int:
            return running.roof.read(0, function=4)

        def true() -> float:
            return running.rows()[-1]["roof_level_m"] * 1e4

        first = roof()
        until(lambda: roof() > first + 5)
        running.program.inject("roof_frozen")
        frozen = roof()
        time.sleep(0.3)
        assert roof() == frozen < true() - 5
        assert running.cistern.read(0, function=4) == pytest.approx(20000, abs=5)

        running.program.inject("roof_absurd", 1234)
        assert roof() == 1234
        running.program.inject("roof_noisy", 200)
        readings = [roof() - true() for _ in range(40)]
        assert 60 < max(readings) < 1200 and -1200 < min(readings) < -60
        running.program.inject("roof_drifting", 600)  # 10 counts a second of the site's time
        time.sleep(0.3)
        assert 100 < roof() - true() < 1000
        running.program.inject("roof_silent")
        assert running.roof.ask("0001 0000 0006 01 04 0000 0001", 0.2) == ""
        assert running.cistern.read(0, function=4) == pytest.approx(20000, abs=5)
        running.program.inject("none")
        assert roof() == pytest.approx(true(), abs=5)


def test_both_sensors_may_be_on_one_line(tmp_path: Path) -> None:
    """Devices 1 and 2 behind one port, as on a serial line with a gateway; one may be silent.

    Without --drive-at it says at once that the pump never runs.
    """
    port = free_ports(1)[0]
    file = sensors_file(tmp_path, port, port)
    head, roof = file.read_text().split("\nroof:")
    file.write_text(f"{head}\nroof:" + roof.replace("device_id: 1 ", "device_id: 2 "))
    with Simulator(
        "site_simulator", "--sensors", str(file), "--workbench", "0", *STILL
    ) as running, Bus(port) as bus:
        assert running.process.stdout is not None
        said = running.process.stdout.readline()
        assert "no drive is connected: the pump never runs" in said
        assert bus.ask("0001 0000 0006 01 04 0000 0001") == "0001000000050104027530"  # 30000
        assert bus.ask("0001 0000 0006 02 04 0000 0001") == "00010000000502040201f4"  # 500
        running.inject("cistern_silent")
        assert bus.ask("0001 0000 0006 01 04 0000 0001", 0.2) == ""
        assert bus.ask("0001 0000 0006 02 04 0000 0001") == "00010000000502040201f4"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--drive-at", "somewhere"), "--drive-at = 'somewhere': must be tcp://"),
        (("--fault", "flood"), "--fault = 'flood': must be one of none, cistern_frozen"),
        (("--sensors", "nowhere.yaml"), "nowhere.yaml: cannot be read"),
        (("--weather", "nowhere.csv"), "nowhere.csv"),
    ],
)
def test_wrong_options_are_refused(
    monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], said: str
) -> None:
    assert said in refusal(monkeypatch, site_simulator, *options)
