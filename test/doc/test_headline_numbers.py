"""The headline numbers of README and results agree with the files that they come from."""

from __future__ import annotations

import sys
from pathlib import Path

import polars
import pytest
from doc_commands.blocks import fences
from places import CHECKOUT
from real_seasons.inputs import ROOFS
from results.reduction import read

sys.path.append(str(CHECKOUT / "doc"))

from real_season_tables import OVER_NO_RAIN, TOGETHER, Number, numbers

README = " ".join((CHECKOUT / "README.md").read_text().split())
RESULTS = " ".join((CHECKOUT / "doc" / "results.md").read_text().split())


def test_readme_says_what_forecasts_and_target_are_worth() -> None:
    """The water that is pumped, and how much less than with on/off at the paper's target."""
    roofs = ("measured", "measured, target 39 mm")
    high, low = (f"{1000 * ROOFS[roof].target:g} mm" for roof in roofs)
    pumped = {
        run: numbers()[(*run, "pumped (m³)")].value
        for run in (
            (roofs[0], "on/off"), (roofs[0], TOGETHER), (roofs[0], "perfect"), (roofs[1], "on/off")
        )
    }
    first, *others = pumped.values()
    stress = [f"{numbers()[(*run, 'water stress (h)')].value:.0f} h" for run in pumped]
    issued, perfect, lower = (f"{m3:.1f} m³ ({100 * (1 - m3 / first):.0f} % less)" for m3 in others)
    for row in (
        f"| {high} | on/off | {first:.1f} m³ | {stress[0]} |",
        f"| {high} | `lookahead`, archived forecasts | {issued} | {stress[1]} |",
        f"| {high} | `lookahead`, perfect forecasts | {perfect} | {stress[2]} |",
        f"| {low} | on/off | {lower} | {stress[3]} |",
    ):
        assert row in README


def test_saved_water_is_priced() -> None:
    """The general rate of 2024 for up to 5,000 m³ a year, paid on time (City of Toronto)."""
    price = 4.5178  # CAD/m³
    onoff, forecasts, lower = (
        numbers()[(*run, "pumped (m³)")].value
        for run in (("measured", "on/off"), ("measured", TOGETHER),
                    ("measured, target 39 mm", "on/off"))
    )
    target, archived = (f"{price * (onoff - m3):.0f} CAD" for m3 in (lower, forecasts))
    assert f"it saved {target}, and archived forecasts saved {archived}" in README
    assert f"{price} CAD/m³" in RESULTS and target in RESULTS and archived in RESULTS


def test_readme_says_what_can_be_repeated() -> None:
    """Eleven seasons in Toronto, on the roof of the table; all runs of the paper."""
    (row,) = (
        row for row in read(CHECKOUT / "doc" / "results" / "seasons.csv")
        if row["site"].startswith("site_catchment")
        and (row["controller"], row["forecast_skill"]) == ("lookahead", "real")
    )
    assert int(row["years"]) == 11 and "eleven seasons in Toronto" in README
    assert f"deviated {100 * (1 - float(row['over_onoff'])):.0f} % less" in README


def test_papers_runs_are_reproduced_as_the_readme_says(papers: Path) -> None:
    """The total deviations of all runs, relative to the ones of the authors' code."""
    ours = read(papers / "results.csv")
    theirs = polars.read_csv(CHECKOUT / "config" / "paper" / "totals.csv").to_dicts()
    errors = []
    for row in theirs:
        name = {"mpc": "weight", "onoff": "fraction"}[row["controller"]]
        (total,) = (
            float(each["total_deviation_m3"]) for each in ours
            if (each["initial"], each["controller"]) == (row["initial"], row["controller"])
            and float(each[f"parameter:{name}"]) == row["parameter"]
        )
        errors.append(abs(total / row["total_deviation_m3"] - 1))
    assert f"Reproduces all {len(errors)} runs of Yeh and Chapman (2021) within" in README
    assert 3e-5 < max(errors) < 4e-5 and "within 0.004 %" in README


def test_readme_says_what_its_lines_print(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The volumes below the picture are the ones of the lines above it."""
    monkeypatch.chdir(tmp_path)
    (code,) = (text for _, language, text in fences("README.md") if language == "python")
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)
    onoff, lookahead = names["storm"].table["pumped_m3"]  # type: ignore[attr-defined]
    assert f"On/off control pumps {onoff:.2f} m³ before the storm" in README
    assert f"pumps {lookahead:.2f} m³ and leaves the rest" in README
    assert (tmp_path / "storm.svg").stat().st_size > 50_000


def test_results_say_what_forecasts_and_target_are_worth() -> None:
    """The sentences above the tables have the numbers of the tables."""
    roofs = ("measured", "measured, target 39 mm", "paper")
    measured, own, paper = (numbers()[roof, TOGETHER, OVER_NO_RAIN] for roof in roofs)
    assert f"{gain(measured).replace('(', 'less (')} than with a forecast of no rain" in RESULTS
    assert f"{gain(own)} less at its own target of 39 mm" in RESULTS
    assert f"{gain(paper)} less on the paper's roof" in RESULTS
    pumped, lower, perfect = (
        numbers()[roof, forecast, "pumped (m³)"].value
        for roof, forecast in ((roofs[0], "on/off"), (roofs[1], "on/off"), (roofs[0], "perfect"))
    )
    saved = f"{100 * (1 - lower / pumped):.0f} % less than at 45.7 mm: {pumped - lower:.1f} m³"
    assert f"At 39 mm on/off pumped {saved}" in RESULTS
    assert f"`lookahead` pumped {100 * (1 - perfect / pumped):.0f} % less than on/off" in RESULTS


def gain(ratio: Number) -> str:
    """Return how much less a ratio with its interval is than 1, such as ``3 % (-1 to 13 %)``."""
    value, low, high = (100 * (1 - number) for number in ratio)
    return f"{value:.0f} % ({high:.0f} to {low:.0f} %)"
