"""Checks of records and fits: good ones pass, bad ones get their code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from places import DATA
from refusals import refusal
from twins import DAY, TWIN, a_record, record_of, record_rows

from greenroof_ros.analysis.calibration.checks import (
    FINDINGS,
    check_fit,
    check_record,
    level_sensor,
)
from greenroof_ros.analysis.calibration.csv_record import read_csv_record
from greenroof_ros.analysis.calibration.record import RoofRecord, in_months
from greenroof_ros.analysis.calibration.scores import FitScores, score
from greenroof_ros.analysis.calibration.simulation import simulate
from greenroof_ros.common.files import shared_directory
from greenroof_ros.common.quality import Severity, accept
from greenroof_ros.model.site import read_site

Change = Callable[[np.ndarray, int], np.ndarray]
"""changes a column, given the number of its steps in a day"""


@cache
def twin(days: int, hours: int = 0, *, gaps: bool = False) -> RoofRecord:
    """Return the record of a twin; with hours, its sums over this many hours."""
    return record_of(record_rows(TWIN, days, 1, gaps=gaps), hours)


def scaled(factor: float) -> Change:
    return lambda values, day: factor * values


def shifted(hours: float) -> Change:
    return lambda values, day: np.roll(values, round(hours * day / 24))


def fixed(value: float, first: float, end: float = np.inf) -> Change:
    """Return a change to a constant value from a day on."""
    def changed(values: np.ndarray, day: int) -> np.ndarray:
        at = np.arange(len(values)) / day
        return np.where((at >= first) & (at < end), value, values)
    return changed


def sparse(values: np.ndarray, day: int) -> np.ndarray:
    """Keep only every third row."""
    return np.where(np.arange(len(values)) % 3, np.nan, values)


def changed(record: RoofRecord, column: str, change: Change) -> RoofRecord:
    day = round(86400 / record.step_s)
    return replace(record, **{column: change(getattr(record, column), day)})


def cases(record: RoofRecord) -> list[tuple[str, ...]]:
    """Return what the checks find: code, case, column, and for a clock whether it is early."""
    return [
        (finding.code, finding.case, finding.about, str(finding.figures.get("side", "")))
        for finding in check_record(record, TWIN)
    ]


# --- records --------------------------------------------------------------------------------------

# For five-minute steps of a month, and for longer sums of a season: the columns present, the one
# that is changed and how, and what is found.
BOTH, LEVEL = ("runoff", "level"), ("level",)
OF_A_MONTH: dict[str, tuple[tuple[str, ...], str, Change, tuple[str, ...]]] = {
    "rain in metres": (BOTH, "rain", scaled(0.001), ("unit-error", "little rain", "rain")),
    "rain of a day": (BOTH, "rain", scaled(24), ("unit-error", "much rain", "rain")),
    "level in cm": (BOTH, "level", scaled(100), ("unit-error", "high level", "level")),
    "runoff in m": (BOTH, "runoff", scaled(1e-4), ("unit-error", "little runoff", "runoff")),
    "rain of the hour": (BOTH, "rain", scaled(12), ("unit-error", "held", "runoff")),
    "stuck": (BOTH, "runoff", fixed(0.05, 5), ("sensor-stuck", "stuck", "runoff")),
    "blocked": (LEVEL, "rain", fixed(0.0, 8), ("gauge-blocked", "rise", "rain")),
    "sparse": (BOTH, "level", sparse, ("sensor-sparse", "sparse", "level")),
    "early": (BOTH, "runoff", shifted(-1), ("clock-shifted", "roof", "runoff", "before")),
    "late": (BOTH, "runoff", shifted(8), ("clock-shifted", "roof", "runoff", "after")),
    "early level": (LEVEL, "level", shifted(-1), ("clock-shifted", "roof", "level", "before")),
    "late level": (LEVEL, "level", shifted(24), ("clock-shifted", "roof", "level", "after")),
}
OF_A_SEASON: dict[str, tuple[tuple[str, ...], str, Change, tuple[str, ...]]] = {
    "dead": (BOTH, "runoff", scaled(0.0), ("sensor-dead", "silent", "runoff")),
    "runoff too large": (BOTH, "runoff", scaled(10), ("unit-error", "excess", "runoff")),
    "runoff too small": (BOTH, "runoff", scaled(0.1), ("unit-error", "shares", "runoff")),
    "level too small": (LEVEL, "level", scaled(0.01), ("unit-error", "rises", "level")),
    "level too large": (BOTH, "level", scaled(10), ("unit-error", "rises", "level")),
    "stuck level": (BOTH, "level", fixed(0.03, 20), ("sensor-stuck", "stuck", "level")),
    "stuck rain": (BOTH, "rain", fixed(0.3, 12, 20), ("sensor-stuck", "stuck", "rain")),
    "blocked": (BOTH, "rain", fixed(0.0, 30), ("gauge-blocked", "runoff", "rain")),
    "early": (BOTH, "runoff", shifted(-24), ("clock-shifted", "roof", "runoff", "before")),
    "early level": (LEVEL, "level", shifted(-24), ("clock-shifted", "roof", "level", "before")),
}


@pytest.mark.parametrize("hours", [0, 1, 24])
def test_right_records_have_nothing_wrong_and_wrong_ones_have(hours: int) -> None:
    record = twin(100, hours) if hours else twin(60, gaps=True)
    for right in (record, replace(record, runoff=None)):
        assert cases(right) == []
    seen = record if hours else twin(30)
    for name, (there, *change, finding) in (OF_A_SEASON if hours else OF_A_MONTH).items():
        alone = seen if "runoff" in there else replace(seen, runoff=None)
        assert (*finding, "")[:4] in cases(changed(alone, *change)), name


def test_what_is_reported_of_a_clock_and_a_gauge() -> None:
    """The runoff of an hour later, or of eight hours earlier; it follows rain within 10 minutes.

    A gauge of 100 days that is blocked on day 30 is dry from its last rain to the end.
    """
    for hours, spans in ((-1, ["50 min", "55 min", "60 min"]), (8, ["8.0 h", "8.1 h", "8.2 h"])):
        (finding,) = check_record(changed(twin(30), "runoff", shifted(hours)), TWIN)
        assert finding.figures["span"] in spans
    findings = check_record(changed(twin(100, 1), "rain", fixed(0.0, 30)), TWIN)
    (blocked,) = [finding for finding in findings if finding.case == "runoff"]
    assert 70 <= float(blocked.figures["days"]) < 80


def test_a_column_of_nothing_is_refused() -> None:
    nothing = changed(twin(30), "level", fixed(np.nan, 0))
    refusal(cases, nothing, match="level: has 0 values; it must have at least 100")


def test_what_is_wrong_in_other_months_does_not_count() -> None:
    """A flow meter that is stuck in April; May to July are good."""
    record = changed(twin(100, 1), "runoff", fixed(0.05, 0, 30))
    assert "sensor-stuck" in [code for code, *_ in cases(record)]
    assert check_record(record.only(in_months(record, "5-7")), TWIN) == []


# --- roofs off which nothing runs -----------------------------------------------------------------


def test_a_measured_soil_in_dry_weeks_is_right() -> None:
    """The roof at Neubrandenburg, 45 days with 39 mm of rain and no runoff.

    With three times the rain, 116 mm, the soil of 108 mm could not hold it.
    """
    site = read_site(shared_directory() / "config" / "site_neubrandenburg.yaml")
    file = DATA / "neubrandenburg_dry.csv"
    record = read_csv_record(file, replace(site, utc_offset=1.0))
    assert np.nansum(record.rain) == pytest.approx(38.61)
    assert np.nansum(record.runoff) == 0
    assert check_record(record, site) == []
    (finding,) = check_record(replace(record, rain=3 * record.rain), site)
    assert (finding.code, finding.case) == ("sensor-dead", "silent")


def test_gaps_do_not_hide_a_dead_flow_meter() -> None:
    """113 mm in all steps with readings, at most 63 mm without a gap; the soil is 100 mm deep."""
    record = changed(twin(60, gaps=True), "runoff", scaled(0.0))
    (finding,) = check_record(record, TWIN)
    assert (finding.code, finding.case) == ("sensor-dead", "silent")
    known = record.rain[~np.isnan(record.runoff)]
    assert finding.figures["came"] == pytest.approx(known.sum())
    assert 100 < known.sum() < 120
    without = np.where(np.cumsum(np.where(np.isnan(record.runoff), 0.0, record.rain)) > 99.0,
                       np.nan, record.runoff)
    assert check_record(replace(record, runoff=without), TWIN) == []


# --- roofs that are watered -----------------------------------------------------------------------


def watered_roof(days: int, mm_a_day: float = 4.25) -> RoofRecord:
    """A roof in a dry July, watered each morning with its evapotranspiration, 0.85 of 5 mm.

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
    simulated = simulate(TWIN, record, 0.35, minimum=0.06)
    noise = np.random.default_rng(1).normal(0, 0.002, len(step))
    return replace(record, runoff=simulated.runoff, level=simulated.level + noise)


