"""The report's page in a real browser: what it shows, and that it requests nothing else."""

from __future__ import annotations

import re
import shutil
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsers import started_browser
from inputs import (
    ended_run,
    figures_of,
    report_of,
    seeded_rows,
    simulate,
    trajectory_of,
    write_study,
)
from places import CONFIG

import greenroof_ros as gr
from greenroof_ros.analysis.report.page import render

WEIGHTS = ("0.00001", "0.0001", "0.001", "0.01", "0.1")
FRACTIONS = ("0.2", "0.5", "1", "1.5", "2")
INITIALS = ("low-low", "high-low", "high-high")
SCENE = """
// Where the plotting area begins on the canvas.
window.corner = (view) => view.origin().map((at, i) => at + view.padding()[i ? "top" : "left"]);
// All marks of a view, each with where on the canvas its items have their origin.
window.scene = (id) => {
  const view = window.reportViews.get(id), marks = [];
  const walk = (mark, x, y) => {
    marks.push([mark, x, y]);
    if (mark.marktype !== "group") return;
    mark.items.forEach((item) => item.items.forEach(
      (inner) => walk(inner, x + (item.x ?? 0), y + (item.y ?? 0))));
  };
  walk(view.scenegraph().root, ...corner(view));
  return marks;
};
// Those that belong to the data, by name.
window.marks = (id, type) => scene(id).map(([mark]) => mark).filter(
  (mark) => mark.marktype === type && (mark.name ?? "").includes("marks") && mark.items.length);
window.legendEntry = (id, text) => scene(id).filter(([mark]) => mark.role === "legend-label")
  .flatMap(([mark, x, y]) => mark.items.filter((item) => item.text === text)
    .map((item) => [x + (item.x ?? 0) + 3, y + (item.y ?? 0)])).at(-1);
// By how much legends stick out of their canvases, or these out of the window (px).
window.clipped = () => [...window.reportViews].flatMap(([id, view]) => {
  const canvas = document.querySelector(`#${id} canvas`).getBoundingClientRect();
  const [left, top] = corner(view);
  const out = scene(id).filter(([mark]) => mark.role === "legend").map(([mark]) => Math.max(
    left + mark.items[0].bounds.x2 - canvas.width, top + mark.items[0].bounds.y2 - canvas.height));
  return [...out, canvas.right - document.documentElement.clientWidth];
});
// How many lines the fullest cell of any table has.
window.mostLines = () => Math.max(...[...document.querySelectorAll("td, th")].map((cell) => {
  const range = document.createRange();
  range.selectNodeContents(cell);
  const height = range.getBoundingClientRect().height;
  return Math.round(height / parseFloat(getComputedStyle(cell).lineHeight));
}));
// Tables that are wider than the page, and what they are called.
window.wide = () => [...document.querySelectorAll(".scroll")]
  .filter((box) => box.scrollWidth > box.clientWidth + 1).map((box) => box.ariaLabel);
// Entries of legends without a mark that a reader can see: as large as a pixel, in their colour.
window.unmarked = () => [...window.reportViews.keys()].flatMap((id) => {
  const seen = new Set(scene(id)
    .filter(([mark]) => (mark.name ?? "").includes("marks"))
    .flatMap(([mark]) => mark.items)
    .filter(({ bounds }) => Math.max(bounds?.x2 - bounds?.x1, bounds?.y2 - bounds?.y1) >= 1)
    .flatMap((item) => Object.values(item.datum ?? {}).map(String)));
  return scene(id).filter(([mark]) => mark.role === "legend-label")
    .flatMap(([mark]) => mark.items.map((item) => item.text))
    .filter((text) => !seen.has(text)).map((text) => [id, text]);
});
// Labels of an axis that have less than 4 px between them, and so read as one.
window.crowded = () => [...window.reportViews.keys()].flatMap((id) => {
  const apart = (p, q) => Math.max(Math.max(p.x1, q.x1) - Math.min(p.x2, q.x2),
                                   Math.max(p.y1, q.y1) - Math.min(p.y2, q.y2));
  return scene(id).filter(([mark]) => mark.role === "axis-label").flatMap(([mark]) => {
    const shown = mark.items.filter((label) => label.opacity !== 0 && label.text !== "");
    return shown.flatMap((label, place) => shown.slice(place + 1)
      .filter((other) => apart(label.bounds, other.bounds) < 4)
      .map((other) => [id, label.text, other.text]));
  });
});
"""


