"""Nodes of a live graph, with sensors that the test simulates: forecasts, classes, the weather.

A tick is 0.2 s here, and the limits are seconds, so a failure and its end take few seconds.
The rules of an input are tested separately in test_input_rules.py; hostile messages, and processes
that are stopped, by the fault campaign.
"""

from __future__ import annotations

import math
import os
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from http_service import WeatherService
from paper import PAPER_SITE
from places import refusal
from ros_rig import (
    ERROR,
    FORECAST_HEADER,
    LATE,
    OK,
    USUAL_EVAPOTRANSPIRATION,
    WARN,
    Site,
    newest,
    write_forecast,
)

from greenroof_ros.live.controller import NumberFile
from greenroof_ros.live.weather import _find_monthly_mean
from greenroof_ros.site.horizon import growing_steps

RAIN = "/forecast/precipitation"
IN_COMMAND = "on/off control has been in command since "


def lasts(site: Site, commands: list[tuple[float, Any]], command: object) -> bool:
    """Return whether all commands of the next 0.5 s are this one."""
    before = len(commands)
    site.during(0.5)
    return all(command in (None, value) for _, value in commands[before:])


def follow(
    site: Site, commands: list[tuple[float, Any]], recovery_s: float, *steps: tuple[Any, ...]
) -> None:
    """Change the inputs step by step; what follows must come, and last.

    On a busy machine an input can be late, which stops the pump or puts on/off control in command
    for a moment. So only a stop must last at once.

    Args:
        site: the site, whose inputs are good.
        commands: the node's commands, or what else it publishes.
        recovery_s: how long all is good again before the node relies on it (s).
        steps: of each what differs from the good inputs (None: nothing is sent; ``fault``: content
            of the file of this name), the command (None: any), and what ``Site.shows`` takes, or
            nothing.
    """
    good, was_good = dict(site.values), True
    for changes, command, *report in steps:
        values, began = {**good, **changes}, time.monotonic()
        (site.cwd / "fault").write_text(values.pop("fault", ""))
        site.values = {name: value for name, value in values.items() if value is not None}
        shown = site.shows(*report) if report else lambda: True
        site.until(
            lambda command=command, shown=shown: commands and shown()
            and command in (None, newest(commands)), LATE, f"{changes}: {command}, {report}",
        )
        assert changes or was_good or time.monotonic() - began > 0.9 * recovery_s
        was_good = not changes
        until = time.monotonic() + LATE
        while not lasts(site, commands, command):
            assert command != 0.0 and time.monotonic() < until, f"{changes}: {command} did not last"
    site.values = good


def test_onoff_commands_without_a_forecast(site: Site) -> None:
    """It reports this with reason and time; unknown level or frost stops the pump as always."""
    commands, part = site.be_dry(), "/mpc: forecast"
    own, without = pytest.approx(0.2, abs=0.2 - 1e-9), ({RAIN: None}, 1.0, "/mpc: inputs", OK)
    with site.live(
        "controller --controller mpc", max_command=0.4, recovery_time=0.2,
        forecast_limit=1.0, level_limit=1.5, jump_tolerance=1.0,
    ):
        for bad in ([*[0.0] * 9, math.nan], [0.0] * 2000, None):  # also too long for mpc
            follow(
                site, commands, 0.2, ({}, own, part, OK),
                ({RAIN: bad}, 1.0, part, WARN, IN_COMMAND, RAIN), without,
            )
        for change in ({"/roof/level": math.nan}, {"/cistern/level": 0.5}, {"/weather/frost": 1.0}):
            follow(site, commands, 0.2, without, ({RAIN: None, **change}, 0.0), without)


MINE = """
import math, time
from pathlib import Path
from greenroof_ros.base.parameter import Parameter

class Waiting:
    parameters = (Parameter("answer", 0.0, "1", 0.0, 2.0, "its command"),)
    def __init__(self, site, answer): self.answer = answer
    def command(self, *inputs): return self.answer
    def skip(self): pass
    def statistics(self): return None

class Learner(Waiting):
    asked = 0
    def command(self, *inputs):
        self.asked += 1
        return 0.1 + 0.001 * self.asked
    @property
    def learned(self): return {"asked": float(self.asked)}
    @learned.setter
    def learned(self, values): self.asked = int(values["asked"])

class Broken(Waiting):
    needs_forecast, fault = False, property(lambda self: Path("fault").read_text())
    def __init__(self, *site, **answer):
        if self.fault == "made": raise ValueError("no")
    def command(self, *given):
        if self.fault == "raises": 1 / 0
        if self.fault == "never returns":
            try: time.sleep(60)
            except BaseException: time.sleep(60)
        return math.nan if self.fault == "NaN" else 0.3
"""


