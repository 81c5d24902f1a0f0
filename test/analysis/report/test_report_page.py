"""The report's page in a real browser: what it shows, and that it requests nothing else."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from browsers import started_browser
from inputs import ended_run, figures_of, report_of, simulate, write_study

from greenroof_ros.analysis.report.page import render

WEIGHTS = ("0.00001", "0.0001", "0.001", "0.01", "0.1")
FRACTIONS = ("0.2", "0.5", "1", "1.5", "2")
# What is wider than the window: canvases of figures, and the page itself (px).
WIDEST = """Math.max(document.documentElement.scrollWidth, ...[...document.querySelectorAll(
    'details[open] canvas')].map((canvas) => canvas.getBoundingClientRect().right))"""


def study_of_twenty(directory: Path) -> None:
    """Write a study of five settings of two controllers from two initial states."""
    examples = [
        simulate(controller, option, initial)
        for initial in ("low-low", "high-low")
        for controller, options in (("mpc", WEIGHTS), ("onoff", FRACTIONS)) for option in options
    ]
    write_study(directory, [
        ({**example.row, "total_deviation_m3": 30_000.0, "bound_m3": 30_000.0}, example.trajectory)
        for example in examples
    ])


def reported(directory: Path, *paths: Path) -> Path:
    """Write the page on a study, or on runs, without the separate figure files."""
    report = report_of(*paths)
    file = directory / "report.html"
    file.write_text(render(report, list(figures_of(report).values())))
    return file


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless browser."""
    with started_browser() as started:
        yield started


@contextmanager
def opened(browser: Any, file: Path, width: int) -> Iterator[Any]:
    """Open the page; the console must stay empty, and nothing else may be requested."""
    page = browser.new_page(viewport={"width": width, "height": 900})
    page.set_default_timeout(120_000)
    reason: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: reason.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: reason.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(file.as_uri())
    page.wait_for_function("document.documentElement.dataset.drawn")
    yield page
    assert reason == []
    assert asked == [file.as_uri()]
    page.close()


def unfold(page: Any, *names: str) -> None:
    """Open figures, and wait until they are drawn."""
    for name in names:
        page.evaluate(f"document.getElementById('{name}').open = true")
        page.wait_for_function(f"document.getElementById('{name}').dataset.drawn === 'done'")


def fits(page: Any, width: int) -> None:
    """Check that nothing is wider than a window of this width (px), also after it has changed."""
    page.set_viewport_size({"width": width, "height": 900})
    page.wait_for_function(f"{WIDEST} <= {width}")


@pytest.fixture(scope="module")
def page(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The page on a study of twenty runs."""
    directory = tmp_path_factory.mktemp("page")
    study_of_twenty(directory / "study")
    file = reported(directory, directory / "study")
    assert file.stat().st_size < 5_000_000
    with opened(browser, file, 1280) as page:
        yield page


def test_a_studys_figures_are_folded(page: Any) -> None:
    """The first is drawn, each other when it is unfolded, with all its panels."""
    assert page.locator("h1").count() == 1
    assert page.locator("#deviation-1 canvas").count() == 2
    water = page.locator("#water-1-mpc")
    assert water.locator("canvas").count() == 0
    water.locator("summary").click()
    page.wait_for_function("document.getElementById('water-1-mpc').dataset.drawn === 'done'")
    assert water.locator("canvas").count() == 3


def test_a_page_is_readable_at_any_width(page: Any) -> None:
    """Figures narrow with the window; the name of a row stays in sight while a table scrolls."""
    unfold(page, "water-1-mpc", "flows-2-onoff")
    for width in (1280, 400):
        fits(page, width)
    box = page.locator(".scroll").first
    box.evaluate("(element) => { element.scrollLeft = 100 }")
    left = "(element) => element.getBoundingClientRect().left"
    assert box.evaluate("(element) => element.scrollLeft") == 100
    first = box.locator("tbody th").first
    assert first.evaluate(left) == pytest.approx(box.evaluate(left), abs=2)


def test_hover_shows_values(page: Any) -> None:
    """With the pointer on a mark, the case and its value are shown."""
    canvas = page.locator("#deviation-1 canvas").first
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    for x, y in itertools.product(range(100, int(box["width"]), 7), range(15, 75, 6)):
        canvas.hover(position={"x": x, "y": y})
        if page.locator("#vg-tooltip-element.visible").count():
            break
    page.wait_for_selector("#vg-tooltip-element.visible")
    assert "case" in page.locator("#vg-tooltip-element").inner_text()


def test_a_failed_run(browser: Any, tmp_path: Path) -> None:
    """Its results have a row for each quantity; all its figures are drawn, dry as it is."""
    reason = "node weather ended (SIGKILL)"
    path = ended_run(tmp_path / "run", "failed", last_tick=72, reason=reason)
    with opened(browser, reported(tmp_path, path), 400) as page:
        unfold(page, "water-1", "flows-1")
        fits(page, 400)
        table = page.locator("table").first
        assert table.locator("tbody tr", has_text="total deviation (m³)").count() == 1
        assert page.locator(".warning", has_text="SIGKILL").count() == 1
