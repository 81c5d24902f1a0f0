"""What controllers are given: issues, errors, ensembles and files, and their means over steps."""

from __future__ import annotations

import struct
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from graphs import bring_up, messages_of
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from paper import MIDNIGHT, PAPER_SITE, paper_run, site_with, weather_of
from places import refusal

from greenroof_ros.forecast.choice import ForecastChoice, choose, read_skill
from greenroof_ros.forecast.issue import IssuedForecast, write_forecasts
from greenroof_ros.forecast.models import (
    ErrorModel,
    FileModel,
    ForecastModel,
    make_model,
)
from greenroof_ros.forecast.steps import (
    Forecast,
    PerfectForecast,
    SteppedForecast,
    make_forecast,
)
from greenroof_ros.site.horizon import growing_steps
from greenroof_ros.weather.records import HOUR
from greenroof_ros.weather.series import Weather, WeatherSeries

Array = NDArray[np.float64]


def both(forecast: Forecast, tick: int) -> list[bytes]:
    """Return the forecast rain and evapotranspiration at a tick, as bytes."""
    rain, evapotranspiration, *_ = forecast.at(tick)
    return [np.array(series).tobytes() for series in (rain, evapotranspiration)]


# --- means over steps --------------------------------------------------------------------------


def issue_of(
    issued: datetime, rain: Array, evapotranspiration: Array | None = None, delay: float = 0.0
) -> IssuedForecast:
    """Return an issue that is known some hours after its nominal time."""
    values = {"precipitation": rain}
    if evapotranspiration is not None:
        values["evapotranspiration"] = evapotranspiration
    return IssuedForecast(issued, issued + delay * HOUR, Path("archive.csv"), None, values)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32),
    tau=st.sampled_from([1, 10, 60, 75, 613]),
    offset=st.integers(0, 7200),
    horizon=st.sampled_from([0.0, 0.1, 0.5, 2.0, 7.5]),
    data=st.data(),
)
def test_means_count_every_second(
    seed: int, tau: int, offset: int, horizon: float, data: st.DataObject
) -> None:
    """Every step of every member equals the mean of its seconds, one by one.

    The weather of the tick holds in the tick, and in the first step; the rest is the issue's.
    """
    chance = np.random.default_rng(seed)
    weather = weather_of(chance.uniform(0, 20, 6), chance.uniform(0, 9, 6))
    rain = chance.uniform(0, 20, (7, 2, 12)) * (chance.random((7, 2, 12)) < 0.5)
    evaporated = chance.uniform(0, 9, (7, 12))
    hourly = [
        issue_of(MIDNIGHT + hour * HOUR, rain[hour], evaporated[hour]) for hour in range(7)
    ]
    site = site_with(tau=float(tau))
    start = MIDNIGHT + timedelta(seconds=offset)
    edges = growing_steps(horizon) if horizon else tau * np.arange(site.M + 1.0)
    steps = (6 * 3600 - offset) // tau
    series = WeatherSeries(weather, site, start, steps)
    model = FileModel(hourly, weather, all_members=True)
    forecast = SteppedForecast(model, weather, series, site, start, edges, all_members=True)
    for tick in data.draw(st.lists(st.integers(0, steps), min_size=1, max_size=3)):
        hour, second = divmod(offset + tick * tau, 3600)
        seconds = np.arange(int(edges[-1]))
        lead, measured = (second + seconds) // 3600, seconds < max(tau, edges[1])
        present = min(hour, 5)
        parts = edges[1:-1].astype(int)
        outlook = forecast.at(tick)
        members = np.asarray(outlook.rain)
        # As from a message: numpy's sums follow the order in memory.
        assert members.flags.c_contiguous
        for member in range(2):
            rates = np.where(measured, weather.precipitation[present], rain[hour, member][lead])
            means = [part.mean() / 3.6e6 for part in np.split(rates, parts)]
            assert members[member] == pytest.approx(means, rel=1e-9)
        assert (members[:, 0] == series.precipitation[tick]).all()
        assert members.min() >= 0.0  # rounding must not give less, which the nodes would refuse
        rates = np.where(measured, weather.evapotranspiration[present], evaporated[hour][lead])
        means = [part.mean() * 68.8 / 8.64e7 for part in np.split(rates, parts)]
        assert list(outlook.evapotranspiration) == pytest.approx(means, rel=1e-9)


