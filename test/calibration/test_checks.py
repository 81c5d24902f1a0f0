"""What speaks against records and fits: right ones are left alone, wrong ones have their code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from twins import DAY, TWIN, a_record, record_rows, summed, write

from greenroof_ros.calibration.checks import FINDINGS, check_fit, check_record, level_sensor
from greenroof_ros.calibration.csv_record import read_csv_record
from greenroof_ros.calibration.record import Record, in_months
from greenroof_ros.calibration.scores import Scores, score
from greenroof_ros.calibration.simulation import simulate
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.quality import Finding, Severity, accept

Change = Callable[[Record], Record]


@cache
def twin(days: int, hours: int = 0, *, gaps: bool = False) -> Record:
    """The record of a twin; its sums over so many hours, if any."""
    rows = record_rows(TWIN, days, 1, gaps=gaps)
    with TemporaryDirectory() as directory:
        file = write(summed(rows, hours) if hours else rows, Path(directory) / "twin.csv")
        return read_csv_record(file, TWIN)


def scaled(column: str, factor: float) -> Change:
    return lambda record: replace(record, **{column: factor * getattr(record, column)})


def shifted(column: str, steps: int) -> Change:
    """Shift a column in time, round its ends."""
    return lambda record: replace(record, **{column: np.roll(getattr(record, column), steps)})


def fixed(column: str, value: float, first: int, end: int | None = None) -> Change:
    """The same value in some steps."""
    def changed(record: Record) -> Record:
        series = getattr(record, column).copy()
        series[first:end] = value
        return replace(record, **{column: series})
    return changed


def of_level(change: Change) -> Change:
    """Change a record without runoff."""
    return lambda record: change(replace(record, runoff=None))


def found(record: Record) -> list[tuple[str, str, str]]:
    """What the checks find: code, case and column of each finding."""
    return [(one.code, one.case, one.about) for one in check_record(record, TWIN)]


# --- records --------------------------------------------------------------------------------------


def sparse(record: Record) -> Record:
    """A level of every third row."""
    return replace(record, level=np.where(np.arange(record.steps) % 3, np.nan, record.level))


WRONG: dict[str, tuple[Change, tuple[str, str, str]]] = {
    "rain in metres": (scaled("rain", 0.001), ("unit-error", "little rain", "rain")),
    "rain of a day in an hour": (scaled("rain", 24), ("unit-error", "much rain", "rain")),
    "level in cm called m": (scaled("level", 100), ("unit-error", "high level", "level")),
    "runoff in m called mm": (scaled("runoff", 1e-4), ("unit-error", "little runoff", "runoff")),
    "rain of the hour in 5 minutes": (scaled("rain", 12), ("unit-error", "held", "runoff")),
    "a dead runoff sensor": (scaled("runoff", 0.0), ("sensor-dead", "nothing", "runoff")),
    "a stuck runoff": (fixed("runoff", 0.05, 5 * DAY), ("sensor-stuck", "stuck", "runoff")),
    "a blocked rain gauge beside a level": (
        of_level(fixed("rain", 0.0, 8 * DAY)), ("gauge-blocked", "rise", "rain")),
    "a level of every third row": (sparse, ("sensor-sparse", "sparse", "level")),
    "runoff an hour early": (shifted("runoff", -12), ("clock-shifted", "roof", "runoff")),
    "level an hour early": (
        of_level(shifted("level", -12)), ("clock-shifted", "roof", "level")),
    "runoff of another time zone": (shifted("runoff", 96), ("clock-shifted", "roof", "runoff")),
    "level a day late": (
        of_level(shifted("level", 288)), ("clock-shifted", "roof", "level")),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_with_a_month_is_found(name: str) -> None:
    changed, finding = WRONG[name]
    assert finding in found(changed(twin(30)))


def test_right_records_have_nothing_wrong() -> None:
    assert found(twin(60, gaps=True)) == []
    assert found(twin(100)) == []


@pytest.mark.parametrize("hours", [1, 24])
def test_longer_sums(hours: int) -> None:
    """Units of a season, too; a day's steps are 24 / hours."""
    record, day = twin(100, hours), 24 // hours
    for right in (record, replace(record, runoff=None)):
        assert found(right) == []
    for changed, finding in (
        (scaled("runoff", 10), ("unit-error", "excess", "runoff")),
        (scaled("runoff", 0.1), ("unit-error", "shares", "runoff")),
        (of_level(scaled("level", 0.01)), ("unit-error", "rises", "level")),
        (scaled("level", 10), ("unit-error", "rises", "level")),
        (fixed("level", 0.03, 20 * day), ("sensor-stuck", "stuck", "level")),
        (fixed("rain", 0.3, 12, 20), ("sensor-stuck", "stuck", "rain")),
        (fixed("rain", 0.0, 30 * day), ("gauge-blocked", "runoff", "rain")),
        (shifted("runoff", -day), ("clock-shifted", "roof", "runoff")),
        (of_level(shifted("level", -day)), ("clock-shifted", "roof", "level")),
    ):
        assert finding in found(changed(record))