def noisy_study(directory: Path, initials: int, settings: int) -> Path:
    """Write the page on a study of 12 h of noise, which needs the most space."""
    random, times = np.random.default_rng(1), np.arange(0.0, 43201.0, 40.0)
    row = {**simulate("onoff", "0.5", "low-low", "0.01").row, "hours": "12", "bound_m3": 30_000.0}
    controllers = ("mpc", "weight", WEIGHTS[:settings]), ("onoff", "fraction", FRACTIONS[:settings])

    def noise() -> np.ndarray[Any, Any]:
        return random.random(len(times))

    write_study(directory / "study", [
        (
            {**row, "initial": initial, "controller": controller, "parameter:fraction": "",
             f"parameter:{key}": value, "total_deviation_m3": 30_000.0 * (1 + random.random())},
            trajectory_of(
                times, cistern=50 + noise(), roof=3 + noise(), command=noise(),
                precipitation=1e-6 * noise(), evapotranspiration=1e-6 * noise(),
            ),
        )
        for initial in INITIALS[:initials] for controller, key, values in controllers
        for value in values
    ])
    return reported(directory, "study")


def reported(directory: Path, *paths: str) -> Path:
    """Write the page on a study, or on runs, without the separate figure files."""
    report = report_of(*(directory / path for path in paths))
    file = directory / "report.html"
    file.write_text(render(report, list(figures_of(report).values())))
    return file


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless browser."""
    with started_browser() as started:
        yield started


@contextmanager
def opened(browser: Any, file: Path, width: int, *, unfold: bool = True) -> Iterator[Any]:
    """Open the page, unfold everything, and wait until all is drawn.

    The console must stay empty, and no other file or server may be requested.
    """
    page = browser.new_page(viewport={"width": width, "height": 900})
    page.set_default_timeout(120_000)
    reason: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: reason.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: reason.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(file.as_uri())
    page.wait_for_function("document.documentElement.dataset.drawn")
    page.evaluate(f"() => {{ {SCENE} }}")
    if unfold:
        unfold_all(page)
    yield page
    assert reason == []
    assert asked == [file.as_uri()]
    page.close()


def unfold_all(page: Any) -> None:
    """Open everything that is folded, and wait until it is drawn."""
    page.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true })")
    page.wait_for_function("Math.max(...clipped()) <= 1", timeout=20_000)
    settle(page)


@pytest.fixture(scope="module")
def folded_page(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A page of the paper's size, opened once; it stays folded until ``page`` unfolds it."""
    file = noisy_study(tmp_path_factory.mktemp("page"), 3, 5)
    assert file.stat().st_size < 5_000_000
    with opened(browser, file, 1400, unfold=False) as page:
        yield page


@pytest.fixture(scope="module")
def page(folded_page: Any) -> Any:
    """The same page, unfolded."""
    unfold_all(folded_page)
    return folded_page


def folds(page: Any) -> None:
    """Check that details are folded, and drawn at their width when unfolded."""
    assert page.locator("header figure .panel canvas").last.bounding_box()["y"] < 900
    folded = page.locator("#water-balance-1")
    assert not folded.locator("canvas").first.is_visible()
    folded.locator("summary").click()
    width = "document.querySelector('#water-balance-1 {}').getBoundingClientRect().width"
    page.wait_for_function(f"Math.abs({width.format('canvas')} - {width.format('.panel')}) <= 3")
    assert folded.locator("canvas").first.is_visible()


def readable(page: Any) -> None:
    """Check that nothing is too wide: at 1400 px, and after narrowing the window to 500 px.

    At 1400 px no table scrolls sideways. A legend names only what is drawn.
    """
    assert page.evaluate("wide()") == []
    assert page.evaluate("mostLines()") <= 6
    assert page.evaluate("unmarked()") == []
    for width in (1400, 500):
        page.set_viewport_size({"width": width, "height": 900})
        page.wait_for_function("Math.max(...clipped()) <= 1")
        settle(page)
        assert page.evaluate("crowded()") == []
        assert page.evaluate("document.documentElement.scrollWidth") == width


def result_in_sight(page: Any) -> None:
    """Check that the first table shows a number at 500 px."""
    assert page.locator("table").first.evaluate(
        "(table) => Math.min(...[...table.tBodies[0].querySelectorAll('td:not(.text)')].map("
        "(cell) => cell.getBoundingClientRect().right))"
    ) <= 500 - 16


def test_a_studys_details_are_folded(folded_page: Any) -> None:
    """Before anything is unfolded, and so before all tests of ``page``."""
    assert folded_page.locator("h1").count() == 1
    folds(folded_page)