@pytest.mark.parametrize(("quiet", "answer", "recovery", "words"), [
    (True, 0.4, 0.2, IN_COMMAND), (False, 0.0, 2.0, "was rejected"),
])
def test_a_missing_forecast_starts_no_pump(
    site: Site, quiet: bool, answer: float, recovery: float, words: str
) -> None:
    """Neither in present quiet hours of the system's clock, nor, if it is missing for a moment, on
    a roof that waits for rain.
    """
    commands, part = site.be_dry(), "/waiting: forecast"
    (site.cwd / "mine.py").write_text(MINE)
    now, file = datetime.now(UTC), site.cwd / "quiet.yaml"
    begin, end = (now + timedelta(hours=hours) for hours in (-1, 2))
    hours = f"quiet_hours: ['{begin:%H:%M}-{end:%H:%M}']\n" if quiet else ""
    file.write_text(f"extends: site.yaml\ntime_zone: UTC\nutc_offset: 0\n{hours}")
    options = {"site_file": file, "recovery_time": recovery, "answer": answer}
    with site.live("controller --controller mine:Waiting", **options):
        follow(
            site, commands, recovery, ({}, 0.0, "/waiting: inputs", OK), ({}, 0.0, part, OK),
            ({RAIN: [math.nan] * 10}, 0.0, part, WARN, words), ({}, 0.0, part, OK),
        )
    assert {value for _, value in commands} == {0.0}


# What is reported of each fault, and the text of the line that is named. Other commands that are
# none are in controllers/test_decide.py.
FAULTS = {
    "made": ("ValueError: no", "raise ValueError"), "raises": ("ZeroDivisionError", "1 / 0"),
    "never returns": ("did not return", "BaseException"),
    "NaN": ("must be a finite number", "*given"),
}


def test_on_off_replaces_a_class_that_fails(site: Site) -> None:
    """With a warning that names file and line, until it works again; the node goes on."""
    file, part = site.cwd / "mine.py", "/broken: command"
    file.write_text(MINE)
    commands = site.be_dry()
    (site.cwd / "fault").write_text("made")  # at the start of the node
    quick = site.cwd / "quick.yaml"
    quick.write_text("extends: site.yaml\ntau: 0.05\n")
    # One that failed is asked again after 60 times recovery_time, which is 1.8 s.
    with site.live(
        "controller --controller mine:Broken", site_file=quick, recovery_time=0.03
    ) as process:
        for what, (why, text) in FAULTS.items():
            place = f"{file}, line {MINE[:MINE.index(text)].count(chr(10)) + 1}"
            follow(
                site, commands, 0.03,
                ({"fault": what}, 1.0, part, WARN, IN_COMMAND, place, why), ({}, 0.3, part, OK),
            )
        assert process.poll() is None


def test_what_was_learned_outlives_the_node(site: Site) -> None:
    """Its commands grow by a thousandth each time, across a restart."""
    commands = site.be_dry()
    (site.cwd / "mine.py").write_text(MINE)
    limits = {"recovery_time": 0.2, "state_file": site.cwd / "state" / "learner.json"}

    def its_own() -> list[float]:
        return [value for _, value in commands if 0 < value < 1]

    for _ in range(2):
        with site.live("controller --controller mine:Learner", **limits):
            before = len(its_own())
            site.until(lambda before=before: len(its_own()) > before + 5, LATE, "its commands")
        site.during(0.5)  # its last messages are received, those that came while it ended, too
    assert all(b > a for a, b in pairwise(its_own()))


def test_monthly_means_are_of_the_whole_bed_with_its_crop() -> None:
    """2.5 mm/day from 68.8 m2 are 172 litres a day; of them, the crop has half."""
    months = (0.0, 1.0, *[2.5] * 9, 20.0)
    site = replace(PAPER_SITE, monthly_evapotranspiration=months, crop_coefficient=0.5)
    march, december = (datetime(2025, month, 15, tzinfo=UTC) for month in (3, 12))
    assert _find_monthly_mean(site, march) == pytest.approx(0.5 * 0.172 / 86400)
    assert _find_monthly_mean(site, december) == pytest.approx(0.5 * 1.376 / 86400)
    assert _find_monthly_mean(PAPER_SITE, march) is None