def test_a_well_kept_roof_off_which_nothing_runs_is_right() -> None:
    """27 days, 125 mm on 100 mm of soil, and no runoff: a good controller does this."""
    record = watered_roof(27)
    assert record.water.sum() == pytest.approx(124.75)
    assert not record.runoff.any()
    assert check_record(record, TWIN) == []
    # After one watering it rains enough: 121 mm in 60 days, in which 240 mm could evaporate.
    rain = np.tile([2 / DAY] * DAY, 60)
    rainy = a_record(
        rain, month=7, runoff=np.zeros(60 * DAY), reference=2 * rain,
        pumped=np.where(np.arange(60 * DAY) == 72, 1.0, 0.0),
    )
    assert "sensor-dead" not in [finding.code for finding in check_record(rainy, TWIN)]


def test_a_flow_meter_that_shows_nothing_of_too_much_water_is_dead() -> None:
    """15 mm a day exceed what a watered roof evaporates, 1.3 x 5 mm, by 230 mm in 27 days."""
    record = watered_roof(27, 15.0)
    dead = replace(record, runoff=np.zeros(record.steps), level=None)
    (finding,) = check_record(dead, TWIN)
    assert (finding.code, finding.case) == ("sensor-dead", "silent")
    assert finding.severity is Severity.REFUSAL
    assert finding.figures["came"] == pytest.approx(27 * 15 + 10)
    assert finding.text == (
        "runoff: is 0 for 27 days from 2021-07-01 00:00:00, in which 415 mm came, more than 100 "
        "mm: is the sensor dead? Leave the cells empty there"
    )