def test_every_figure_has_its_series(page: Any) -> None:
    """In every panel as many lines and marks as there are runs: one for each initial state."""
    panels = page.evaluate("[...window.reportViews.keys()]")
    assert len(panels) == page.locator(".panel canvas").count() == 2 + 4 * 3 + 3 * 8 + 3 * 2
    # Next to the runs' total deviations are the marks of the authors' code, and a line of the
    # minimum possible.
    for figure, kind, counts in (
        ("time-in-band-1", "symbol", (10, 10)), ("total-deviation-1", "symbol", (20, 20)),
        ("total-deviation-1", "rule", (1, 1)),
    ):
        drawn = tuple(
            page.evaluate(f"marks('{figure}-panel-{number}', '{kind}')"
                          ".reduce((sum, mark) => sum + mark.items.length, 0)")
            for number in (1, 2)
        )
        assert drawn == counts, figure
    lines = {panel: page.evaluate(f"marks('{panel}', 'line').length") for panel in panels}
    for panel, count in lines.items():
        if panel.startswith("trajectories"):
            assert count == 5, panel
    assert lines["weather-1-panel-2"] == 1


def test_table_sorts(page: Any) -> None:
    """By a click and by keyboard; numbers sort as numbers, and the heading shows the order."""
    table = page.locator("table.sortable").nth(1)

    def column(name: str) -> tuple[Any, list[str]]:
        header = table.locator("thead th", has_text=re.compile(f"^{name}"))
        place = header.evaluate("(element) => element.cellIndex") + 1
        return header, table.locator(f"tbody tr > :nth-child({place})").all_inner_texts()

    header, before = column("total deviation")
    ascending = sorted(before, key=float)
    header.locator("button").click()
    assert header.get_attribute("aria-sort") == "ascending"
    assert column("total deviation")[1] == ascending != before
    header.locator("button").press("Enter")
    assert header.get_attribute("aria-sort") == "descending"
    assert column("total deviation")[1] == ascending[::-1]
    column("controller")[0].locator("button").click()
    assert header.get_attribute("aria-sort") is None
    assert list(dict.fromkeys(column("controller")[1])) == [
        *(f"MPC weight {weight}" for weight in WEIGHTS),
        *(f"on/off fraction {part}" for part in FRACTIONS),
    ]


def settle(page: Any) -> None:
    """Wait until every figure has handled the last change."""
    page.wait_for_timeout(300)
    page.evaluate(
        "Promise.all([...window.reportViews.values()].map((view) => view.runAsync())).then(() => 0)"
    )


def click_legend(page: Any, panel: str, text: str) -> None:
    """Click an entry of a panel's legend."""
    canvas = page.locator(f"#{panel} canvas")
    canvas.scroll_into_view_if_needed()
    x, y = page.evaluate(f"legendEntry('{panel}', '{text}')")
    canvas.click(position={"x": x, "y": y})
    settle(page)


def test_legend_switches_a_run_off_and_on(page: Any) -> None:
    """In the panel that was clicked, and in panels of the same runs; not in the others."""
    first, same, other = (f"trajectories-1-1-panel-{number}" for number in (1, 3, 2))

    def lines(panel: str) -> set[str]:
        return set(page.evaluate(
            f"marks('{panel}', 'line').map((mark) => mark.items[0].datum.setting)"
        ))

    assert lines(first) == set(WEIGHTS)
    for panel, switched, off in (
        (first, "0.01", {"0.01"}), (same, "0.1", {"0.01", "0.1"}), (first, "0.01", {"0.1"}),
        (first, "0.1", set()),
    ):
        click_legend(page, panel, switched)
        assert lines(first) == lines(same) == set(WEIGHTS) - off
        assert lines(other) == set(FRACTIONS)


def test_wheel_scrolls_and_zooms_with_shift(page: Any) -> None:
    """A figure under the pointer does not stop the page from scrolling."""
    panel, start = "trajectories-1-2-panel-1", 1_625_623_200_000  # 2021-07-07T02:00Z
    canvas = page.locator(f"#{panel} canvas")
    canvas.scroll_into_view_if_needed()

    def domain() -> list[float]:
        settle(page)
        times = page.evaluate(
            f"window.reportViews.get('{panel}').scale('x').domain().map(Number)"
        )
        return [(time - start) / 3.6e6 for time in times]

    canvas.hover(position={"x": 250, "y": 100})
    place = page.evaluate("window.scrollY")
    page.mouse.wheel(0, 120)
    page.wait_for_function(f"window.scrollY > {place}")
    assert domain() == [0, 12]
    canvas.hover(position={"x": 250, "y": 100})
    place = page.evaluate("window.scrollY")
    page.keyboard.down("Shift")
    page.mouse.wheel(0, -240)
    page.keyboard.up("Shift")
    low, high = domain()
    assert 0 < low < high < 12 and page.evaluate("window.scrollY") == place
    canvas.dblclick(position={"x": 250, "y": 100})
    assert domain() == [0, 12]


