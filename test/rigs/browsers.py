"""The system's Chromium, without a window."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

playwright = pytest.importorskip("playwright.sync_api", reason="the browser is driven by it")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))),
                None)


@contextmanager
def started_browser() -> Iterator[Any]:
    """Start Chromium; skip the test if it is not installed."""
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=CHROMIUM,
            args=["--no-sandbox", "--disable-background-networking",
                  "--disable-component-update", "--disable-sync"],
        )
        yield browser
        browser.close()


@contextmanager
def drawn_page(file: Path) -> Iterator[Any]:
    """Open a page, which must request nothing else."""
    with started_browser() as browser:
        page = browser.new_page(viewport={"width": 1200, "height": 900})
        urls: list[str] = []
        wrong: list[str] = []
        page.on("request", lambda request: urls.append(request.url))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto(file.as_uri())
        assert wrong == []
        assert [url for url in urls if not url.startswith(("file:", "data:", "blob:"))] == []
        yield page