CHANCE = np.random.default_rng(11)


def drawn(hours: int) -> Weather:
    """Return made-up weather."""
    return weather_of(CHANCE.gamma(0.3, size=hours), CHANCE.gamma(2.0, size=hours))


@pytest.mark.parametrize(("tau", "horizon", "members"), [(1.0, 47.3, 3), (613.0, 12.0, 1)])
def test_any_order(tau: float, horizon: float, members: int) -> None:
    """Tick by tick, backwards and in leaps: bit for bit the same as a new forecast."""
    site, weather = site_with(tau=tau), drawn(80)
    start, steps = MIDNIGHT + timedelta(minutes=37), int(12 * 3600 / tau)
    choice = ForecastChoice("ensemble", members=members) if members > 1 else ForecastChoice()
    series = WeatherSeries(weather, site, start, steps)

    def new() -> Forecast:
        return make_forecast(weather, series, site, start, horizon, choice, members > 1)

    asked, now = new(), steps // 3
    near = [tick for tick in range(now, now + 10) if tick <= steps]
    for tick in [*near, *reversed(near), *CHANCE.integers(0, steps + 1, 10).tolist(), steps, 0]:
        assert both(asked, tick) == both(new(), tick)


def test_perfect_forecast_is_the_series() -> None:
    """M ticks from each tick on, each a separate copy: changing one changes no other."""
    site, weather = site_with(tau=613.0), drawn(30)
    series = WeatherSeries(weather, site, MIDNIGHT, 70)
    forecast = make_forecast(weather, series, site, MIDNIGHT, 0.0, ForecastChoice())
    assert isinstance(forecast, PerfectForecast)
    for tick in (4, 5, 70, 0):
        outlook = forecast.at(tick)
        for ahead, values in (
            (outlook.rain, series.precipitation),
            (outlook.evapotranspiration, series.evapotranspiration),
        ):
            assert ahead.tolist() == [values[tick + lead] for lead in range(site.M)]
            ahead[0] = -1.0
    assert forecast.at(0).issued is None  # exact knowledge has no issue


# It has been dry since 06:00, and 30 mm/h fall from 12:45 to 14:00.
BY_MINUTE = np.zeros((24, 60))
BY_MINUTE[12, 45:] = BY_MINUTE[13] = 30.0


@pytest.mark.parametrize("delay", [None, 0.0])  # with 0 h, the hour is the one of the issue
@pytest.mark.parametrize("model", ["errors", "ensemble"])
def test_what_is_not_yet_recorded_is_not_forecast_without_skill(
    model: str, delay: float | None
) -> None:
    """Whatever falls after 12:05: the same to the last bit, if the skill is none."""
    at_noon, start = [], MIDNIGHT.replace(hour=12, minute=5)
    for rain in (BY_MINUTE, np.zeros((24, 60))):
        weather = weather_of(rain)
        series = WeatherSeries(weather, PAPER_SITE, start, 60)
        choice = ForecastChoice(model, skill="none", members=5, delay=delay)
        forecast = make_forecast(
            weather, series, PAPER_SITE, start, 6.0, choice, model == "ensemble"
        )
        at_noon.append(both(forecast, 0))
    assert at_noon[0] == at_noon[1]


# --- issues ------------------------------------------------------------------------------------


def test_issued_every_six_hours() -> None:
    """The newest changes at the first whole hour after 00, 06, 12 and 18 UTC.

    In the zone +05:30 that is at 06:00 and so on: 18:30 UTC is hour 0, 00:00 UTC is in hour 5.
    """
    first = datetime.fromisoformat("2021-07-07T00:00+05:30")
    model = ErrorModel(weather_of([1.0] * 60, first=first), 1, read_skill("real"))
    changed = []
    for hour in range(1, 25):
        before, now = model.forecast(hour - 1, 30)[1][1:], model.forecast(hour, 29)[1]
        if not np.allclose(before, now, rtol=1e-12, atol=0):
            assert not np.isclose(before, now)[1:].any()  # none of it was known before
            changed.append(hour)
    assert changed == [6, 12, 18, 24]


