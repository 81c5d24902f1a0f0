"""The fit finds the roof that made a record, and says what it cannot find."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsers import started_browser
from commands import run_command
from graphs import environment
from recover_twins import ELSEWHERE, recover, true_value
from twins import TWIN, record_rows, summed, write

from greenroof_ros.calibration.csv_record import read_csv_record
from greenroof_ros.calibration.fit import fit, ranges
from greenroof_ros.calibration.halves import halve
from greenroof_ros.calibration.record import Record
from greenroof_ros.calibration.site_file import refuse_unlike
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import shared_directory
from greenroof_ros.model.site import read_site

DAYS = 45
PUMPED = replace(TWIN, a_in=300.0, a_hat=-1e6, c_hat=45.0)


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    file = tmp_path_factory.mktemp("twin") / "twin.csv"
    return read_csv_record(write(record_rows(TWIN, DAYS, 2), file), TWIN)


def test_a_twin_is_recovered(tmp_path: Path) -> None:
    """From two months, with noise of 2 mm and gaps; ten years of them are a campaign's."""
    parameters = recover(DAYS, 2, tmp_path)
    assert {one.name for one in parameters if one.told} == {
        "field_capacity", "wilting_point", "depletion_fraction", "drainage_time",
        "crop_coefficient", "filled",
    }
    for one in parameters:
        assert one.low <= true_value(one.name) <= one.high, one
        assert one.value == pytest.approx(true_value(one.name), rel=0.05), one


def test_runoff_alone_tells_only_what_the_soil_holds_between(record: Record) -> None:
    """Field capacity and wilting point count by their difference; the level tells them apart.

    So the interval of the field capacity allows for any wilting point, also for the true one.
    """
    record = replace(record, level=None)
    found = fit(ELSEWHERE, record, record.known)
    by_name = {one.name: one for one in found.parameters}
    assert not by_name["wilting_point"].told
    assert "cannot tell it apart from field_capacity" in by_name["wilting_point"].words
    assert by_name["wilting_point"].value == pytest.approx(0.02)
    true = TWIN.field_capacity - TWIN.wilting_point
    capacity = by_name["field_capacity"]
    assert capacity.value - 0.02 == pytest.approx(true, rel=0.05)
    assert capacity.low < TWIN.field_capacity < capacity.high
    highest = next(one.high for one in ranges(ELSEWHERE, record) if one.name == "wilting_point")
    assert capacity.high - capacity.value == pytest.approx(highest - 0.02, rel=0.15)


def test_levels_alone_tell_nothing_of_the_drainage_layer(record: Record) -> None:
    found = fit(ELSEWHERE, replace(record, runoff=None), record.known)
    by_name = {one.name: one for one in found.parameters}
    assert by_name["drainage_time"].words == "the data do not depend on it"
    assert by_name["drainage_time"].value == pytest.approx(300.0)
    assert by_name["field_capacity"].value == pytest.approx(TWIN.field_capacity, rel=0.03)


@pytest.mark.parametrize("hours", [1, 6])
def test_longer_steps_do_not_make_more_runoff(hours: int, tmp_path: Path) -> None:
    """Of 150 days, with the true drainage time in the site file: of six hours it is not fitted.

    Rain comes evenly in a simulated step, and so runs off late. Step against step, a fit of these
    records of six hours makes up for that by 15 % more runoff.
    """
    rows = summed(record_rows(TWIN, 150, 2, gaps=False), hours)
    record = read_csv_record(write(rows, tmp_path / "sums.csv"), TWIN)
    site = replace(ELSEWHERE, drainage_time=TWIN.drainage_time)
    found = fit(site, record, record.known)
    for one in found.parameters:
        assert not one.told or one.low <= true_value(one.name) <= one.high, one
    told = {one.name: one.value for one in found.parameters if one.told}
    assert told["field_capacity"] == pytest.approx(TWIN.field_capacity, rel=0.02)
    assert told["crop_coefficient"] == pytest.approx(TWIN.crop_coefficient, rel=0.05)
    assert ("drainage_time" in told) == (hours == 1)
    simulated, measured = (
        series[record.known].sum() for series in (found.simulated.runoff, record.runoff)
    )
    assert simulated == pytest.approx(measured, rel=0.02)


