"""What speaks against records and fits: right ones are left alone, wrong ones have their code."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from changes import (
    DAY,
    LEVEL,
    RAIN,
    RUNOFF,
    Change,
    Rows,
    a_record,
    both,
    cell,
    change,
    from_row,
    same,
    scaled,
    shifted,
    twin,
    without,
)
from twins import TWIN, record_rows, summed, write

from greenroof_ros.calibration.checks import FINDINGS, check_fit, check_record, level_sensor
from greenroof_ros.calibration.csv_record import read_csv_record
from greenroof_ros.calibration.record import Record, in_months
from greenroof_ros.calibration.scores import Scores, score
from greenroof_ros.calibration.simulation import simulate
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.quality import Finding, Severity, accept

HOURS = (1, 6, 24)


def found(rows: Rows, file: Path) -> list[tuple[str, str, str]]:
    """What the checks find: code, case and column of each finding."""
    record = read_csv_record(write(rows, file), TWIN)
    return [(one.code, one.case, one.about) for one in check_record(record, TWIN)]


# --- records --------------------------------------------------------------------------------------

WRONG: dict[str, tuple[Change, tuple[str, str, str]]] = {
    "rain in metres": (scaled(RAIN, 0.001), ("unit-error", "little rain", "rain")),
    "rain of a day in an hour": (scaled(RAIN, 24), ("unit-error", "much rain", "rain")),
    "level in cm called m": (scaled(LEVEL, 100), ("unit-error", "high level", "level")),
    "level in m called mm": (cell(0, LEVEL, "level [mm]"), ("unit-error", "rises", "level")),
    "level in cm called mm": (scaled(LEVEL, 0.1), ("unit-error", "rises", "level")),
    "runoff of a larger roof": (scaled(RUNOFF, 10), ("unit-error", "excess", "runoff")),
    "runoff in m called mm": (scaled(RUNOFF, 1e-4), ("unit-error", "little runoff", "runoff")),
    "rain of the hour in 5 minutes": (
        both(scaled(RAIN, 12), without(LEVEL)), ("unit-error", "held", "runoff")),
    "runoff of a smaller roof": (
        both(scaled(RUNOFF, 4), without(LEVEL)), ("unit-error", "excess", "runoff")),
    "a dead runoff sensor": (scaled(RUNOFF, 0.0), ("sensor-dead", "nothing", "runoff")),
    "a stuck level": (from_row(5 * DAY, LEVEL, "0.0300"), ("sensor-stuck", "stuck", "level")),
    "a stuck runoff": (from_row(5 * DAY, RUNOFF, "0.0500"), ("sensor-stuck", "stuck", "runoff")),
    "a stuck rain gauge": (
        from_row(5 * DAY, RAIN, "0.1000", 6 * DAY), ("sensor-stuck", "stuck", "rain")),
    "a blocked rain gauge": (from_row(8 * DAY, RAIN, "0"), ("gauge-blocked", "runoff", "rain")),
    "a blocked rain gauge beside a level": (
        both(without(RUNOFF), change(RAIN, lambda row, text: text if row < 8 * DAY else "0")),
        ("gauge-blocked", "rise", "rain")),
    "a level of every third row": (
        change(LEVEL, lambda row, text: text if row % 3 == 0 else ""),
        ("sensor-sparse", "sparse", "level")),
    "a clock two hours early": (shifted(RUNOFF, -24), ("clock-shifted", "roof", "runoff")),
    "level an hour early": (
        both(without(RUNOFF), shifted(LEVEL - 1, -12)), ("clock-shifted", "roof", "level")),
    "runoff an hour early": (shifted(RUNOFF, -12), ("clock-shifted", "roof", "runoff")),
    "runoff of another time zone": (shifted(RUNOFF, 96), ("clock-shifted", "roof", "runoff")),
    "level a day late": (
        both(without(RUNOFF), shifted(LEVEL - 1, 288)), ("clock-shifted", "roof", "level")),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_with_a_month_is_found(name: str, tmp_path: Path) -> None:
    changed, finding = WRONG[name]
    assert finding in found(changed(twin(30, 1)), tmp_path / "wrong.csv")


def test_right_records_have_nothing_wrong(tmp_path: Path) -> None:
    for seed in range(3):
        assert found(record_rows(TWIN, 60, seed), tmp_path / "record.csv") == []
    assert found(twin(100, 1), tmp_path / "season.csv") == []


@pytest.mark.parametrize(
    ("column", "factor"),
    [(RAIN, 10), (RAIN, 1 / 12), (RAIN, 0.1), (RUNOFF, 10), (RUNOFF, 12), (RUNOFF, 0.1),
     (RUNOFF, 1 / 12), (LEVEL, 10), (LEVEL, 0.1)],
)
def test_of_a_season_a_wrong_unit_is_found(column: int, factor: float, tmp_path: Path) -> None:
    codes = found(scaled(column, factor)(twin(100, 1)), tmp_path / "season.csv")
    assert "unit-error" in [code for code, _, _ in codes]


@pytest.mark.parametrize("hours", HOURS)
def test_sums_of_longer_steps_have_nothing_wrong(hours: int, tmp_path: Path) -> None:
    """With runoff, with the level alone, and of other weather."""
    for rows in (summed(twin(100, seed), hours) for seed in (1, 2)):
        for changed in (same, without(RUNOFF), without(LEVEL)):
            assert found(changed(rows), tmp_path / "record.csv") == []


@pytest.mark.parametrize("hours", HOURS)
def test_what_is_wrong_with_longer_sums_is_found(hours: int, tmp_path: Path) -> None:
    """A day's steps are 24 / hours."""
    day = 24 // hours
    for changed, finding in (
        (scaled(RUNOFF, 10), ("unit-error", "excess", "runoff")),
        (both(without(RUNOFF), cell(0, LEVEL - 1, "level [cm]")),
         ("unit-error", "rises", "level")),
        (from_row(20 * day, LEVEL, "0.03"), ("sensor-stuck", "stuck", "level")),
        (from_row(12, RAIN, "0.3", 20), ("sensor-stuck", "stuck", "rain")),
        (from_row(30 * day, RAIN, "0"), ("gauge-blocked", "runoff", "rain")),
        (shifted(RUNOFF, -day), ("clock-shifted", "roof", "runoff")),
        (both(without(RUNOFF), shifted(LEVEL - 1, -day)), ("clock-shifted", "roof", "level")),
    ):
        assert finding in found(changed(summed(twin(100, 1), hours)), tmp_path / "wrong.csv")


