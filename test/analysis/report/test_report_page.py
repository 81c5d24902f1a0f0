"""The report's page in a real browser: what it shows, and that it requests nothing else."""

from __future__ import annotations

from pathlib import Path

from browsers import started_browser
from inputs import ended_run, figures_of, report_of, simulate, write_study

from greenroof_ros.analysis.report.page import render

WIDEST = """Math.max(document.documentElement.scrollWidth, ...[...document.querySelectorAll(
    'img')].map((image) => image.getBoundingClientRect().right))"""


def test_pages_are_readable_at_any_width(tmp_path: Path) -> None:
    """Of a study and of a failed run: all pictures are there, and nothing else is requested."""
    write_study(tmp_path / "study", [
        (example.row, example.trajectory) for example in (
            simulate("onoff", option, initial)
            for initial in ("low-low", "high-low") for option in ("0.2", "0.5", "1")
        )
    ])
    run = ended_run(tmp_path / "run", "failed", last_tick=72, reason="a node ended (SIGKILL)")
    file, asked = tmp_path / "report.html", list[str]()
    with started_browser() as browser:
        page = browser.new_page()
        page.on("request", lambda request: asked.append(request.url))
        for path in (tmp_path / "study", run):
            figures = list(figures_of(report_of(path)).values())
            file.write_text(render(report_of(path), figures))
            assert file.stat().st_size < 500_000
            page.goto(file.as_uri())
            assert page.locator("script").count() == 0
            assert page.locator("img").count() == sum(len(figure.panels) for figure in figures)
            assert page.evaluate("[...document.images].every((image) => image.naturalWidth > 100)")
            for width in (1280, 400):
                page.set_viewport_size({"width": width, "height": 900})
                page.wait_for_function(f"{WIDEST} <= {width}")
        assert page.locator("td", has_text="SIGKILL").first.is_visible()
        for scheme, back in (("dark", "rgb(20, 24, 26)"), ("light", "rgb(255, 255, 255)")):
            page.emulate_media(color_scheme=scheme)
            assert page.evaluate("getComputedStyle(document.body).backgroundColor") == back
    assert {url.partition(":")[0] for url in asked} <= {"file", "data"}
