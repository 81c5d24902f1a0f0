"""The command: the site file and the page that it writes, what it refuses, its input."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from browsers import drawn_page
from commands import run_command
from graphs import environment
from places import DATA
from refusals import refusal
from twins import TWIN, record_rows, write

from greenroof_ros.analysis.calibration.result import format_fitted_site
from greenroof_ros.base.files import shared_directory
from greenroof_ros.site.file import format_site, read_site

PUMPED = replace(TWIN, a_in=300.0, a_hat=-1e6, c_hat=45.0)
PAPER = shared_directory() / "config" / "site.yaml"


def calibrate(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return run_command("calibrate", *arguments, cwd=directory, env=environment(0))


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory in which the command fitted a twin, starting from the paper's site.

    Its target is more than the roof holds.
    """
    directory = tmp_path_factory.mktemp("command")
    write(record_rows(PUMPED, 32, 2, pumping=True), directory / "twin.csv")
    (directory / "site.yaml").write_text(format_site(read_site(PAPER, {
        "a2": 100.0, "z_veg": 0.06, "z_soil": 0.1, "latitude": 52.5, "longitude": 13.4,
        "utc_offset": 1.0, "a_in": 300.0, "a_hat": -1e6, "c_hat": 45.0,
    })), encoding="utf-8")
    ended = calibrate(
        directory, "twin.csv", "--site", "site.yaml", "-o", "fitted.yaml", "--months",
        "4-6",
    )
    assert ended.returncode == 0, ended.stderr
    assert "runoff, validation" in ended.stdout
    # On a slow machine a line every ten seconds, and nothing else.
    progress = re.compile(r"(exponent .*|done): \d+%")
    said = [line for line in ended.stderr.splitlines() if not progress.fullmatch(line)]
    assert {line.partition(":")[0] for line in said} == {"record", "note"}
    return directory


def test_the_command_writes_a_site_that_can_be_used(fitted: Path) -> None:
    site = read_site(fitted / "fitted.yaml")
    assert site.field_capacity == pytest.approx(TWIN.field_capacity, rel=0.05)
    assert site.drainage_time == pytest.approx(TWIN.drainage_time, rel=0.1)
    text = (fitted / "fitted.yaml").read_text(encoding="utf-8")
    assert text.startswith("# Fitted to twin.csv by greenroof calibrate.\n")
    top = " ".join(line[2:] for line in text.split("\n\n")[0].splitlines())
    assert re.search(r"runoff, validation: NSE .*\(1 day\); KGE [01]\.\d\d \(1 day\); volume ", top)
    assert "compared: " in top and "target: z_veg was " in top
    assert "do not use this fit" not in top
    # Between wilting point and field capacity, 0.1 m deep.
    middle = (site.wilting_point + site.field_capacity) / 2
    assert site.z_veg == pytest.approx(0.1 * middle, rel=1e-4)
    lines = {line.split(":")[0]: line for line in text.splitlines()}
    assert "percolation_exponent: the NSE in the validation is" in top
    exponents = re.search(r"fitted, (\S+) to (\S+); not a 95", lines["percolation_exponent"])
    low, high = map(float, exponents.groups())
    assert low <= site.percolation_exponent == TWIN.percolation_exponent <= high
    assert site.z_pump == 0.15  # a value that was not fitted stays
    assert "# m       height of the pumps above the cistern's base" in text


def test_months_are_checked_before_anything_is_read(tmp_path: Path) -> None:
    ended = calibrate(tmp_path, "missing.csv", "-o", "new.yaml", "--months", "4")
    assert ended.returncode == 2 and "--months = '4': must be the first and" in ended.stderr


NEW = {"c_hat": (50.0, "new"), "z_veg": (0.04, "new"), "wilting_point": (0.05, "w"),
       "field_capacity": (0.3, "f"), "depletion_fraction": (0.5, "p")}


def test_volumes_follow_in_a_site_file_of_any_form(tmp_path: Path) -> None:
    """On one line or more, with or without a derived volume."""
    file, new = tmp_path / "own.yaml", tmp_path / "edited.yaml"
    for text in (
        "{extends: site.yaml, c_hat: 54, x2_star: 3.14416}", "extends: site.yaml\nz_cap: 34.4"
    ):
        file.write_text(text)
        new.write_text(format_fitted_site(file, NEW, []))
        after = read_site(new)
        assert (after.x2_star, after.z_cap) == pytest.approx((68.8 * 0.04, 68.8 * 0.5 * 0.3))
        assert after == replace(
            read_site(file), **{name: value for name, (value, _) in NEW.items()},
            x2_star=after.x2_star, z_cap=after.z_cap,
        )


def test_an_invalid_site_is_not_written() -> None:
    steep = {"a_hat": (-4.1e22, "steep")}
    assert refusal(format_fitted_site, PAPER, steep, []).startswith(
        f"{PAPER}: the fitted values do not form a valid site, so no file was written: "
        "a_hat = -4.1e+22: must be a number of at least -1e+21 and less than 0 s2/m5"
    )


def test_a_record_without_any_runoff_has_nothing_to_fit(fitted: Path, tmp_path: Path) -> None:
    """A roof with a field-capacity soil in dry weeks: it is not refused as a dead sensor."""
    record = DATA / "neubrandenburg_dry.csv"
    ended = calibrate(
        tmp_path, str(record), "--site", str(fitted / "site.yaml"), "-o", "new.yaml"
    )
    assert ended.returncode == 2
    *_, line = ended.stderr.splitlines()
    assert line.startswith(f"error: {record}: in the first half of its rain, no measured quanti")
    assert list(tmp_path.iterdir()) == []


def test_the_page_says_what_was_found(fitted: Path) -> None:
    with drawn_page(fitted / "fitted.html") as page:
        assert page.inner_text("#answer").startswith("In the half that was not used for the fit, ")
        words = page.inner_text("main")
        assert "field_capacity" in words and page.locator("figure img").count() == 4
        read = page.locator("section:has-text('What was read') li").all_inner_texts()
        assert read[1].startswith("rain ") and read[3].startswith("missing: ")
        assert {note.split(":")[0] for note in read[4:]} >= {
            "balance", "compared", "target", "percolation_exponent"
        }
        assert "The crop_coefficient applies only if evapotranspiration is computed" in words