# --- evapotranspiration ---------------------------------------------------------------------------


def of_evapotranspiration(days: int, mm_a_day: float, month: int) -> RoofRecord:
    """Return a record with constant evapotranspiration."""
    wet = np.tile([2.0] + [0.0] * (DAY - 1), days)
    reference = np.full(days * DAY, mm_a_day / DAY)
    record = a_record(wet, month=month, level=np.zeros(days * DAY), reference=reference)
    return replace(record, reference_column="ET")


def of_unit(record: RoofRecord, latitude: float | None = TWIN.latitude) -> list[str]:
    findings = check_record(record, replace(TWIN, latitude=latitude))
    return [finding.case for finding in findings if finding.about == "ET"]


def test_a_day_with_too_much_evapotranspiration_is_found() -> None:
    """4 mm a day, read as 12 times as much."""
    wrong = of_evapotranspiration(12, 48.0, 6)
    assert of_unit(wrong) == ["day"]
    assert "day" not in [case for _, case, *_ in cases(replace(wrong, reference_column=""))]


# Mean reference evapotranspiration of warm and of cool humid regions (FAO-56, Table 2: 4 to 7 and 1
# to 2 mm a day); a December in central Europe.
@pytest.mark.parametrize(("month", "mm_a_day"), [(6, 7.0), (12, 0.3)])
def test_a_twelfth_of_a_month_is_found(month: int, mm_a_day: float) -> None:
    """A single day can be so low; no finding without a place, nor for 29 days."""
    assert of_unit(of_evapotranspiration(30, mm_a_day, month)) == []
    assert of_unit(of_evapotranspiration(30, mm_a_day / 12, month)) == ["month"]
    assert of_unit(of_evapotranspiration(29, mm_a_day / 12, month)) == []
    assert of_unit(of_evapotranspiration(30, mm_a_day / 12, month), latitude=None) == []


