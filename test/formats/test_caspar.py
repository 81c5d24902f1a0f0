"""CaSPAr's NetCDF, written here by its conventions: what is read from the header of its files.

Names, dimensions, units and standard names are as in 2024010100.nc of HRDPS (PAVICS,
HRDPS_P_PR_SFC) and in a member of an ensemble, 2018030100_000.nc; a missing value at the first hour
has NetCDF's fill value.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
from archives import write_runs
from paper import PAPER_SITE
from refusals import refusal

from greenroof_ros.analysis.study.grid import read_grid
from greenroof_ros.formats.reading import read_archive

TORONTO = replace(PAPER_SITE, latitude=43.63, longitude=-79.40)
# A rotated grid of 2.5 km about the site; its point [1, 2] is the nearest.
LATITUDES = np.array([[43.60, 43.61, 43.62, 43.63], [43.61, 43.62, 43.633, 43.65],
                      [43.65, 43.66, 43.67, 43.68]])
LONGITUDES = np.array([[-79.47, -79.44, -79.41, -79.38], [-79.46, -79.43, -79.398, -79.36],
                       [-79.45, -79.42, -79.39, -79.35]])
NEAREST = (1, 2)
# The sums of the issue of 2021-07-08 00 UTC at the point (m), from hour 0 on.
SUMS = [np.nan, 0.0, 0.001, 0.0015, 0.0015 - 2e-8, 0.004]


def write(
    file: Path, sums: Sequence[float] = SUMS, hours: Sequence[int] | None = None,
    product: str = "HRDPS", edit: Callable[[netCDF4.Dataset], None] = lambda dataset: None,
) -> Path:
    """Write a file as CaSPAr does; everywhere except at the point it rains 50 mm/h."""
    hours = list(range(len(sums))) if hours is None else list(hours)
    issued = f"{file.stem[:4]}-{file.stem[4:6]}-{file.stem[6:8]} {file.stem[8:10]}:00:00"
    with netCDF4.Dataset(file, "w", format="NETCDF4") as dataset:
        for dimension, size in (("time", None), ("rlat", 3), ("rlon", 4)):
            dataset.createDimension(dimension, size)
        time = dataset.createVariable("time", "i4", ("time",))
        time.setncatts({"units": f"hours since {issued}", "standard_name": "time"})
        time[:] = hours
        for what, degrees in (("latitude", LATITUDES), ("longitude", LONGITUDES)):
            rotated = dataset.createVariable(f"r{what[:3]}", "f4", (f"r{what[:3]}",))
            rotated.setncatts({"standard_name": f"grid_{what}", "units": "degrees"})
            place = dataset.createVariable(what[:3], "f4", ("rlat", "rlon"))
            place.setncatts({"standard_name": what, "units": "degrees"})
            place[:] = degrees
        rain = dataset.createVariable(f"{product}_P_PR_SFC", "f4", ("time", "rlat", "rlon"))
        rain.units = "m"
        everywhere = np.ones((1, 3, 4)) * 0.05 * np.array(hours)[:, None, None]
        everywhere[(slice(None), *NEAREST)] = sums
        rain[:] = np.ma.masked_invalid(everywhere)
        edit(dataset)
    return file


def test_hours_are_differences_of_the_nearest_points_sums(tmp_path: Path) -> None:
    """In mm; the sum before the first hour is treated as 0, although its value is missing."""
    archive = read_archive(write(tmp_path / "2021070800.nc"), TORONTO)
    assert (archive.kind, archive.delay, archive.members) == ("CaSPAr, HRDPS", 5.0, 1)
    (issue,) = archive.issues
    assert issue.issued.isoformat() == "2021-07-08T00:00:00+00:00"
    assert issue.rain[0].tolist() == pytest.approx([0.0, 1.0, 0.5, 0.0, 2.5], abs=1e-4)
    assert issue.rain.min() == 0.0
    # Without that hour, and with two beyond the variable's last, which are not forecast.
    other = write(tmp_path / "2021070806.nc", [*SUMS[1:], np.nan, np.nan], range(1, 8))
    (issue,) = read_archive(other, TORONTO).issues
    assert issue.rain[0].tolist() == pytest.approx([0.0, 1.0, 0.5, 0.0, 2.5], abs=1e-4)


def test_members_and_steps_of_three_and_six_hours(tmp_path: Path) -> None:
    """One file per member, control first; each hour between two sums has its share."""
    for number in range(3):
        for issue in ("2021070800", "2021070812"):
            sums = [np.nan, 0.003 * number, 0.003 * number + 0.012]
            write(tmp_path / f"{issue}_{number:03}.nc", sums, [0, 3, 9], "GEPS")
    archive = read_archive(tmp_path, TORONTO)
    assert (archive.kind, archive.delay, archive.members) == ("CaSPAr, GEPS", 7.0, 3)
    assert [issue.issued.hour for issue in archive.issues] == [0, 12]
    for issue in archive.issues:
        for number, rain in enumerate(issue.rain):
            expected = [number] * 3 + [2.0] * 6
            assert rain.tolist() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("product", "delay"), [("RDPS", 5.0), ("GDPS", 6.0)])
def test_longest_archives(tmp_path: Path, product: str, delay: float) -> None:
    """RDPS is hourly, GDPS every three hours; a browser may have numbered a file."""
    hours = [0, 3, 6] if product == "GDPS" else [0, 1, 2]
    file = tmp_path / "2021070800 (1).nc"
    write(tmp_path / "2021070800.nc", [np.nan, 0.003, 0.006], hours, product).rename(file)
    archive = read_archive(file, TORONTO)
    assert (archive.kind, archive.delay) == (f"CaSPAr, {product}", delay)
    assert archive.issues[0].rain[0] == pytest.approx(6 * [1.0] if hours[1] == 3 else [3.0, 3.0])


def test_a_missing_sum(tmp_path: Path) -> None:
    """It lies between its neighbours, and the others are kept."""
    archive = read_archive(write(tmp_path / "2021070800.nc", [0, 0.001, np.nan, 0.005]), TORONTO)
    assert archive.issues[0].rain[0] == pytest.approx([1.0, 2.0, 2.0], abs=1e-4)
    assert archive.notes == (
        "2021070800.nc: the sum 2 h after the issue is missing, and lies between its neighbours",
    )


@pytest.mark.parametrize("code", [-9999.0, -999.0, 1e20, 9.96921e36])
def test_a_code_for_a_missing_sum(tmp_path: Path, code: float) -> None:
    """A file does not always name its code."""
    archive = read_archive(write(tmp_path / "2021070800.nc", [0, 0.001, code, 0.005]), TORONTO)
    assert archive.issues[0].rain[0] == pytest.approx([1.0, 2.0, 2.0], abs=1e-4)
    assert "the sum 2 h after the issue is missing" in archive.notes[0]


def test_a_member_that_ends_early(tmp_path: Path) -> None:
    """All end with it; a member with hardly any hour is left out."""
    for number, count in enumerate((6, 5, 2)):
        sums = [np.nan, *(0.001 * hour for hour in range(1, count))]
        write(tmp_path / f"2021070800_{number:03}.nc", sums, range(count), "REPS")
    archive = read_archive(tmp_path, TORONTO)
    assert archive.issues[0].rain == pytest.approx(np.ones((2, 4)), abs=1e-4)
    assert "member 2 is left out: it has 1 hours, and others 5" in archive.notes[0]


def test_longitudes_to_the_east_and_axes_of_their_own(tmp_path: Path) -> None:
    """A grid by latitude and longitude; 280.6 degrees east is 79.4 west."""
    def regular(dataset: netCDF4.Dataset) -> None:
        for name in ("lat", "lon"):
            dataset[name].delncattr("standard_name")
        dataset["rlat"].standard_name, dataset["rlon"].standard_name = "latitude", "longitude"
        dataset["rlat"][:] = [43.1, 43.6, 44.1]
        dataset["rlon"][:] = [279.5, 280.0, 280.5, 281.0]

    (issue,) = read_archive(write(tmp_path / "2021070800.nc", edit=regular), TORONTO).issues
    assert issue.rain[0].tolist() == pytest.approx([0.0, 1.0, 0.5, 0.0, 2.5], abs=1e-4)


def attribute(variable: str, name: str, value: str) -> Callable[[netCDF4.Dataset], None]:
    """Return a function that sets an attribute of a variable."""
    return lambda dataset: dataset[variable].setncattr(name, value)


def with_dimensions(variable: str, *dimensions: str) -> Callable[[netCDF4.Dataset], None]:
    """Return a function that replaces a variable by one of other dimensions, same attributes."""
    def edit(dataset: netCDF4.Dataset) -> None:
        dataset.renameVariable(variable, "before")
        dataset.createDimension("later", 9)
        other = dataset.createVariable(variable, "f8", dimensions)
        other.setncatts(dataset["before"].__dict__)
    return edit


RAIN = "HRDPS_P_PR_SFC"
PLACES = (
    f"{RAIN!r}: must have the dimensions time and the two of latitude (rlat, rlon) and longitude "
    "(rlat, rlon), "
)
OF_SUMS = f"{RAIN}: must be the sum since the issue; it gives "
WRONG: list[tuple[dict[str, Any], str]] = [
    (
        {"edit": attribute(RAIN, "units", "kg m**-2 s**-1")},
        f"{RAIN}:units = 'kg m**-2 s**-1': must be 'm', for the sum since the issue",
    ),
    (
        {"edit": attribute("time", "units", "hours since 2021-07-08 06:00:00")},
        "time:units = 'hours since 2021-07-08 06:00:00': must be 'hours since 2021-07-08 00:00:00'",
    ),
    (
        {"product": "CaLDAS"},
        f"must have one variable of precipitation, such as {RAIN}, of one of HRDPS, RDPS, GDPS, "
        "REPS, GEPS, GEPS_NA; it has time, rlat, lat, rlon, lon, CaLDAS_P_PR_SFC",
    ),
    (
        {"edit": lambda dataset: dataset["lon"].delncattr("standard_name")},
        "must have a variable of standard_name 'longitude'",
    ),
    (
        {"edit": lambda dataset: dataset["lat"].__setitem__(slice(None), LATITUDES + 1)},
        "has no point within 0.5 degrees of the site's place, 43.63, -79.4; the nearest is 0.",
    ),
    ({"sums": [0.0, 0.003, 0.001]}, f"{OF_SUMS}-2 mm/h before hour 2, outside 0 to 500"),
    ({"sums": [0.0, 1.0, 3.0]}, f"{OF_SUMS}1000 mm/h before hour 1, outside"),  # mm, not m
    (
        {"edit": lambda dataset: dataset[RAIN].__setitem__((slice(2, 4), *NEAREST), np.inf)},
        f"{RAIN}: is missing 2 h after the issue",
    ),
    (
        {"hours": [0, 1, 2, 3, 4, 28]},
        "time: must have more hours, each 1 to 6 after the one before, not 0, 1, 2, 3, 4, 28",
    ),
    (  # times of a separate dimension: the last sums would be used for the first hours
        {"edit": with_dimensions("time", "later")},
        f"{PLACES}not (time, rlat, rlon) with times of (later)",
    ),
    (  # the same number of points, in another order
        {"edit": with_dimensions(RAIN, "time", "rlon", "rlat")}, f"{PLACES}not (time, rlon, rlat)",
    ),
]


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(("changes", "reason"), WRONG)
def test_wrong_files(tmp_path: Path, changes: dict[str, Any], reason: str) -> None:
    """Refused, before any warning, with file, variable or attribute, and what would be right."""
    file = write(tmp_path / "2021070800.nc", **changes)
    assert refusal(read_archive, file, TORONTO).startswith(f"{file}: {reason}")


def test_files_that_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Damaged files, other names, a site without a place; without the reader, what to install."""
    file = write(tmp_path / "2021070800.nc")
    whole = file.read_bytes()
    for length in (4, len(whole) // 3):
        file.write_bytes(whole[:length])
        refusal(read_archive, file, TORONTO, match=r"2021070800.nc: is not readable NetCDF: ")
    for name in ("forecast.nc", "2021130800.nc"):
        other = write(tmp_path / "2021070806.nc").rename(tmp_path / name)
        refusal(read_archive, other, TORONTO, match="must be named as in CaSPAr, YYYYMMDDHH")
    anywhere = replace(TORONTO, latitude=None, longitude=None)
    refusal(read_archive, file, anywhere, match="needs latitude and longitude in the site file")
    monkeypatch.setitem(sys.modules, "netCDF4", None)  # as if it were not installed
    refusal(read_archive, file, TORONTO, match=r"install greenroof_ros with its extra \[netcdf\]")


def test_members_of_several_products(tmp_path: Path) -> None:
    """An issue's members must be of one; test_bad_input.py has the other rules of members."""
    for number, product in enumerate(("REPS", "GEPS")):
        write(tmp_path / f"2021070800_{number:03}.nc", product=product)
    refusal(read_archive, tmp_path, TORONTO, match=r"001.nc: must be of REPS, as 2021070800_000")


def test_a_study_carries_archives_in_the_own_format(tmp_path: Path) -> None:
    """A directory is one file, with the delay of its kind or its own.

    CaSPAr's file has its issue in its name, which a study may change.
    """
    write(tmp_path / "2021070706.nc")
    write_runs(tmp_path / "runs")
    grid = tmp_path / "grid.yaml"
    grid.write_text(
        "site: site.yaml\nweather:\n"
        "  - {file: weather/toronto_2021-07.csv, start: 2021-07-07T10:00-05:00, hours: 1}\n"
        "initial: low-low\ncontrollers: {anticipating_onoff: {}}\n"
        "forecast: [2021070706.nc, runs/, {model: runs/, delay: 2.0}]\n"
    )
    netcdf, usual, early = read_grid(grid)
    assert usual.forecast_files == early.forecast_files
    assert [case.forecast.delay for case in (netcdf, usual, early)] == [5.0, 6.0, 2.0]
    for case, source in ((netcdf, "2021070706.nc"), (usual, "runs")):
        (tmp_path / "carried.csv").write_bytes(case.forecast_files["file"].content)
        carried, own = (
            [(issue.issued, issue.rain.tolist()) for issue in read_archive(file, TORONTO).issues]
            for file in (tmp_path / "carried.csv", tmp_path / source)
        )
        assert carried == own
