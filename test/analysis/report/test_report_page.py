"""The report's page in a real browser: what it shows, and that it requests nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
from browsers import started_browser
from inputs import ended_run, figures_of, report_of, simulate, write_study

from greenroof_ros.analysis.report.page import render

WIDEST = """Math.max(document.documentElement.scrollWidth, ...[...document.querySelectorAll(
    'img')].map((image) => image.getBoundingClientRect().right))"""


def test_pages_are_readable_at_any_width(tmp_path: Path) -> None:
    """Of a study and of a failed run; all pictures are there, and the name of a row stays in sight.

    Nothing else is requested.
    """
    write_study(tmp_path / "study", [
        (example.row, example.trajectory) for example in (
            simulate("onoff", option, initial)
            for initial in ("low-low", "high-low") for option in ("0.2", "0.5", "1")
        )
    ])
    reason = "node weather ended (SIGKILL)"
    run = ended_run(tmp_path / "run", "failed", last_tick=72, reason=reason)
    with started_browser() as browser:
        for path in (tmp_path / "study", run):
            report, file, asked = report_of(path), tmp_path / "report.html", list[str]()
            figures = list(figures_of(report).values())
            file.write_text(render(report, figures))
            assert file.stat().st_size < 500_000
            page = browser.new_page()
            page.on("request", lambda request, asked=asked: asked.append(request.url))
            page.goto(file.as_uri())
            page.evaluate("document.querySelectorAll('details').forEach((all) => all.open = true)")
            assert page.locator("h1").count() == 1 and page.locator("script").count() == 0
            assert page.locator("img").count() == sum(len(figure.panels) for figure in figures)
            assert page.evaluate("[...document.images].every((image) => image.naturalWidth > 100)")
            for width in (1280, 400):
                page.set_viewport_size({"width": width, "height": 900})
                page.wait_for_function(f"{WIDEST} <= {width}")
            box = page.locator(".scroll").last
            box.evaluate("(element) => { element.scrollLeft = 100 }")
            left = "(element) => element.getBoundingClientRect().left"
            first = box.locator("tbody th").first
            assert first.evaluate(left) == pytest.approx(box.evaluate(left), abs=2)
            assert {url.partition(":")[0] for url in asked} <= {"file", "data"}
            if path == run:
                assert page.locator("td", has_text="SIGKILL").first.is_visible()
            page.close()