def test_hover_shows_values(page: Any) -> None:
    """With the pointer on a mark, the run and its value are shown."""
    panel = "energy-1-panel-1"
    canvas = page.locator(f"#{panel} canvas")
    canvas.scroll_into_view_if_needed()
    x, y = page.evaluate(
        f"(() => {{ const [x, y] = corner(window.reportViews.get('{panel}')),"
        f" mark = marks('{panel}', 'symbol')[0].items[0]; return [mark.x + x, mark.y + y]; }})()"
    )
    canvas.hover(position={"x": x, "y": y})
    page.wait_for_selector("#vg-tooltip-element.visible")
    text = page.locator("#vg-tooltip-element").inner_text()
    assert "weight" in text and "electric energy (Wh)" in text


def test_widths(browser: Any, tmp_path: Path) -> None:
    """One or two columns of figures; a wide table scrolls, and its first column stays in sight.

    On paper figures are vectors; on the screen they are canvases again afterwards.
    """
    with opened(browser, noisy_study(tmp_path, 1, 2), 500) as page:
        box = page.locator(".scroll").nth(1)
        box.evaluate("(element) => { element.scrollLeft = 100 }")
        left = "(element) => element.getBoundingClientRect().left"
        first = box.locator("tbody th").first
        assert box.evaluate("(element) => element.scrollLeft") == 100
        assert first.evaluate(left) == pytest.approx(box.evaluate(left), abs=2)
        lefts = "[...document.querySelectorAll('#water-balance-1 .panel')].map((p) => p.offsetLeft)"
        assert len(set(page.evaluate(lefts))) == 1
        page.set_viewport_size({"width": 1280, "height": 900})
        page.wait_for_function(f"new Set({lefts}).size === 2")
        panel = "document.querySelector('#water-balance-1-panel-1 {}')"
        width = f"{panel}.getBoundingClientRect().width"
        page.wait_for_function(
            f"Math.abs({width.format('canvas')} - {width.replace(' {}', '')}) <= 3"
        )
        panels = page.locator(".panel canvas").count()
        for event, kind in (("beforeprint", "svg"), ("afterprint", "canvas")):
            page.evaluate(f"window.dispatchEvent(new Event('{event}'))")
            assert page.locator(f".panel {kind}").count() == panels


def test_many_seeds(browser: Any, tmp_path: Path) -> None:
    """A panel for each window and initial state: mean and worst tenth; the legend switches both."""
    row = simulate("onoff", "0.5", "low-low", "0.01").row
    write_study(tmp_path / "study", [(seeded, None) for seeded in seeded_rows(row)])
    with opened(browser, reported(tmp_path, "study"), 1400) as page:
        def points(panel: int, kind: str) -> int:
            return page.evaluate(f"marks('forecast-errors-panel-{panel}', '{kind}')"
                                 ".reduce((sum, mark) => sum + mark.items.length, 0)")

        # 3 settings, 2 skills, mean and worst tenth.
        assert [points(panel, "symbol") for panel in (1, 2, 3, 4)] == [12] * 4
        assert (points(1, "line"), points(1, "rule")) == (12, 1)
        click_legend(page, "forecast-errors-panel-1", "on/off fraction 2")
        assert points(1, "symbol") == points(2, "line") == 8
        click_legend(page, "forecast-errors-panel-1", "on/off fraction 2")
        readable(page)
        result_in_sight(page)