def test_of_daily_sums_the_soil_is_found(tmp_path: Path) -> None:
    """Of 150 days' sums and morning levels; how fast the roof drains they cannot tell."""
    rows = summed(record_rows(TWIN, 150, 1, gaps=False), 24)
    record = read_csv_record(write(rows, tmp_path / "days.csv"), TWIN)
    found = fit(ELSEWHERE, record, record.known)
    by_name = {one.name: one for one in found.parameters}
    for name in ("field_capacity", "wilting_point", "crop_coefficient", "depletion_fraction"):
        one = by_name[name]
        assert one.low <= true_value(name) <= one.high, one
    assert by_name["field_capacity"].value == pytest.approx(TWIN.field_capacity, rel=0.1)
    assert by_name["crop_coefficient"].value == pytest.approx(TWIN.crop_coefficient, rel=0.15)
    drainage = by_name["drainage_time"]
    assert not drainage.told
    assert drainage.words == "steps of 1 day are too long to tell it"
    assert drainage.value == found.site.drainage_time == ELSEWHERE.drainage_time


def test_few_sums_tell_few_parameters(tmp_path: Path) -> None:
    """Of twelve days' runoff there are four sums of four days at most, and of the roof five
    parameters that could be fitted.
    """
    rows = summed(record_rows(TWIN, 110, 1, gaps=False), 24)
    record = read_csv_record(write(rows, tmp_path / "days.csv"), TWIN)
    found = fit(ELSEWHERE, replace(record, level=None), np.arange(record.steps) < 12)
    assert sum(one.told for one in found.parameters) <= 4
    assert all(one.words for one in found.parameters if not one.told)


def test_a_fit_says_how_far_it_is(record: Record) -> None:
    """Each stage in turn; the share grows with each simulation, and ends at 1."""
    told: list[tuple[str, float]] = []
    fit(ELSEWHERE, record, record.known, lambda text, share: told.append((text, share)))
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert (shares[0], told[-1]) == (0.0, ("done", 1.0))
    stages = [re.match(r"(\d) of 5: (.*), \d+ simulations", text) for text, _ in told[:-1]]
    assert list(dict.fromkeys(stage[1] for stage in stages)) == ["1", "2", "3", "4", "5"]
    # One for each parameter and one before; then the start and a grid of 3 x 4 x 2.
    assert sum(stage[1] == "1" for stage in stages) == 1 + 7
    assert sum(stage[1] == "2" for stage in stages) == 1 + 25
    assert f"last search, {len(told) - 1 - 5} simulations" in told[-2][0]


def test_a_dead_day_of_a_sensor_does_not_decide(record: Record) -> None:
    """A level that reads 8 cm too much for a day, among sixty: the loss is robust."""
    level = record.level.copy()
    level[20 * 288:21 * 288] += 0.08
    found = fit(ELSEWHERE, replace(record, level=level), record.known)
    field_capacity = next(one for one in found.parameters if one.name == "field_capacity")
    assert field_capacity.value == pytest.approx(TWIN.field_capacity, rel=0.03)


def test_halves_have_the_same_water_and_no_storm_in_common(record: Record) -> None:
    halves = halve(record, record.known)
    assert not np.any(halves.earlier & halves.later)
    assert np.array_equal(halves.earlier | halves.later, record.known)
    first = int(np.argmax(halves.later))
    assert record.rain[first - 287:first].sum() == 0
    share = np.sum(record.rain[halves.earlier]) / np.sum(record.rain[record.known])
    assert 0.5 <= share < 0.7