def test_a_column_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="level: has 0 values; it must have 100 at least"):
        found(change(LEVEL, lambda *_: "")(twin(30, 1)), tmp_path / "empty.csv")


def test_what_is_wrong_in_other_months_does_not_count(tmp_path: Path) -> None:
    """A flow meter that is stuck and a level that is nonsense in April; May is right."""
    rows = [list(row) for row in record_rows(TWIN, 60, 1)]
    for row in rows[1:]:
        if row[0].startswith("2021-04"):
            row[RUNOFF], row[LEVEL] = "0.05", "0.3"
    record = read_csv_record(write(rows, tmp_path / "record.csv"), TWIN)
    assert "sensor-stuck" in [one.code for one in check_record(record, TWIN)]
    assert check_record(record.only(in_months(record, "5-6")), TWIN) == []


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
    assert [(one.code, one.case) for one in check_record(dead, TWIN)] == [
        ("sensor-dead", "nothing"), ("sensor-dead", "silent"),
    ]


def test_a_flow_meter_that_dies_is_found(tmp_path: Path) -> None:
    """Nobody waters this roof; 136 mm fall on 100 mm of soil."""
    rows = from_row(30 * DAY, RUNOFF, "0")(twin(100, 1))
    assert ("sensor-dead", "silent", "runoff") in found(rows, tmp_path / "dead.csv")


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
    assert of_unit(of_evapotranspiration(12, 4.0, 6)) == []
    wrong = of_evapotranspiration(12, 48.0, 6)
    assert of_unit(wrong) == ["day"]
    computed = check_record(replace(wrong, reference_column=""), TWIN)
    assert "day" not in [one.case for one in computed]


