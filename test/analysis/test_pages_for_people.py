"""The pages for people: what they show, and where they are written."""

from __future__ import annotations

import math
from pathlib import Path

import altair as alt
import pytest
from places import refusal

from greenroof_ros.analysis.figures import Figure, Panel
from greenroof_ros.analysis.page import Section, claim_output, make_page, write_output
from greenroof_ros.analysis.tables import COLUMNS, Table, format_share, write_range
from greenroof_ros.results.metrics import METRICS


def test_a_page_shows_its_parts_without_scripts(tmp_path: Path) -> None:
    """Text is escaped; an output replaces an earlier one, and nothing else."""
    chart = alt.Chart(alt.NamedData("d")).mark_point().encode(x="x:Q", y="y:Q")
    figure = Figure("points", "Points", "", (Panel(chart, "one"),), 1, {"d": [{"x": 1, "y": 2}]})
    table = Table(
        "Designs", ["design", COLUMNS["mains_m3"]], [["<b>", 7.34], ["drain", math.nan]],
        frozenset({1}),
    )
    text = make_page("Title", "1 < 2.", [Section("Results", ["a & b", table, figure, ["item"]])])
    for part in (
        "1 &lt; 2.", "a &amp; b", "mains water used (m³)", "&lt;b&gt;", ">7.34<", ">none<",
        "data:image/svg+xml;base64,", "<li>item</li>",
    ):
        assert part in text
    assert "<script" not in text
    for _ in range(2):
        claim_output(tmp_path / "out", "page.html", ["a.csv"])
        page = write_output(tmp_path / "out", "page.html", text, [figure], {"a.csv": "x\n"})
    assert page.read_text(encoding="utf-8") == text
    assert {file.name for file in (tmp_path / "out" / "figures").iterdir()} == {
        "points.svg", "points.png",
    }
    (tmp_path / "out" / "mine.txt").write_text("mine")
    assert "mine.txt" in refusal(claim_output, tmp_path / "out", "page.html", ["a.csv"])


@pytest.mark.parametrize(("share", "text"), [
    (0.0, "0"), (-1e-9, "0"), (0.004, "0.4"), (0.27, "27"), (0.996, "99.6"),
    (0.9999, "over 99.9"), (1.0, "100"),
])
def test_only_all_is_100_per_cent(share: float, text: str) -> None:
    assert format_share(share) == text


def test_every_metric_has_a_column() -> None:
    assert set(COLUMNS) == {metric.name for metric in METRICS}
    row = {"mains_m3": 3.51, "mains_m3_min": 1.2, "mains_m3_max": 123.4}
    assert write_range(row, "mains_m3", COLUMNS["mains_m3"]) == "3.51 (1.2 to 123)"
    assert COLUMNS["wet_discharge_m3"].heading == "discharge in wet weather (m³)"
