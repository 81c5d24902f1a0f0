"""Depths of rain from published tables, and design storms against published hyetographs."""

from __future__ import annotations

import math
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from places import CONFIG, DATA, refusal

from greenroof_ros.weather.design_storm import (
    Depths,
    fit_gumbel,
    fit_record,
    make_storm,
    read_depths,
)
from greenroof_ros.weather.records import Records

NOAA = read_depths(DATA / "noaa_atlas_14_fort_myers.yaml")
CANADA = read_depths(DATA / "eccc_idf_charlottetown.yaml")
IDF = "file: idf.csv\nreturn_periods: [2, 10]\nunit: mm\n"


def described(
    directory: Path, text: str, table: str = "5;5,1;8\n60 min;12;20,5\n2 h;14;25\n"
) -> Path:
    """Write a description beside a table, and return it."""
    (directory / "idf.csv").write_text(table)
    file = directory / "depths.yaml"
    file.write_text(text)
    return file


def depth(depths: Depths, minutes: float, period: float) -> float:
    """Return one depth (mm)."""
    return float(depths.depth(np.array([minutes]), period)[0])


@pytest.mark.parametrize(("depths", "minutes", "period", "mm"), [
    (NOAA, 5, 1, 0.553 * 25.4), (NOAA, 60, 2, 2.38 * 25.4), (NOAA, 1440, 100, 12.1 * 25.4),
    (NOAA, 2880, 1000, 20.7 * 25.4), (CANADA, 5, 2, 5.1), (CANADA, 120, 10, 42.8),
    (CANADA, 1440, 100, 128.1),
])
def test_entries_of_a_table_are_exact(
    depths: Depths, minutes: float, period: float, mm: float
) -> None:
    assert depth(depths, minutes, period) == pytest.approx(mm, rel=1e-12)


def test_between_entries() -> None:
    """45 min is between 30 and 60 min, 19.7 and 28.4 mm; 7 years between 5 and 10."""
    share = math.log(45 / 30) / math.log(2)
    expected = 19.7 ** (1 - share) * 28.4**share
    assert depth(CANADA, 45, 10) == pytest.approx(expected, rel=1e-12)
    share = math.log(7 / 5) / math.log(2)
    assert depth(CANADA, 60, 7) == pytest.approx(24.6 + share * (28.4 - 24.6), rel=1e-12)


def test_intensities_are_the_depths_of_the_other_table(tmp_path: Path) -> None:
    """Table 2b has in mm/h, rounded to a tenth, what table 2a has in mm."""
    file = tmp_path / "rates.yaml"
    file.write_text(
        f"file: {DATA / 'eccc_idf_charlottetown.txt'}\nafter: Table 2b\nunit: mm/h\n"
        "return_periods: [2, 5, 10, 25, 50, 100]\n"
    )
    rates = read_depths(file)
    for minutes in (5, 10, 15, 30, 60, 120):
        for period in CANADA.periods:
            rounding = 0.05 * minutes / 60 + 0.05 + 1e-9
            found = depth(rates, minutes, period)
            assert found == pytest.approx(depth(CANADA, minutes, period), abs=rounding)


def test_a_table_with_decimal_commas(tmp_path: Path) -> None:
    depths = read_depths(described(tmp_path, IDF + "decimal: ','\n"))
    assert depth(depths, 60, 10) == pytest.approx(20.5)
    assert depth(depths, 5, 2) == pytest.approx(5.1)


