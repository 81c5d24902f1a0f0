"""Nodes of a live graph, with sensors that the test simulates: bad inputs, the weather.

A tick is 0.2 s here, and the limits are seconds, so a failure and its end take few seconds.
The rules of an input are tested separately in test_input_rules.py.
"""

from __future__ import annotations

import math
import os
import signal
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from typing import Any

import pytest
from disks import disk_that_hangs
from forecast_service import started_service
from paper import PAPER_SITE
from rclpy.node import Node
from ros_rig import (
    ERROR,
    FORECAST_HEADER,
    FORECASTS,
    LATE,
    OK,
    SUSPENDED,
    TAU,
    USUAL_EVAPOTRANSPIRATION,
    WARN,
    Site,
    newest,
    write_forecast,
)
from rosbags.highlevel import AnyReader

from greenroof_ros.interface.topics import read_live_topics
from greenroof_ros.live.weather import _find_monthly_mean
from greenroof_ros.site.horizon import growing_steps

RAIN = "/forecast/precipitation"
IN_COMMAND = "on/off control has been in command since "


def follow(
    site: Site, commands: list[tuple[float, Any]], recovery_s: float, *steps: tuple[Any, ...]
) -> None:
    """Change the inputs step by step; what follows must come, and last.

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
        before, was_good = len(commands), not changes
        site.during(0.5)
        assert all(command in (None, value) for _, value in commands[before:])
    site.values = good


def test_a_bad_input_stops_the_pump(site: Site) -> None:
    """Command 0, input and rule on /diagnostics, and recovery; on/off needs no forecast."""
    reports = site.watcher.times("/diagnostics")
    commands = site.be_dry()
    for name in FORECASTS:
        del site.values[name]
    # The flow lowers the cistern as fast as be_dry does: by 0.3 mm in 1.9 s.
    site.values["/pump/flow"] = 1.6e-4 * PAPER_SITE.a1
    cistern, part = site.values["/cistern/level"], "/onoff: inputs"
    well = {}, 0.5, part, OK
    with site.live(
        "controller --controller onoff", fraction=0.5, level_limit=1.5, recovery_time=1.0,
        frozen_movement=3e-4,
    ):
        follow(
            site, commands, 1.0, well,
            ({"/roof/level": math.nan}, 0.0, part, ERROR, "/roof/level was rejected", "0 to 100 m"),
            well,
            ({"/cistern/level": None}, 0.0, part, ERROR, "/cistern/level is older than 1.5 s"),
            well,
            ({"/cistern/level": cistern(time.monotonic())}, 0.0, part, ERROR, "level is frozen"),
            well,
        )
        intruder = Node("intruder", context=site.watcher.context, start_parameter_services=False)
        site.watcher.publisher("/roof/level", intruder)
        words = "/roof/level has 2 publishers (intruder, observer)"
        follow(site, commands, 1.0, ({}, 0.0, part, ERROR, words))
        assert site.shows("/onoff", OK)()  # only the part is not OK
        intruder.destroy_node()
        follow(site, commands, 1.0, well)
        # A pump that is held freezes no level.
        site.values |= {"/pump/flow": 0.0, "/cistern/level": cistern(time.monotonic())}
        site.during(2)
        reports.clear()
        commands.clear()
        site.during(6)
        assert 2 < len(reports) < 9  # what does not change is reported once a second
        assert newest(commands) == 0.5 and len(commands) < 1.1 * 6 / TAU + 10  # one per tick


def test_nothing_that_is_published_ends_a_node(site: Site) -> None:
    """Bytes that are no message, on each topic of a live site; the bag has none of them.

    Those of a fixed size can only be shorter: the middleware sends no longer ones. After one of no
    bytes it delivers nothing more of its publisher.
    """
    watcher, topics = site.watcher, read_live_topics()
    publishers = {name: watcher.publisher(name) for name in topics}
    expected = {
        "/lookahead": ["/roof/level", *FORECASTS], "/weather": ["/gauge/temperature"],
    }

    def counted() -> bool:
        """Publish, and return whether each node has counted some of each topic."""
        for size in (1, 4, 7, 1_000_000):
            for name, publisher in publishers.items():
                if size < 12 or "Array" in topics[name].type:
                    publisher.publish(b"\0\1\0\0abc"[:size].ljust(size, b"x"))
            site.during(0.05)
        return all(
            watcher.values(node).get("refused", {}).get(name, 0) > 8
            for node, names in expected.items() for name in names
        )

    with site.live("controller --controller lookahead"):
        watcher.start("live.weather", site_file=site.cwd / "site.yaml")
        recorder = watcher.start("live.recorder", directory="bag")
        site.until(lambda: "/recorder" in site.diagnoses, LATE, "the recorder")
        site.until(counted, LATE, f"counts of {expected}")
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(300) in (0, -signal.SIGALRM)
    with AnyReader([site.cwd / "bag"]) as bag:
        for connection, _, message in bag.messages():
            bag.deserialize(message, connection.msgtype)


def test_onoff_commands_without_a_forecast(site: Site) -> None:
    """It reports this with reason and time; unknown level or frost stops the pump as always."""
    commands, part = site.be_dry(), "/mpc: forecast"
    own, without = pytest.approx(0.2, abs=0.2 - 1e-9), ({RAIN: None}, 1.0, "/mpc: inputs", OK)
    with site.live(
        "controller --controller mpc", max_command=0.4, recovery_time=0.2,
        forecast_limit=1.0, level_limit=1.5, jump_tolerance=1.0,
    ):
        for bad, why in (
            ([*[0.0] * 9, math.nan], "was rejected: nan"),
            ([0.0] * 2000, "was rejected"),  # too long for mpc
            (None, "is older than 1 s"),
        ):
            follow(
                site, commands, 0.2, ({}, own, part, OK),
                ({RAIN: bad}, 1.0, part, WARN, IN_COMMAND, f"{RAIN} {why}"), without,
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
    needs_forecast, outputs = False, {"/controller/fill_to": "fill_to"}
    fault = property(lambda self: Path("fault").read_text())
    learned = property(lambda self: {"x": "much"} if self.fault == "learns words" else None)
    def __init__(self, *site, **answer):
        if self.fault == "made": raise ValueError("no")
    def command(self, *given):
        if self.fault == "raises": 1 / 0
        if self.fault == "exits": raise SystemExit(3)
        if self.fault == "never returns":
            try: time.sleep(60)
            except BaseException: time.sleep(60)
        return math.nan if self.fault == "NaN" else 0.3
    @property
    def fill_to(self):
        if self.fault == "output": math.sqrt(-1.0)
        return None if self.fault == "no number" else 1.0
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


# What is reported of each fault, and the text of the line that is named, if a line is. For other
# commands that are none see controllers/test_decide.py.
FAULTS = {
    "made": ("ValueError: no", "raise ValueError"), "raises": ("ZeroDivisionError", "1 / 0"),
    "exits": ("SystemExit: 3", "SystemExit"), "never returns": ("did not return", "BaseException"),
    "NaN": ("must be a finite number", "*given"), "output": ("ValueError", "math.sqrt"),
    "learns words": ("could not convert string to float: 'much'", ""),
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
            line = MINE[:MINE.index(text)].count("\n") + 1
            place = f"{file}, line {line}" if text else ""
            follow(
                site, commands, 0.03,
                ({"fault": what}, 1.0, part, WARN, IN_COMMAND, place, why), ({}, 0.3, part, OK),
            )
        # An output that no message can contain.
        follow(site, commands, 0.03, ({"fault": "no number"}, None, part, WARN, "raises"))
        assert process.poll() is None


def test_what_was_learned_outlives_the_node_and_a_time_without_a_forecast(site: Site) -> None:
    """Its commands grow by a thousandth each time, across the turn of on/off and a restart."""
    commands, good = site.be_dry(), dict(site.values)
    (site.cwd / "mine.py").write_text(MINE)
    limits = {
        "recovery_time": 0.2, "forecast_limit": 1.0,
        "state_file": site.cwd / "state" / "learner.json",
    }

    def its_own() -> list[float]:
        return [value for _, value in commands if 0 < value < 1]

    for _ in range(2):
        with site.live("controller --controller mine:Learner", **limits):
            before = len(its_own())
            site.until(lambda before=before: len(its_own()) > before + 5, LATE, "its commands")
            site.values = {name: value for name, value in good.items() if name not in FORECASTS}
            site.until(lambda: newest(commands) == 1.0, LATE, "on/off")
            before, site.values = len(its_own()), dict(good)
            site.until(lambda before=before: len(its_own()) > before, LATE, "its commands again")
        site.during(0.5)  # its last messages are received, those that came while it ended, too
    assert all(b > a for a, b in pairwise(its_own()))


def test_no_command_of_what_was_before_a_pause(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A suspend of the machine, or a stop of the process, during which the roof gets wet.

    During a suspend the clock that normally gives a value's age stands still. The limits are far
    longer and the recovery time is 0: the node must notice its own pause.
    """
    (site.cwd / "sitecustomize.py").write_text(SUSPENDED)
    monkeypatch.setenv("PYTHONPATH", str(site.cwd))
    commands = site.be_dry()
    with site.live(
        "controller --controller onoff", level_limit=60.0, recovery_time=0.0, jump_tolerance=1.0
    ) as process:
        well = {}, 1.0, "/onoff: inputs", OK  # also: its diagnostics have been discovered
        for when in ("suspended", "suspended_in_a_decision"):
            follow(site, commands, 0.0, well)
            for each in (site.messages, commands):
                each.clear()
            (site.cwd / when).touch()
            site.until(
                lambda: any(value == 0.0 for _, value in commands)
                and any("was paused for" in each for each in site.messages), LATE, when,
            )
        follow(site, commands, 0.0, well)
        commands.clear()
        site.until(lambda: commands, LATE, "a decision, which may take long")
        site.during(TAU / 2)  # until after it
        os.kill(process.pid, signal.SIGSTOP)
        site.during(1.0)
        before, dry = len(commands), site.values["/roof/level"]
        site.values["/roof/level"] = lambda now: dry(now) + 0.04
        site.during(2.0)
        assert len(commands) == before
        site.messages.clear()
        os.kill(process.pid, signal.SIGCONT)
        site.until(
            lambda: len(commands) > before + 5
            and any("this node itself was paused" in each for each in site.messages), LATE, "why",
        )
        assert {value for _, value in commands[before:]} == {0.0}
        site.values["/roof/level"] = dry
        follow(site, commands, 0.0, well)


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

    def expect(rain_now: float, frost_now: float, *expected: tuple[Any, ...]) -> None:
        """Wait for rain, frost, and the reports on parts of the node, each with level and words."""
        site.until(
            lambda: newest(rain) == pytest.approx(rain_now, rel=1e-9)
            and newest(frost) == pytest.approx(frost_now, nan_ok=True),
            LATE, f"{rain_now}, {frost_now}",
        )
        for part, *words in expected:
            site.until(site.shows(f"/weather: {part}", *words), LATE, f"{part}: {words}")

    with site.live("weather", forecast=file, gauge_limit=1.0, recovery_time=0.3):
        expect(1e-6, 0.0, ("forecast", OK, "issued"))  # 3.6 mm/h
        site.until(lambda: forecast and evapotranspiration, LATE, "the weather")
        assert list(newest(forecast)) == pytest.approx([1e-6] * 10)
        # 2 mm/day from 68.8 m2.
        assert newest(evapotranspiration) == pytest.approx(0.002 * 68.8 / 86400)
        write_forecast(file, timedelta(0), 7.2, -1.0)
        expect(2e-6, 1.0)
        file.write_text(FORECAST_HEADER + "\nnow,now,1.0,2.0,3.0\n")
        expect(2e-6, 1.0, ("forecast", WARN, f"{file}, line 2", "'now'"))
        site.values = {"/gauge/precipitation": 5e-6, "/gauge/temperature": 4.0}
        expect(5e-6, 0.0)
        their_forecast = pytest.approx([5e-6] + [2e-6] * 9)
        site.until(lambda: list(newest(forecast)) == their_forecast, LATE, "their rain forecast")
        site.values = {"/gauge/precipitation": math.nan, "/gauge/temperature": 500.0}
        expect(2e-6, 1.0, *[(part, WARN, "was rejected") for part in ("rain gauge", "thermometer")])
        site.values = {}
        expect(2e-6, 1.0, ("thermometer", WARN, "older than 1 s"))
        write_forecast(file, timedelta(hours=2, minutes=1), 3.6, 15.0)
        expect(2e-6, math.nan, ("forecast", ERROR, "is older than 2 h"),
               ("frost", ERROR, "the pumps are kept off"))
        site.during(0.5)
        rates, unknown = (len(forecast), len(rain)), len(frost)
        site.until(lambda: len(frost) > unknown + 4, LATE, "unknown frost again")
        assert (len(forecast), len(rain)) == rates
        assert newest(evapotranspiration) in USUAL_EVAPOTRANSPIRATION


def test_live_weather_that_lacks_something_until_it_is_fetched(site: Site) -> None:
    """The reason is reported; without a forecast, unknown_frost_may_pump makes frost 0.

    A fetched forecast needs no disk: the file is an archive, and the controller gets the forecast
    by memory.
    """
    service, disk = started_service("error"), site.cwd / "disk"
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
    service.fault = "none"
    with site.live("weather", **options), disk_that_hangs(disk) as hang:
        hang(True)
        site.until(lambda: len(forecast) > 3, LATE, "a forecast")
        follow(
            site, frost, 0.0, ({}, 0.0, part, OK, "Open-Meteo"),  # whose it is; it is of July
            ({}, 0.0, "/weather: forecast", OK),
        )
        assert len(newest(forecast)) == 11 * (len(growing_steps(24.0)) - 1)
        hang(False)
        site.until(lambda: len([*disk.glob("forecast/*.csv")]) == 1, LATE, "its archive")
    service.close()