# --- findings -------------------------------------------------------------------------------------


def test_a_refusal_stands_unless_it_is_accepted() -> None:
    """All in one message, a line each; an accepted finding becomes a warning."""
    stuck = FINDINGS.make(
        "sensor-stuck", "stuck", "level", value=0.03, unit="m", hours=30.0, since="noon", fell=12.0
    )
    dead = FINDINGS.make(
        "sensor-dead", "silent", "runoff", days=30, since="noon", came=120.0, most=100.0
    )
    note = FINDINGS.make("months", "counted", "months", months="4-10")
    for accepted, codes in (([], "sensor-stuck sensor-dead"), (["sensor-stuck"], "sensor-dead")):
        reason = refusal(accept, [stuck, note, dead], accepted, Path("roof.csv"))
        *lines, way_out = reason.splitlines()
        assert lines[0].startswith("roof.csv: ")
        assert way_out.endswith(f"--accept {codes}")
        assert " ".join(line.split("[")[-1].strip("]") for line in lines) == codes
    done = accept([stuck, note], ["sensor-stuck"], Path("roof.csv"))
    assert [finding.severity for finding in done] == [Severity.WARNING, Severity.NOTE]
    assert done[0].text.startswith("level (sensor-stuck, accepted): is 0.03 m for 30 h from noon")


# --- fits -----------------------------------------------------------------------------------------

MEASURED = np.where(np.arange(240) % 60 < 6, 1.0, 0.0)
GOOD, HALF_MORE = 0.9 * MEASURED, 1.6 * MEASURED
# Falls where the data rise: the mean's volume, and NSE 1 - 4 = -3 of hours and of days.
OPPOSITE = 2 * MEASURED.mean() - MEASURED


def row(part: str, simulated: np.ndarray, step_s: float = 3600.0) -> FitScores:
    seconds = (step_s * np.arange(len(MEASURED))).astype(np.int64)
    return score("runoff", part, simulated, MEASURED, seconds, step_s)


def test_a_fit_is_judged_by_the_half_that_it_has_not_seen() -> None:
    """There is no fit if it is worse than the mean everywhere; daily sums are judged by days."""
    for fitted, judged, step_s, code, text in (
        (OPPOSITE, OPPOSITE, 3600.0, "no-fit",
         "no roof fits this record: NSE of runoff, fit: -3.00 (1 h) and -3.00 (1 day); run"),
        (GOOD, OPPOSITE, 3600.0, "poor-fit", "worse than the mean of what was measured in the "
         "half that it has not seen (NSE of runoff -3.00 (1 day)): do not use it. Check"),
        (GOOD, HALF_MORE, 3600.0, "poor-fit",
         "far off in the half that it has not seen (volume of runoff +60 %)"),
        (OPPOSITE, OPPOSITE, 86400.0, "no-fit",
         "no roof fits this record: NSE of runoff, fit: -3.00 (1 day); "),
    ):
        (finding,) = check_fit([row("fit", fitted, step_s), row("validation", judged, step_s)])
        refused = finding.severity is Severity.REFUSAL
        assert (finding.code, refused) == (code, code == "no-fit")
        assert finding.text.startswith(f"fit: {text}")
    assert check_fit([row("fit", OPPOSITE), row("validation", GOOD)]) == []


def test_a_half_without_runoff_judges_no_fit() -> None:
    """It is refused, but can be accepted; a fit that is poor even where it was fitted is not.

    A level that changes judges the fit.
    """
    nothing = np.zeros(240)
    dry = score("runoff", "validation", nothing, nothing, np.arange(240) * 3600, 3600.0)
    (finding,) = check_fit([row("fit", GOOD), dry])
    assert (finding.code, finding.severity) == ("unjudged", Severity.REFUSAL)
    assert [finding.code for finding in check_fit([row("fit", OPPOSITE), dry])] == ["no-fit"]
    level = row("validation", GOOD)._replace(quantity="level")
    assert check_fit([row("fit", GOOD), dry, level]) == []


# --- level sensors --------------------------------------------------------------------------------


def test_dry_nights_show_noise_and_drift() -> None:
    """A level of 60 days with a noise of 2 mm and a drift of -3 mm a month."""
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