@pytest.mark.parametrize(("text", "table", "reason"), [
    (IDF.replace("unit: mm\n", ""), "", "unit: must be stated"),
    (IDF.replace("[2, 10]", "[10, 2]"), "", "line 2: return_periods"),
    (IDF + "after: Table 2a\n", "5 1 2\n", "after = 'Table 2a'"),
    *((IDF, table, "idf.csv, line 2: ") for table in (
        "5 1 2\n10 2\n", "5 60 90\n10 40 70\n", "5 1 2\n10 2 -3\n", "10 2 3\n5 1 2\n",
    )),
    (IDF, "5 2 1\n10 3 2\n", "idf.csv, line 1: "),
    (IDF, "duration 2 10\n", "idf.csv: must have lines that begin with a duration"),
    ("parameters: {2: [700, 6, 1.5]}\n", "", "parameters.*grow with the duration"),
    ("parameters: {2: [700, 6]}\n", "", "parameters: must contain a, b and c"),
    ("record: [a.csv]\nreturn_periods: [1, 2]\n", "", "above 1 for a record"),
    ("return_periods: [2]\n", "", "file: must be stated"),
])
def test_a_wrong_description_is_refused(
    text: str, table: str, reason: str, tmp_path: Path
) -> None:
    refusal(read_depths, described(tmp_path, text, table), match=reason)


def test_gumbel_has_the_depths_of_canadas_table() -> None:
    """Table 2a is Gumbel's distribution of table 1, whose maxima are rounded to a tenth."""
    rows = np.genfromtxt(
        DATA / "eccc_idf_charlottetown.txt", skip_header=7, max_rows=32, missing_values="-99.9"
    )[:, 1:]
    for place, expected in enumerate(CANADA.table):
        maxima = rows[rows[:, place] > 0, place]
        found = fit_gumbel(maxima[np.newaxis], CANADA.periods)[0]
        assert found == pytest.approx(expected, abs=0.15)


def test_the_maxima_of_a_record() -> None:
    """Six years, in each of which one storm of two hours has the maximum, and a gap is in one."""
    hours = 6 * 8760 + 2 * 24  # 2016 and 2020 have leap days
    rain = np.zeros(hours)
    peaks = np.array([10.0, 14, 30, 12, 22, 18])
    for year, mm in enumerate(peaks):
        rain[year * 8766 + 4000 : year * 8766 + 4002] = mm, mm / 2
    records = Records(
        (Path("gauge.csv"),), datetime(2015, 1, 1, tzinfo=timezone.utc), {"precipitation": rain}
    )
    durations, depths, note = fit_record(records, [2, 10])
    assert durations.tolist() == [60, 120, 360, 720, 1440]
    scale = peaks.std(ddof=1) * math.sqrt(6) / math.pi
    of_hour = peaks.mean() - 0.5772156649 * scale - scale * math.log(-math.log(0.9))
    assert depths[0, 1] == pytest.approx(of_hour, rel=1e-6)
    assert depths[1:, 1] == pytest.approx([1.5 * of_hour] * 4, rel=1e-6)
    assert "6 years, 2015 to 2020, in steps of 60 min" in note and "7 years" in note
    short = records.cut(0, 4 * 8766)
    refusal(fit_record, short, [2], match="must have 5 years with rain for 90%.*but has 4")


def test_torontos_record(tmp_path: Path) -> None:
    """It begins in June 2014; its wettest hour is in a December, most likely by an error."""
    record = CONFIG / "weather" / "toronto_2014-2025.csv.gz"
    found = read_depths(described(tmp_path, f"record: [{record}]\nreturn_periods: [2, 100]\n"))
    assert "11 years, 2015 to 2025" in found.note and "79.2 mm" in found.note
    for axis in (0, 1):
        assert (np.diff(found.table, axis=axis) > 0).all()


# The City of Ottawa's storms of three hours in steps of ten minutes (mm/h), which go with the
# formulas of its Sewer Design Guidelines (2012). The peak is at a third.
OTTAWA = {
    5: (3.68, 4.58, 6.15, 9.61, 24.17, 104.19, 32.04, 16.34, 10.96, 8.29, 6.69, 5.63, 4.87, 4.30,
        3.86, 3.51, 3.22, 2.98),
    100: (6.05, 7.54, 10.16, 15.97, 40.65, 178.56, 54.05, 27.32, 18.24, 13.74, 11.06, 9.29, 8.02,
          7.08, 6.35, 5.76, 5.28, 4.88),
}