def test_a_column_of_nothing_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="level: has 0 values; it must have 100 at least"):
        found(fixed("level", np.nan, 0)(twin(30)))


def test_what_is_wrong_in_other_months_does_not_count() -> None:
    """A flow meter that is stuck in April; May to July are right."""
    record = fixed("runoff", 0.05, 0, 30 * DAY)(twin(100))
    assert "sensor-stuck" in [one.code for one in check_record(record, TWIN)]
    assert check_record(record.only(in_months(record, "5-7")), TWIN) == []


# --- roofs that are watered -----------------------------------------------------------------------


def kept_roof(days: int, mm_a_day: float = 4.25) -> Record:
    """A roof in a dry July that is watered each morning with what evaporates, 0.85 of 5 mm.

    Two showers of 4 and 6 mm; the meter shows no flow below 0.06 mm in 5 min.
    """
    step = np.arange(days * DAY)
    rain = np.zeros(len(step))
    for day, depth in ((8, 4.0), (19, 6.0)):
        rain[day * DAY + 200:day * DAY + 212] = depth / 12
    record = a_record(
        rain, month=7, runoff=rain,
        pumped=np.where((step % DAY >= 60) & (step % DAY < 64), mm_a_day / 4, 0.0),
        reference=np.where((step % DAY >= 72) & (step % DAY < 240), 5.0 / 168, 0.0),
    )
    simulated = simulate(TWIN, record, 0.35, least=0.06)
    noise = np.random.default_rng(1).normal(0, 0.002, len(step))
    return replace(record, runoff=simulated.runoff, level=simulated.level + noise)


def test_a_well_kept_roof_off_which_nothing_runs_is_right() -> None:
    """27 days, 125 mm on 100 mm of soil, and no runoff: so a good controller keeps a roof."""
    record = kept_roof(27)
    assert record.came.sum() == pytest.approx(124.75)
    assert not record.runoff.any()
    assert check_record(record, TWIN) == []


def test_a_flow_meter_that_shows_nothing_of_too_much_water_is_dead() -> None:
    """15 mm a day are more than a watered roof evaporates, 1.3 x 5 mm, by 230 mm in 27 days."""
    record = kept_roof(27, 15.0)
    dead = replace(record, runoff=np.zeros(record.steps), level=None)
    first, second = check_record(dead, TWIN)
    assert [(one.code, one.case) for one in (first, second)] == [
        ("sensor-dead", "nothing"), ("sensor-dead", "silent"),
    ]
    assert first.severity is Severity.REFUSAL
    assert first.figures["came"] == pytest.approx(27 * 15 + 10)
    assert first.text == "runoff: is 0 in all, of 415 mm that came: is the sensor dead?"


# --- evapotranspiration ---------------------------------------------------------------------------


def of_evapotranspiration(days: int, mm_a_day: float, month: int) -> Record:
    """A record with the same evapotranspiration at all times."""
    wet = np.tile([2.0] + [0.0] * (DAY - 1), days)
    reference = np.full(days * DAY, mm_a_day / DAY)
    record = a_record(wet, month=month, level=np.zeros(days * DAY), reference=reference)
    return replace(record, reference_column="ET")


def of_unit(record: Record, latitude: float | None = TWIN.latitude) -> list[str]:
    findings = check_record(record, replace(TWIN, latitude=latitude))
    return [one.case for one in findings if one.about == "ET"]


def test_a_day_with_too_much_evapotranspiration_is_found() -> None:
    """4 mm a day, taken for 12 times as much."""
    wrong = of_evapotranspiration(12, 48.0, 6)
    assert of_unit(wrong) == ["day"]
    computed = check_record(replace(wrong, reference_column=""), TWIN)
    assert "day" not in [one.case for one in computed]


# Mean reference evapotranspiration of warm and of cool humid regions (FAO-56, Table 2: 4 to 7 and 1
# to 2 mm a day); a December of central Europe.
@pytest.mark.parametrize(("month", "mm_a_day"), [(6, 7.0), (12, 0.3)])
def test_a_twelfth_of_a_month_is_found(month: int, mm_a_day: float) -> None:
    """What each day has may be so little; not where the place is unknown, nor in 29 days."""
    assert of_unit(of_evapotranspiration(30, mm_a_day, month)) == []
    assert of_unit(of_evapotranspiration(30, mm_a_day / 12, month)) == ["month"]
    assert of_unit(of_evapotranspiration(29, mm_a_day / 12, month)) == []
    assert of_unit(of_evapotranspiration(30, mm_a_day / 12, month), latitude=None) == []