def calibrate(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return run_command("calibrate", *arguments, cwd=directory, env=environment(0))


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory in which the command has run on a twin, from the paper's site.

    Its pumps are worn: their data sheet has 50 m. Its target is more than the roof holds.
    """
    directory = tmp_path_factory.mktemp("command")
    write(record_rows(PUMPED, DAYS, 2, pumping=True), directory / "twin.csv")
    text = (shared_directory() / "config" / "site.yaml").read_text(encoding="utf-8")
    for was, now in (
        ("a2: 68.8", "a2: 100.0"),
        ("z_veg: 0.0457", "z_veg: 0.06"),
        ("z_soil: 0.5", "z_soil: 0.1"),
        ("latitude: 43.63", "latitude: 52.5"), ("longitude: -79.40", "longitude: 13.4"),
        ("utc_offset: -5.0", "utc_offset: 1.0"), ("a_in: 0.2922466566001905", "a_in: 300.0"),
    ):
        assert was in text
        text = text.replace(was, now)
    (directory / "site.yaml").write_text(text, encoding="utf-8")
    # On the curve 50 - 1e6 q^2.
    (directory / "pump.csv").write_text("flow [m3/s],head [m]\n0,50\n0.002,46\n0.004,34\n")
    ended = subprocess.run(
        [
            sys.executable, "-m", "greenroof_ros.calibrate", "twin.csv", "--site", "site.yaml",
            "-o", "fitted.yaml", "--pump-data", "pump.csv", "--months", "4-6",
        ],
        cwd=directory, env=environment(0), capture_output=True, text=True, check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert "runoff, validation" in ended.stdout
    assert "crop_coefficient counts where evapotranspiration is computed" in ended.stdout
    assert "intervals allow for what the record cannot tell apart" in ended.stdout
    assert "do not use it" not in ended.stdout
    assert "data sheet: a_hat -1e+06 s2/m5, c_hat 50 m" in ended.stdout
    assert "target: z_veg was 0.06 m, and the fitted roof holds 0.0" in ended.stdout
    assert "pumps: 5" in ended.stdout  # l/s, sqrt((2 + 45 - 16) / 1e6) and a little less
    # On a slow machine a line every ten seconds, and nothing else.
    progress = re.compile(r"(\d of \d: .*|done): \d+%")
    assert [line for line in ended.stderr.splitlines() if not progress.fullmatch(line)] == []
    noise = re.search(r"level sensor: noise (\S+) mm and drift", ended.stdout)[1]
    assert float(noise) == pytest.approx(2.0, abs=0.15)  # as the twin was made
    return directory


def test_the_command_writes_a_site_that_can_be_used(fitted: Path) -> None:
    site = read_site(fitted / "fitted.yaml")
    assert site.field_capacity == pytest.approx(TWIN.field_capacity, rel=0.05)
    assert site.drainage_time == pytest.approx(TWIN.drainage_time, rel=0.1)
    text = (fitted / "fitted.yaml").read_text(encoding="utf-8")
    assert text.startswith("# Fitted to twin.csv by greenroof calibrate.\n")
    assert "# runoff, validation: NSE " in text
    top = " ".join(line[2:] for line in text.split("\n\n")[0].splitlines())
    for note in (
        "data sheet: a_hat ", "months: 4-6 are", "target: z_veg was ", "level sensor: noise ",
        "pumps: 5",
    ):
        assert note in top
    # Between wilting point and field capacity, 0.1 m deep.
    middle = (site.wilting_point + site.field_capacity) / 2
    assert site.z_veg == pytest.approx(0.1 * middle, rel=1e-4)
    assert site.a_hat == pytest.approx(-1e6, rel=1e-5)
    lines = {line.split(":")[0]: line for line in text.splitlines()}
    assert lines["a_hat"].endswith(
        "fitted to points of the data sheet; the data cannot tell it apart from c_hat"
    )
    low, high = map(float, re.search(r"fitted, (\S+) to (\S+) \(95 %\)", lines["c_hat"]).groups())
    assert low <= 45.0 <= high
    assert high - low < 6.0
    assert low < site.c_hat < high
    assert lines["crop_coefficient"].endswith(
        "; counts where evapotranspiration is computed (fao56; hargreaves in calibrate), not with "
        "a weather file's own column"
    )
    assert site.z_pump == 0.15  # what was not fitted stays, with its comment
    assert "# m       elevation of the pumps above the cistern's base [T1]" in text


def test_a_data_sheet_needs_no_record(fitted: Path, tmp_path: Path) -> None:
    """Two lines of the site file are other ones, and nothing else."""
    sheet = str(fitted / "pump.csv")
    ended = calibrate(tmp_path, "--pump-data", sheet, "-o", "pumped.yaml")
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == (
        "data sheet: a_hat -1e+06 s2/m5, c_hat 50 m\nwritten: pumped.yaml\n"
    )
    was, now = (
        file.read_text(encoding="utf-8").splitlines()
        for file in (shared_directory() / "config" / "site.yaml", tmp_path / "pumped.yaml")
    )
    assert now[:2] == ["# Pumps fitted to pump.csv by greenroof calibrate.", ""]
    changed = [line for before, line in zip(was, now[2:], strict=True) if line != before]
    assert changed == [
        "a_hat: -1e+06                 # s2/m5   fitted to points of the data sheet",
        "c_hat: 50                     # m       fitted to points of the data sheet",
    ]
    site = read_site(tmp_path / "pumped.yaml")
    assert (site.a_hat, site.c_hat) == (-1e6, 50.0)


def test_pumps_that_lift_no_water_are_refused(tmp_path: Path) -> None:
    (tmp_path / "low.csv").write_text("flow [m3/s],head [m]\n0,15\n0.004,9\n")
    ended = calibrate(tmp_path, "--pump-data", "low.csv", "-o", "pumped.yaml")
    assert ended.returncode == 2
    assert ended.stderr == (
        "error: low.csv: the curve has 15 m at no flow; it must exceed d - z_pump - z_H = 15.25 m "
        "of the site, or the pumps never lift water to the roof (Eq. 3e)\n"
    )


@pytest.mark.parametrize("form", ["flow", "quoted"])
def test_a_site_file_whose_lines_cannot_be_replaced_is_refused(
    form: str, fitted: Path, tmp_path: Path
) -> None:
    """YAML that reads alike: all in one line, or keys in quotes. Their old values would stay."""
    text = (shared_directory() / "config" / "site.yaml").read_text(encoding="utf-8")
    pairs = re.findall(r"(?m)^(\w+): *(\[.*\]|[^ #\n]+)", text)
    lines = {
        "flow": "{" + ", ".join(f"{key}: {value}" for key, value in pairs) + "}\n",
        "quoted": "".join(f'"{key}": {value}\n' for key, value in pairs),
    }[form]
    (tmp_path / "site.yaml").write_text(lines, encoding="utf-8")
    read_site(tmp_path / "site.yaml")
    ended = calibrate(
        tmp_path, "--pump-data", str(fitted / "pump.csv"), "--site", "site.yaml", "-o", "new.yaml"
    )
    assert ended.returncode == 2
    assert ended.stderr == (
        f"error: site.yaml, line 1: {pairs[0][0]}: the site file must have one 'key: value' a "
        f"line, as in '{pairs[0][0]}: 1.0'\n"
    )
    assert not (tmp_path / "new.yaml").exists()


def test_a_text_that_is_not_the_fitted_site_is_refused(tmp_path: Path) -> None:
    """A value on a line of its own stays, as one of whose line only the key was replaced."""
    file = shared_directory() / "config" / "site.yaml"
    site, text = read_site(file), file.read_text(encoding="utf-8")
    refuse_unlike(text, site, file)
    with pytest.raises(ConfigurationError, match=r"c_hat = 55\.2: .* stay, and 50 was fitted"):
        refuse_unlike(text, replace(site, c_hat=50.0), file)
    with pytest.raises(ConfigurationError) as error:
        refuse_unlike(f"{text}x2_star: 40\n", site, file)
    assert str(error.value).startswith(
        f"{file}: with what was fitted it is no site, and nothing is written: x2_star = 40: must"
    )


@pytest.mark.parametrize(
    ("output", "why"),
    [(".", "must be the name of a file that ends in .yaml"),
     ("/", "must be the name of a file that ends in .yaml"),
     ("site.html", "must be the name of a file that ends in .yaml"),
     ("nowhere/site.yaml", "must be in a directory that exists and can be written to")],
)
def test_an_output_that_cannot_be_written_is_refused_before_the_fit(
    output: str, why: str, tmp_path: Path
) -> None:
    """That there is no such record is found after it."""
    ended = calibrate(tmp_path, "none.csv", "-o", output)
    assert ended.returncode == 2
    assert ended.stderr == f"error: --output = '{output}': {why}\n"


def test_a_data_sheet_in_no_unit_at_all_is_refused(tmp_path: Path) -> None:
    (tmp_path / "wild.csv").write_text("flow [m3/s],head [m]\n0,1e300\n0.004,9\n")
    ended = calibrate(tmp_path, "--pump-data", "wild.csv", "-o", "pumped.yaml")
    assert ended.returncode == 2
    assert ended.stderr.startswith(
        "error: wild.csv, line 2: '0,1e300': must be a flow from 0 to 0.5 m3/s and a head from 0 "
        "to 500 m; are they in other units"
    )
    (tmp_path / "litres.csv").write_text("flow [m3/s],head [m]\n0,55\n4,46\n8,20\n")
    ended = calibrate(tmp_path, "--pump-data", "litres.csv", "-o", "pumped.yaml")
    assert ended.returncode == 2
    assert "error: litres.csv, line 3: '4,46': must be a flow from 0 to 0.5 m3/s" in ended.stderr
    assert "such as l/s" in ended.stderr
    (tmp_path / "wild.csv").write_text("flow [m3/s],head [m]\n0,50\n1e-8,9\n")
    ended = calibrate(tmp_path, "--pump-data", "wild.csv", "-o", "pumped.yaml")
    assert ended.returncode == 2
    assert "nothing is written: a_hat = -4.1e+17: must be from" in ended.stderr


def test_months_that_are_none_are_refused_before_the_record_is_read(tmp_path: Path) -> None:
    ended = calibrate(tmp_path, "none.csv", "-o", "fitted.yaml", "--months", "April")
    assert ended.returncode == 2
    assert ended.stderr.startswith("error: --months = 'April': must be the first and the last")
    assert ended.stderr.count("\n") == 1


def test_something_must_be_given(tmp_path: Path) -> None:
    ended = calibrate(tmp_path, "-o", "fitted.yaml")
    assert ended.returncode == 2
    assert ended.stderr == "error: MEASURED: must be given, or --pump-data alone\n"


def test_it_writes_over_nothing(fitted: Path) -> None:
    ended = calibrate(fitted, "twin.csv", "--site", "site.yaml", "-o", "fitted.yaml")
    assert ended.returncode == 2
    assert ended.stderr == "error: --output = 'fitted.yaml': exists; name another file\n"


def test_the_page_draws_everything_and_asks_for_nothing(fitted: Path) -> None:
    with started_browser() as browser:
        page: Any = browser.new_page(viewport={"width": 1200, "height": 900})
        asked, wrong = [], []
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto((fitted / "fitted.html").as_uri())
        page.wait_for_selector("html[data-drawn='8']", timeout=60_000)
        assert wrong == []
        assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []
        words = page.inner_text("main")
        assert "field_capacity" in words
        assert "Measured and simulated" not in words  # titles are drawn
        notes = page.locator("#notes li").all_inner_texts()
        assert [note.split(":")[0] for note in notes] == [
            "data sheet", "months", "target", "level sensor", "pumps"
        ]
        assert "The crop_coefficient counts where evapotranspiration is computed" in words
        assert page.locator("canvas").count() == 8