@pytest.fixture
def ottawa(tmp_path: Path) -> Depths:
    """The depths of Ottawa's formula."""
    return read_depths(described(
        tmp_path, "parameters: {5: [998.071, 6.053, 0.814], 100: [1735.688, 6.014, 0.820]}\n"
    ))


@pytest.mark.parametrize("period", [5, 100])
def test_ottawas_chicago_storm(period: int, ottawa: Depths) -> None:
    found = 6 * make_storm(ottawa, period, "chicago", 180, 10, 1 / 3)
    assert found == pytest.approx(OTTAWA[period], rel=0.01)
    assert found.sum() / 6 == pytest.approx(depth(ottawa, 180, period), rel=1e-9)
    assert found.max() / 6 == pytest.approx(depth(ottawa, 10, period), rel=1e-9)


def test_parts_around_the_peak_have_the_depths_of_their_durations(ottawa: Depths) -> None:
    """With the peak in the middle, every odd number of steps around it is such a part."""
    rain = make_storm(ottawa, 100, "chicago", 125, 5, 0.5)
    for steps in (1, 5, 11, 25):
        part = rain[12 - steps // 2 : 13 + steps // 2].sum()
        assert part == pytest.approx(depth(ottawa, 5 * steps, 100), rel=1e-3)


def test_kostras_euler_storm() -> None:
    """KOSTRA-DWD-2010R, cell 49011, 60 min and 100 years: the example of dimfalk/kostra2010R.

    The example spreads the rain between the durations of the table evenly, so its own sums are the
    table here.
    """
    expected = [4.1, 5.2, 7.2, 14.4, 3.3, 3.3, 2.5, 2.5, 2.5, 2.0, 2.0, 2.0]
    sums = np.cumsum(sorted(expected, reverse=True))[:, np.newaxis]
    table = Depths([100.0], np.arange(5.0, 61.0, 5.0), sums, "")
    assert make_storm(table, 100, "euler", 60, 5) == pytest.approx(expected)


def test_euler_beside_idf_analysis() -> None:
    """Steps (mm) of idf-analysis 0.4.1 for two hours of Charlottetown's ten years, by log-log."""
    expected = [
        1.47, 1.54, 1.56, 1.669, 1.797, 2.6, 3.5, 8.9, 1.395, 1.377, 1.363, 1.335, 1.331, 1.296,
        1.275, 1.262, 1.23, 1.201, 1.174, 1.149, 1.125, 1.104, 1.083, 1.064,
    ]
    assert make_storm(CANADA, 10, "euler", 120, 5) == pytest.approx(expected, abs=6e-4)


@pytest.mark.parametrize("kind", ["block", "euler", "chicago"])
@pytest.mark.parametrize(("duration", "step"), [(5, 5), (60, 5), (90, 15), (720, 60)])
def test_every_storm_has_the_depth_of_its_duration(kind: str, duration: int, step: int) -> None:
    rain: NDArray[np.float64] = make_storm(CANADA, 25, kind, duration, step)
    assert len(rain) == duration // step and (rain > 0).all()
    assert rain.sum() == pytest.approx(depth(CANADA, duration, 25), rel=1e-9)
    if kind == "block":
        assert np.ptp(rain) == 0


@pytest.mark.parametrize(("options", "reason"), [
    ((3, "eulr", 60, 5), "kind = 'eulr'"),
    ((200, "euler", 60, 5), "return_periods = 200"), ((10, "euler", 62, 5), "duration = 62"),
    ((10, "block", 60, 2), "1440 min"), ((10, "chicago", 60, 5, 0.0), "peak = 0.0"),
])
def test_a_wrong_storm_is_refused(options: tuple[object, ...], reason: str) -> None:
    refusal(make_storm, CANADA, *options, match=reason)