# --- findings -------------------------------------------------------------------------------------


def test_a_refusal_stands_unless_it_is_accepted() -> None:
    """All of them in one message, a line each; what is accepted is a warning from then on."""
    stuck = FINDINGS.make(
        "sensor-stuck", "stuck", "level", value=0.03, unit="m", hours=30.0, since="noon", fell=12.0
    )
    dead = FINDINGS.make("sensor-dead", "nothing", "runoff", came=80.0)
    note = FINDINGS.make("months", "counted", "months", months="4-10")
    with pytest.raises(ConfigurationError) as error:
        accept([stuck, note, dead], ["unit-error"], Path("roof.csv"))
    first, second, way_out = str(error.value).splitlines()
    assert first.startswith("roof.csv: level: is 0.03 m for 30 h from noon")
    assert first.endswith("[sensor-stuck]") and second.endswith("[sensor-dead]")
    assert way_out.endswith("--accept sensor-stuck sensor-dead")
    with pytest.raises(ConfigurationError, match="sensor-dead"):
        accept([stuck, dead], ["sensor-stuck"], Path("roof.csv"))
    accepted = accept([stuck, note], ["sensor-stuck"], Path("roof.csv"))
    assert [one.severity for one in accepted] == [Severity.WARNING, Severity.NOTE]
    assert accepted[0].text.startswith("level (sensor-stuck, accepted): is 0.03 m for 30 h")


# --- fits -----------------------------------------------------------------------------------------

MEASURED = np.where(np.arange(240) % 60 < 6, 1.0, 0.0)
GOOD, HALF_MORE = 0.9 * MEASURED, 1.6 * MEASURED
# What falls where it rises has the mean's volume and an NSE of 1 - 4 = -3, of hours and of days.
OPPOSITE = 2 * MEASURED.mean() - MEASURED


def row(part: str, simulated: np.ndarray, step_s: float = 3600.0) -> Scores:
    seconds = (step_s * np.arange(len(MEASURED))).astype(np.int64)
    return score("runoff", part, simulated, MEASURED, seconds, step_s)


def of_fit(*rows: Scores) -> Finding | None:
    findings = check_fit(rows)
    assert len(findings) <= 1
    return findings[0] if findings else None


def test_worse_than_the_mean_everywhere_is_no_fit() -> None:
    one = of_fit(row("fit", OPPOSITE), row("validation", OPPOSITE))
    assert (one.code, one.severity) == ("no-fit", Severity.REFUSAL)
    assert one.text.startswith(
        "fit: no roof fits this record: NSE of runoff, fit: -3.00 (1 h) and -3.00 (1 day); runoff, "
        "validation: -3.00"
    )


def test_a_part_that_fits_is_a_fit_but_a_poor_one() -> None:
    one = of_fit(row("fit", GOOD), row("validation", OPPOSITE))
    assert (one.code, one.severity) == ("poor-fit", Severity.WARNING)
    assert one.text.startswith(
        "fit: worse than the mean of what was measured in the half that it has not seen (NSE of "
        "runoff -3.00 (1 day)): do not use it. Look at units,"
    )


def test_what_the_fit_has_not_seen_judges_its_volume_too() -> None:
    one = of_fit(row("fit", GOOD), row("validation", HALF_MORE))
    assert "wrong by much" in one.text and "(volume of runoff +60 %)" in one.text
    assert of_fit(row("fit", OPPOSITE), row("validation", GOOD)) is None


def test_of_daily_sums_days_judge() -> None:
    fitted, judged = (row(part, OPPOSITE, step_s=86400.0) for part in ("fit", "validation"))
    assert of_fit(row("fit", GOOD, step_s=86400.0), judged).code == "poor-fit"
    assert "NSE of runoff, fit: -3.00 (1 day); " in of_fit(fitted, judged).text


# --- level sensors --------------------------------------------------------------------------------


def test_dry_nights_show_noise_and_drift() -> None:
    """A level with a noise of 2 mm and a drift of -3 mm a month, of 60 days."""
    step = np.arange(60 * DAY)
    sun = (step % DAY >= 72) & (step % DAY < 216)
    true = 0.03 - 1e-6 * np.cumsum(sun)
    measured = true + np.random.default_rng(5).normal(0, 0.002, len(step))
    measured += -3.0 / 1000 / 30 * step / DAY
    reference = np.where(sun, 0.01, 0.0)
    record = a_record(np.zeros(60 * DAY), month=7, reference=reference, level=measured)
    figures = level_sensor(record, true).figures
    assert figures["nights"] == 61
    assert figures["noise"] == pytest.approx(2.0, rel=0.03)
    assert abs(figures["drift"] + 3.0) <= figures["half"] < 0.5
    wet = replace(record, rain=np.where(step % 100 == 0, 0.1, 0.0))
    assert level_sensor(wet, true).case == "unseen"
