"""Sizing as a user does it: the command, its page in a browser, and wrong inputs."""

from __future__ import annotations

import csv
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from browsers import drawn_page
from commands import run_command
from places import CONFIG, DATA, Once

import greenroof_ros as gr
from greenroof_ros.analysis.sizing.designs import BY_DESIGN, Design, build
from greenroof_ros.analysis.sizing.sizes import Sizes, describe_outlets
from greenroof_ros.analysis.tables import tabulate_peaks
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.site.file import read_site

VALVE = CONFIG / "site_valve.yaml"
JULIES = [DATA / f"en_climate_hourly_07-{year}.csv" for year in (2021, 2022)]
WEEK = ["--season", "07-02/07-09", "--gaps", "fill"]
OPTIONS: dict[str, Any] = {
    "site": VALVE, "weather": JULIES, "season": "07-02/07-09", "gaps": "fill",
    "volumes": [2, 5, 10], "targets": [30, 39],
}


def size(directory: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run the command on the two Julies until it ends."""
    return run_command(
        "size", "--site", str(VALVE), "--weather", *map(str, JULIES), *options,
        cwd=directory, env=dict(os.environ),
    )


@pytest.fixture(scope="module")
def sized(once: Once) -> Path:
    """The directory of a run: two targets, three cisterns and outlets, two weeks."""

    def fill(directory: Path) -> None:
        result = size(
            directory, *WEEK, "--volumes", "2", "5", "10", "--targets", "30", "39", "--output",
            "out",
        )
        assert result.returncode == 0, result.stderr
        (directory / "printed").write_text(result.stdout)

    return once("sized", fill)


@pytest.fixture(scope="module")
def sizes() -> Sizes:
    """The same from Python, in this process."""
    return gr.size(**OPTIONS)


def rows_of(directory: Path) -> list[dict[str, str]]:
    """Return the rows of the table, without its comments."""
    lines = (directory / "out" / "sizes.csv").read_text().splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def test_the_sentence_comes_first(sized: Path) -> None:
    """Its numbers are those of the table: means, lowest and highest of the two seasons."""
    printed = " ".join((sized / "printed").read_text().split())
    match = re.match(
        r"A cistern of (\S+) m³ \(valve with plan\) and a target of (\S+) mm .*?, "
        r"(\S+) \((\S+) to (\S+)\) m³ reaches the sewer, a retention of ", printed,
    )
    assert match is not None, printed[:500]
    cistern, target, *shown = map(float, match.groups())
    own = [
        float(row["discharge_m3"]) for row in rows_of(sized)
        if row["outlet"] == "plan"
        and (float(row["volume_m3"]), float(row["target_mm"])) == (cistern, target)
    ]
    assert shown == pytest.approx([sum(own) / 2, min(own), max(own)], rel=5e-3)


def test_the_table_has_each_design_and_season(sized: Path) -> None:
    """Nothing that was varied is averaged over; shares follow from the volumes."""
    rows = rows_of(sized)
    assert len({
        (row["volume_m3"], row["target_mm"], row["outlet"], row["season"]) for row in rows
    }) == len(rows) == (1 + 3 * 3) * 2
    for row in rows:
        value = {name: float(text) for name, text in row.items() if name not in ("outlet", "season")
                 and text}
        assert value["storm_water_kept_share"] == pytest.approx(
            1 - value["wet_discharge_m3"] / value["rain_m3"]
        )
        assert value["evapotranspiration_lost_share"] == pytest.approx(
            1 - value["evapotranspiration_ratio"]
        )


def test_python_gives_the_same(sized: Path, sizes: Sizes) -> None:
    """In one thread as in several."""
    rows = rows_of(sized)
    for row, other in zip(rows, sizes.table_of_seasons.to_dicts(), strict=True):
        for name, value in other.items():
            if isinstance(value, float):
                assert float(row[name] or "nan") == pytest.approx(value, nan_ok=True), name


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("outlet", ["none", "drain"])
def test_a_design_alone_gives_the_same(sizes: Sizes, outlet: str) -> None:
    """The paper's plant, tick by tick and one at a time, with the same site and weather."""
    design = Design(5.0, sizes.recommended.target_mm, outlet)
    site, parameters = build(read_site(VALVE), design)
    for number, year in enumerate(sizes.seasons):
        alone = gr.simulate(
            "onoff", site=site, weather=JULIES, start=f"{year}-07-02", hours=192,
            gaps="fill", initial=(2.5, site.x2_star), **parameters,
        ).metrics
        for name in ("pumped_m3", "mains_m3", "wet_discharge_m3", "overflow_days", "stress_hours"):
            found = sizes.table_of_seasons.filter(**design._asdict())[name][number]
            assert found == pytest.approx(alone[name], abs=1e-6), name


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_an_assumption_alone_gives_the_same(sizes: Sizes) -> None:
    """The recommended design of a site whose file has the other value."""
    names = {"runoff coefficient of": "runoff_coefficient", "coefficient of the solar": "k_Rs"}
    for (text, value), rows in sizes.tested.group_by("assumption", "value"):
        for name in (name for start, name in names.items() if text.startswith(start)):
            changed = read_site(VALVE, {name: float(value)})
            other = gr.size(**OPTIONS | {"site": changed}).table_of_seasons
            expected = other.filter(**sizes.recommended._asdict()).drop(BY_DESIGN)
            assert rows.select(expected.columns).equals(expected)


def test_other_initial_states_bracket_the_half_full_one(sizes: Sizes) -> None:
    """More water at the start is less from the mains and more in the sewer, nearly always."""
    label = "share of the cistern filled at the start; used: 0.5"
    used = sizes.tested.filter(assumption="as used")
    empty, full = (sizes.tested.filter(assumption=label, value=value) for value in "01")
    mains, wet = (
        [each[name].mean() for each in (empty, used, full)]
        for name in ("mains_m3", "wet_discharge_m3")
    )
    assert mains[0] >= mains[1] >= mains[2]
    assert wet[0] - 0.01 <= wet[1] <= wet[2] + 0.01


def test_the_page_in_a_browser(sized: Path, tmp_path: Path) -> None:
    """It has what a council asks for, fits a phone, and prints on A4."""
    with drawn_page(sized / "out" / "sizes.html") as page:
        assert page.inner_text("#answer").startswith("A cistern of ")
        assert page.locator("tr.marked").count() == 7  # one of each table
        for width in (400, 1280):
            page.set_viewport_size({"width": width, "height": 900})
            page.wait_for_function(f"document.documentElement.scrollWidth <= {width}")
        document = page.pdf(path=tmp_path / "sizes.pdf", prefer_css_page_size=True)
        assert 2 <= document.count(b"/Type /Page\n") <= 6


def test_compared_with_no_green_roof(sizes: Sizes) -> None:
    """Without a cistern, all that falls on other roofs and drains from the green roof runs off."""
    rows = {row["case"]: row for row in sizes.references.filter(season="2021").to_dicts()}
    roof, none = rows["green roof without irrigation"], rows["no green roof"]
    assert roof["pumped_m3"] == 0
    runs_off = roof["drainage_m3"] + roof["rain_cistern_m3"]
    assert roof["discharge_m3"] == pytest.approx(runs_off, abs=0.02)
    assert none["discharge_m3"] == none["rain_m3"] == roof["rain_m3"]
    # The wettest hour of the record, 15.4 mm, on 68.8 m2 and 0.9 of 300 m2.
    assert none["peak_discharge_60min_l_s"] == pytest.approx(15.4 / 3600 * (68.8 + 270))


def test_return_periods() -> None:
    """Weibull's plotting position, as in every textbook: the five highest of nine years."""
    table = tabulate_peaks("", {"one": [3.0, 9.0, 1.0, 2.0, 8.0, 7.0, 4.0, 6.0, 5.0]})
    assert table.rows == [
        ["10", "9"], ["5", "8"], ["3.33", "7"], ["2.5", "6"], ["2", "5"],
    ]


def test_another_climate() -> None:
    """A fifth more rain: the reference without a green roof grows by it; read is said."""
    wetter = gr.size(**{**OPTIONS, "rain_factor": 1.2, "volumes": [5], "targets": [39]})
    plain = gr.size(**{**OPTIONS, "volumes": [5], "targets": [39]})
    fallen = [each.references["rain_m3"].sum() for each in (wetter, plain)]
    assert fallen[0] == pytest.approx(1.2 * fallen[1])
    assert any("rain times 1.2" in note for note in wetter.read)
    assumed = "rain of another climate, relative to the record; used: 1"
    assert assumed in {*plain.tested["assumption"]}


def test_chart_and_page_of_python(sizes: Sizes, tmp_path: Path) -> None:
    """The chart has its data with it, and the page needs no command."""
    sizes.plot().save(tmp_path / "chart.svg")
    assert "mains water used" in (tmp_path / "chart.svg").read_text()
    assert sizes.sentence in sizes.save(tmp_path / "out").read_text()


def test_outlets_at_the_sites_own_volume(sizes: Sizes) -> None:
    """One row each, with the results of the designs; a plan that never acts is explained.

    The need of 20 days at 39 mm on 68.8 m2, some 5 m3 at 4 mm a day, fits no cistern of 2 m3.
    """
    (table, *_), _ = describe_outlets(sizes)
    assert "cistern 10 m³" in table.caption  # the site's own
    target = sizes.recommended.target_mm
    for outlet, mains, *_ in table.texts():
        designed = sizes.table.filter(volume_m3=10, target_mm=target, outlet=outlet)
        assert mains.startswith(f"{designed['mains_m3'][0]:.3g}")
    assert [outlet for outlet, *_ in table.texts()] == ["drain", "none", "plan"]
    small = gr.size(**{**OPTIONS, "volumes": [2], "targets": [39], "season": "07-07/07-08"})
    _, (remark,) = describe_outlets(small)
    assert remark.startswith("With 2 m³, plan equals none: without a forecast")


def test_one_season_is_too_few(tmp_path: Path) -> None:
    """The page says so first, and has neither brackets nor return periods."""
    one = gr.size(**{**OPTIONS, "weather": JULIES[:1], "outlets": ["none"]})
    assert one.sentence.startswith("One season is too few for a recommendation")
    text = one.save(tmp_path / "out").read_text()
    assert "in brackets" not in text and "eturn period" not in text


def test_a_season_without_rain_or_irrigation() -> None:
    """Shares of nothing are none; what was in the cistern at the start meets no demand."""
    dry = gr.size(**{**OPTIONS, "season": "07-03/07-03", "outlets": ["none"], "volumes": [2, 5]})
    assert dry.table["storm_water_kept_share"].is_null().all()
    assert "which is none % less" not in dry.sentence and "nan" not in dry.sentence


@pytest.mark.parametrize(("changes", "message"), [
    ({"volumes": [0]}, "volumes = 0: must be a number from 0.05 to"),
    ({"targets": [90]}, "targets = 90.0: must be above 2.16 mm.*below 68.04 mm"),
    ({"season": "05-01/10-31"}, "does not cover a complete season, 1 May to 31 October"),
], ids=str)
def test_wrong_inputs(changes: dict[str, Any], message: str) -> None:
    """Each is refused before anything is simulated, by its name."""
    with pytest.raises(ConfigurationError, match=message):
        gr.size(**{**OPTIONS, **changes})


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    """Exit code 2, one line, no traceback."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("")
    result = size(tmp_path, *WEEK, "--output", "mine")
    assert result.returncode == 2
    assert "exists and is not empty: it contains letter.txt" in result.stderr


def test_a_directory_of_weather_files_and_its_gaps(tmp_path: Path) -> None:
    """The same sizes as from the files in it; hours after a season are not needed."""
    for file in JULIES:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    options = OPTIONS | {"volumes": [5], "targets": [26], "outlets": ["plan"]}
    found, expected = (
        gr.size(**options | {"weather": weather}) for weather in ([tmp_path], JULIES)
    )
    assert found.table_of_seasons.equals(expected.table_of_seasons)
    # The next record, of 2022, has no temperature in some hours; after July 2021 nothing is known.
    refusing = gr.size(**options | {"gaps": "refuse", "season": "07-02/07-30"})
    assert refusing.seasons == ["2021"]
    assert any("season 2022 is left out" in note and "is missing at" in note
               for note in refusing.read)