def test_live_weather(site: Site) -> None:
    """A file that is replaced and broken, gauges that come and go, an issue that is too old."""
    file = site.cwd / "forecast.csv"
    write_forecast(file, timedelta(minutes=1), 3.6, 15.0)
    rain, frost, evapotranspiration = (
        site.listen(f"/weather/{name}") for name in ("precipitation", "frost", "evapotranspiration")
    )
    forecast = site.listen("/forecast/precipitation")

    def expect(rain_now: float, frost_now: float, *expected: tuple[str, str]) -> None:
        """Wait for rain, frost, and the codes of parts of the node."""
        site.until(
            lambda: newest(rain) == pytest.approx(rain_now, rel=1e-9)
            and newest(frost) == pytest.approx(frost_now, nan_ok=True)
            and all(
                site.watcher.values(f"/weather: {part}").get("code", "") == code
                for part, code in expected
            ), LATE, f"{rain_now}, {frost_now}, {expected}",
        )

    with site.live("weather", forecast=file, gauge_limit=1.0, recovery_time=0.3):
        expect(1e-6, 0.0, ("forecast", ""))  # 3.6 mm/h
        site.until(lambda: forecast and evapotranspiration, LATE, "the weather")
        assert list(newest(forecast)) == pytest.approx([1e-6] * 10)
        # 2 mm/day from 68.8 m2.
        assert newest(evapotranspiration) == pytest.approx(0.002 * 68.8 / 86400)
        write_forecast(file, timedelta(0), 7.2, -1.0)
        expect(2e-6, 1.0)
        file.write_text(FORECAST_HEADER + "\nnow,now,1.0,2.0,3.0\n")
        expect(2e-6, 1.0, ("forecast", "forecast_unreadable"))
        site.values = {"/gauge/precipitation": 5e-6, "/gauge/temperature": 4.0}
        expect(5e-6, 0.0)
        their_forecast = pytest.approx([5e-6] + [2e-6] * 9)
        site.until(lambda: list(newest(forecast)) == their_forecast, LATE, "their rain forecast")
        site.values = {"/gauge/precipitation": math.nan, "/gauge/temperature": 500.0}
        expect(2e-6, 1.0, ("rain gauge", "gauge_bad"), ("thermometer", "gauge_bad"))
        write_forecast(file, timedelta(hours=2, minutes=1), 3.6, 15.0)
        expect(2e-6, math.nan, ("forecast", "forecast_missing"), ("frost", "temperature_unknown"))
        site.during(0.5)
        rates, unknown = (len(forecast), len(rain)), len(frost)
        site.until(lambda: len(frost) > unknown + 4, LATE, "unknown frost again")
        assert (len(forecast), len(rain)) == rates
        assert newest(evapotranspiration) in USUAL_EVAPOTRANSPIRATION


def test_live_weather_that_lacks_something_until_it_is_fetched(site: Site) -> None:
    """The reason is reported; without a forecast, unknown_frost_may_pump makes frost 0."""
    service, disk = WeatherService("error"), site.cwd / "archive"
    frost, forecast = site.listen("/weather/frost"), site.listen("/forecast/precipitation")
    part = "/weather: forecast service"
    options = {
        "forecast": disk / "forecast.csv", "fetch": "true", "horizon": 24.0, "all_members": "true",
        "fetch_url": f"{service.address}/v1/ensemble",
    }
    with site.live("weather", **options, unknown_frost_may_pump="true"):
        follow(
            site, frost, 0.0, ({}, 0.0, part, WARN, "503 Service Unavailable"),
            ({}, 0.0, "/weather: forecast", ERROR, "there is no forecast"),
            ({}, 0.0, "/weather: frost", WARN, "may run anyway"),
        )
        assert not forecast
    frost.clear()
    service.fault = ""
    with site.live("weather", **options):
        site.until(lambda: len(forecast) > 3, LATE, "a forecast")
        follow(
            site, frost, 0.0, ({}, 0.0, part, OK, "Open-Meteo"),  # whose it is; it is of July
            ({}, 0.0, "/weather: forecast", OK),
        )
        assert len(newest(forecast)) == 11 * (len(growing_steps(24.0)) - 1)
        site.until(lambda: len([*disk.glob("forecast/*.csv")]) == 1, LATE, "its archive")
    service.close()


def test_what_is_no_mapping_of_numbers_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "numbers.json"
    file.write_text('{"a": NaN}')
    refusal(NumberFile(file).read, match=r"numbers\.json.*a = 'NaN': must be a finite number")


def test_the_file_is_on_the_disk_before_it_takes_the_place_of_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a power cut could leave a name without content."""
    file, contents = tmp_path / "numbers.json", list[tuple[str, str]]()
    file.write_text('{"a": 1.0}')
    monkeypatch.setattr(os, "fsync", lambda number: contents.append(
        (Path(f"/dev/fd/{number}").read_text(), file.read_text())
    ))
    numbers = NumberFile(file)
    numbers.write({"a": 2.0})
    numbers.close()
    assert contents == [('{\n "a": 2.0\n}', '{"a": 1.0}')]
    assert numbers.read() == {"a": 2.0}