def test_errors_are_known_as_late_as_a_services() -> None:
    """Six hours after the issue, as in the services' figures, or as requested."""
    weather = weather_of(np.random.default_rng(4).uniform(0, 9, 90))

    def model(delay: float | None) -> ForecastModel:
        choice = ForecastChoice("ensemble", members=2, delay=delay)
        return make_model(choice, weather, PAPER_SITE, True)

    assert make_model(ForecastChoice("errors"), weather, PAPER_SITE, True).members == 1
    at_once = model(0.0)
    for late, delayed in ((6, model(None)), (3, model(2.25))):
        for hour in (11, 12, 17):
            # Known late since the issue's hour; its leads go on.
            known = at_once.forecast(hour - late, 24 + late)
            *values, issued = delayed.forecast(hour, 24)
            for before, now in zip(known, values, strict=False):
                assert before[..., late:].tobytes() == now.tobytes()
            assert issued == MIDNIGHT.replace(hour=(hour - late) // 6 * 6)


def test_missing_rain_is_not_guessed() -> None:
    """A run is refused before it begins, even if only a forecast would have needed the hour.

    Missing rain after the run matters only for forecasts that are made from it.
    """
    rain = np.ones(40)
    rain[[6, 20]] = np.nan
    weather = weather_of(rain)

    def made(model: str, first: int, horizon: float) -> Forecast:
        start = MIDNIGHT.replace(hour=first)
        series = WeatherSeries(weather, PAPER_SITE, start, 3600)
        return make_forecast(weather, series, PAPER_SITE, start, horizon, ForecastChoice(model))

    for model in ("perfect", "errors"):
        assert not made(model, 12, 6.0).notes
        refusal(made, model, 12, 12.0, match="missing at 2021-07-07T20:00")


# --- files -------------------------------------------------------------------------------------


@pytest.mark.parametrize("evaporates", [True, False])
@pytest.mark.parametrize(("delay", "late"), [(0.0, 0), (4.25, 0), (2.0, 1)])
def test_archives_by_definition(delay: float, late: int, evaporates: bool) -> None:
    """An issue is known some hours after its nominal time, from which its leads count.

    After its end there is no rain, and each day has the evapotranspiration of its last day. An
    issue without evapotranspiration has the records', and after their end the last. With records
    whose rain is an hour late, its rain is, too, but not its evapotranspiration.
    """
    chance, begins = np.random.default_rng(7), (0, 6, 14)
    rain, dried = chance.uniform(0, 9, (3, 2, 30)), chance.uniform(0, 9, (3, 30))
    own = [
        issue_of(MIDNIGHT + begin * HOUR, rain[n], dried[n] if evaporates else None, delay)
        for n, begin in enumerate(begins)
    ]
    weather = replace(weather_of(np.zeros(48), chance.uniform(0, 9, 48)), rain_late=late)
    model, first = FileModel(own, weather, True), FileModel(own, weather, False)
    for hour in range(6, 40):
        newest = [n for n, begin in enumerate(begins) if begin + delay + late <= hour][-1]
        age = hour - begins[newest]
        rain_then, got_evapotranspiration, issued = model.forecast(hour, 55)
        assert issued == MIDNIGHT + begins[newest] * HOUR
        assert first.forecast(hour, 55)[0].tolist() == rain_then[:1].tolist()
        for lead in range(age, age + 55):
            fell = rain[newest, :, lead - late] if lead - late < 30 else np.zeros(2)
            assert rain_then[:, lead - age].tolist() == fell.tolist()
            expected = weather.evapotranspiration[min(hour + lead - age, 47)]
            if evaporates:
                expected = dried[newest, lead if lead < 30 else 6 + (lead - 6) % 24]
            assert got_evapotranspiration[lead - age] == expected
        ends = hour - age + 30 if evaporates else min(hour - age + 30 + late, 48)
        assert model.end(hour) == MIDNIGHT + ends * HOUR


def test_hours_of_records_and_issues() -> None:
    """They start together, in any time zone; before the first issue is known there is none."""
    def model(first: str, delay: float) -> FileModel:
        dry = weather_of(np.zeros(48), first=datetime.fromisoformat(first))
        return FileModel([
            issue_of(
                MIDNIGHT + 6 * number * HOUR, np.arange(48.0)[None] / 100 + number, delay=delay
            ) for number in range(-1, 7)
        ], dry, False)

    # 06:00 UTC
    assert model("2021-07-07T11:30+05:30", 0.0).forecast(0, 2)[0][0].tolist() == [1.0, 1.01]
    # 05:30 UTC, in the middle of the hours 5 and 6 of the issue of 00 UTC.
    between = model("2021-07-07T11:00+05:30", 0.0).forecast(0, 2)[0][0]
    assert between.tolist() == pytest.approx([0.055, 0.065])
    late = model("2021-07-06T00:00+00:00", 6.0)
    needed = "available before 2021-07-07T00:00.00:00, but the run needs one at 2021-07-06T23:00"
    refusal(late.forecast, 23, 1, match=needed)
    assert late.forecast(24, 1)[0].shape == (1, 1)


def test_end_of_the_records() -> None:
    """Perfect forecasts and errors then repeat the last record."""
    options = ("--start", "2021-07-09T00:00", "--controller", "anticipating_onoff")
    end = ["a forecast ends at 2021-07-10T00:00-05:00; later values are assumed"]
    for model, hours, notes in (
        ("perfect", "12", []), ("perfect", "12.0025", end), ("errors", "12.0025", end),
    ):
        run = paper_run(*options, "--hours", hours, "--horizon", "12", "--forecast", model)
        assert run.forecast.notes == notes


def test_choices(tmp_path: Path) -> None:
    """Names and their options; files by their suffix, directories if they exist or by a slash."""
    for text in ("a.csv", "a.JSON", "b/a.json", "later/", str(tmp_path)):
        choice = choose(text)
        assert (choice.model, choice.file, choice.options()) == ("file", Path(text), {})
    assert choose("ensemble").options() == {"skill": "real", "seed": 0, "members": 10}


# --- the graph ---------------------------------------------------------------------------------


def test_the_graph_is_given_the_same(domain: int, tmp_path: Path) -> None:
    """The bag has, bit for bit, what was forecast, after the time of its issue and ends of steps.

    The issue of 06:00 UTC is half an hour late, so it is used from 07:00 on, at tick 300. The run
    carries its directory of forecasts, and the graph reads the copy.
    """
    pytest.importorskip("rclpy", reason="the graph needs ROS 2")
    (tmp_path / "runs").mkdir()
    for number in range(2):
        issue = issue_of(MIDNIGHT + 6 * number * HOUR, np.arange(48.0)[None] / 100 + number)
        (tmp_path / "runs" / f"run_{number}.csv").write_text(write_forecasts([issue]))
    options = ["--controller", "mpc", "--start", "2021-07-07T01:55", "--hours", "0.1"]
    options += ["--forecast-delay", "0.5", "--forecast"]
    summary = bring_up(domain, tmp_path, *options, "runs")
    assert summary["forecast"] == {"model": "file", "file": "runs", "delay": 0.5}
    kept = tmp_path / "run" / "configuration" / "forecast" / "runs"
    assert (kept / "run_0.csv").read_bytes() == (tmp_path / "runs" / "run_0.csv").read_bytes()
    run, bag = paper_run(*options, str(tmp_path / "runs")), messages_of(tmp_path / "run")
    for topic, place in (("/forecast/precipitation", 0), ("/forecast/evapotranspiration", 1)):
        length = len(run.forecast.at(0)[place])
        expected = []
        for tick in range(run.steps + 1):
            issued = MIDNIGHT + (0 if tick < 300 else 6) * HOUR
            numbers = (issued.timestamp(), *range(1, length + 1), *run.forecast.at(tick)[place])
            expected.append(struct.pack(f"<{len(numbers)}d", *numbers))
        assert [message[-len(expected[0]) :] for message in bag[topic]] == expected, topic