# Mean reference evapotranspiration of warm and of cool humid regions (FAO-56, Table 2: 4 to 7 and 1
# to 2 mm a day); a December of central Europe.
@pytest.mark.parametrize(("month", "mm_a_day"), [(6, 7.0), (6, 4.0), (9, 2.0), (12, 0.3)])
def test_a_twelfth_of_a_month_is_found(month: int, mm_a_day: float) -> None:
    """What each day has may be so little; not where the place is unknown, nor in 29 days."""
    assert of_unit(of_evapotranspiration(30, mm_a_day, month)) == []
    assert of_unit(of_evapotranspiration(30, mm_a_day / 12, month)) == ["month"]
    assert of_unit(of_evapotranspiration(29, mm_a_day / 12, month)) == []
    assert of_unit(of_evapotranspiration(30, mm_a_day / 12, month), latitude=None) == []


# --- findings -------------------------------------------------------------------------------------


def test_a_finding_has_its_figures_and_says_them() -> None:
    (first, _) = check_record(
        replace(kept_roof(27, 15.0), runoff=np.zeros(27 * DAY), level=None), TWIN
    )
    assert first.severity is Severity.REFUSAL
    assert first.figures["came"] == pytest.approx(27 * 15 + 10)
    assert first.text == "runoff: is 0 in all, of 415 mm that came: is the sensor dead?"


def test_a_refusal_stands_unless_it_is_accepted() -> None:
    """All of them in one message, a line each; what is accepted is a warning from then on."""
    stuck = FINDINGS.make(
        "sensor-stuck", "stuck", "level", value=0.03, unit="m", hours=30.0, since="noon", fell=12.0
    )
    dead = FINDINGS.make("sensor-dead", "nothing", "runoff", came=80.0)
    note = FINDINGS.make("months", "counted", "months", months="4-10")
    with pytest.raises(ConfigurationError) as error:
        accept([stuck, note, dead], ["unit-error"], Path("roof.csv"))
    lines = str(error.value).splitlines()
    assert lines[0].startswith("roof.csv: level: is 0.03 m for 30 h from noon")
    assert lines[0].endswith("[sensor-stuck]") and lines[1].endswith("[sensor-dead]")
    assert lines[2].endswith("--accept sensor-stuck sensor-dead")
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


def row(
    part: str, simulated: np.ndarray, quantity: str = "runoff", step_s: float = 3600.0
) -> Scores:
    seconds = (step_s * np.arange(len(MEASURED))).astype(np.int64)
    return score(quantity, part, simulated, MEASURED, seconds, step_s)


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
    levels = [row("fit", GOOD, "level"), row("validation", GOOD, "level")]
    poor = of_fit(row("fit", OPPOSITE), row("validation", OPPOSITE), *levels)
    assert poor.code == "poor-fit"


def test_a_volume_that_is_wrong_by_more_than_half_is_poor() -> None:
    one = of_fit(row("fit", GOOD), row("validation", HALF_MORE))
    assert "wrong by much" in one.text and "(volume of runoff +60 %)" in one.text


def test_of_daily_sums_days_judge() -> None:
    fitted, judged = (row(part, OPPOSITE, step_s=86400.0) for part in ("fit", "validation"))
    assert of_fit(row("fit", GOOD, step_s=86400.0), judged).code == "poor-fit"
    assert "NSE of runoff, fit: -3.00 (1 day); " in of_fit(fitted, judged).text


def test_nothing_is_said_of_a_fit_that_is_good_where_it_is_judged() -> None:
    assert of_fit(row("fit", OPPOSITE), row("validation", GOOD)) is None


# --- level sensors --------------------------------------------------------------------------------


@pytest.mark.parametrize("drift", [0.0, 6.0, -3.0])
def test_dry_nights_show_noise_and_drift(drift: float) -> None:
    """A level with a noise of 2 mm and a drift in mm a month, of 60 days."""
    step = np.arange(60 * DAY)
    sun = (step % DAY >= 72) & (step % DAY < 216)
    true = 0.03 - 1e-6 * np.cumsum(sun)
    measured = true + np.random.default_rng(5).normal(0, 0.002, len(step))
    measured += drift / 1000 / 30 * step / DAY
    reference = np.where(sun, 0.01, 0.0)
    record = a_record(np.zeros(60 * DAY), month=7, reference=reference, level=measured)
    figures = level_sensor(record, true).figures
    assert figures["nights"] == 61
    assert figures["noise"] == pytest.approx(2.0, rel=0.03)
    assert abs(figures["drift"] - drift) <= figures["half"] < 0.5
    wet = replace(record, rain=np.where(step % 100 == 0, 0.1, 0.0))
    assert level_sensor(wet, true).case == "unseen"