def test_seasons(browser: Any, tmp_path: Path) -> None:
    """Many controllers and forecasts on two roofs; one controller is far worse than the others.

    On/off, with which all are compared, has no mark in that figure, and no name.
    """
    row = {
        **simulate("onoff", "0.5", "low-low", "0.01").row, "hours": 384.0, "parameter:fraction": "",
        "bound_m3": 50.0, "evapotranspiration": "fao56", "mains_m3": 1.0, "saved_m3": 2.0,
        "rain_kept_share_hour": 0.5, "rain_kept_share_day": 0.5, "forecast_members": 5,
    }
    random = np.random.default_rng(1)
    cases = [("onoff", "perfect", 1.0), *(
        (name, skill, worse) for name, worse in (("anticipating_onoff", 1.0), ("lookahead", 0.9),
                                                 ("mpc", 20.0))
        for skill in ("real", "none")
    )]
    write_study(tmp_path / "study", [
        ({
            **row, "site": site, "weather": f"{year}.csv", "start": f"{year}-05-01T00:00-05:00",
            "controller": name, "forecast": skill if skill == "perfect" else "ensemble",
            "forecast_skill": "" if skill == "perfect" else skill,
            "forecast_seed": "" if skill == "perfect" else 1,
            "total_deviation_m3": total, "weekly_deviation_m3": f"{total / 8} {total / 4} {total}",
        }, None)
        for site in ("site.yaml", "site_catchment.yaml") for name, skill, worse in cases
        for year in range(2015, 2022) for total in [worse * (100 + random.random())]
    ])
    shutil.copy(CONFIG / "site_catchment.yaml", tmp_path / "study" / "configuration")
    with opened(browser, reported(tmp_path, "study"), 1400) as page:
        readable(page)
        for panel in ("season-comparisons-panel-1", "seasons-panel-1"):
            names = page.evaluate(
                f"scene('{panel}').filter(([mark]) => mark.role === 'legend-label')"
                ".flatMap(([mark]) => mark.items.map((item) => item.text))"
            )
            assert ("on/off" in names) == panel.startswith("seasons"), panel
            # The others differ by more than a tenth of the panel, next to twenty times as much.
            axis = "xy"[panel.startswith("seasons")]
            places = page.evaluate(f"marks('{panel}', 'symbol').flatMap((mark) => "
                                   f"mark.items.map((item) => item.{axis}))")
            length = page.evaluate(
                f"window.reportViews.get('{panel}').scale('{axis}').range()"
            )
            lookahead, anticipating, mpc = (
                page.evaluate(f"window.reportViews.get('{panel}').scale('{axis}')({value})")
                for value in ((0.9, 1.0, 20.0) if axis == "x" else (90, 100, 2000))
            )
            assert len(places) > 5
            near, far = abs(anticipating - lookahead), abs(mpc - lookahead)
            assert near > 0.02 * max(length) and far < 1.01 * max(length)


def test_runs(browser: Any, tmp_path: Path) -> None:
    """A single run; next to it a run with a changed setting, and a failed one."""
    change = {"tick": 300, "parameter": "weight", "before": 0.001, "value": 0.01}
    names = ("2026-11-21T02-25-10-mpc", "2026-11-21T02-25-10-changed", "broken")
    ended_run(tmp_path / names[0])
    ended_run(tmp_path / names[1], parameter_changes=[change])
    ended_run(tmp_path / names[2], "failed", last_tick=72, reason="node weather ended (SIGKILL)")
    with opened(browser, reported(tmp_path, "broken"), 1400) as page:
        labels = page.evaluate(
            "scene('weather-1-panel-1').filter(([mark]) => mark.role === 'axis-label')"
            ".flatMap(([mark]) => mark.items.map((label) => label.text))"
        )
        assert len(set(labels)) == len(labels), labels  # of 72 s
    with opened(browser, reported(tmp_path, names[0]), 1400, unfold=False) as page:
        folds(page)
        unfold_all(page)
        readable(page)
        result_in_sight(page)
    with opened(browser, reported(tmp_path, *names), 1400) as page:
        readable(page)


def test_simulations_overlaid(browser: Any, tmp_path: Path) -> None:
    """Five controllers in one panel for each quantity; page and files are at most 1400 px wide."""
    names = ("onoff", "mpc", "lookahead", "anticipating_onoff", "examples.rain_wait:RainWait")
    saved = [gr.simulate(name, hours=1).save(tmp_path / name[:9]) for name in names]
    with opened(browser, reported(tmp_path, *(path.name for path in saved)), 1400) as page:
        readable(page)
        for number in range(1, 5):
            lines = page.evaluate(f"marks('trajectories-1-1-panel-{number}', 'line').length")
            assert lines == 5
        assert page.locator("#trajectories-1-1 canvas").count() == 4
    for figure in figures_of(report_of(*saved)).values():
        figure.save(tmp_path)
        width, _ = struct.unpack(">II", (tmp_path / f"{figure.name}.png").read_bytes()[16:24])
        assert width <= 2 * 1400, figure.name  # two pixels to a px


def test_a_study_is_readable_at_any_width(page: Any) -> None:
    """Its page is the largest; it is opened once for all tests, and this test comes last."""
    readable(page)
    result_in_sight(page)
