"""The page in a real browser, at the real server: what it shows, and what can be done there."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from browsers import started_browser
from graphs import wait_for
from page_inputs import (
    HELD,
    HOLD,
    SECOND,
    START,
    add_forecast,
    add_plan,
    add_values,
    alarm,
    fail,
    pump,
    served,
    store,
)
from places import CONFIG

from greenroof_ros.interface.alarm import WARN
from greenroof_ros.ros.reports import Status
from greenroof_ros.site.file import read_site
from greenroof_ros.watch.document import make_document, make_series
from greenroof_ros.watch.store import GraphStore

BEGIN = START // SECOND
CONTACT = "Call 555-0199; the main switch is beside the cellar door."
SITE = replace(read_site(CONFIG / "site.yaml"), contact=CONTACT)
HOSTILE = "<img src=x onerror=hacked=1><script>hacked=2</script>\x00\x1b[31m\u202e" + "A" * 5000
LONG_MS = 60_000  # the machine may be busy

Open = Callable[..., Any]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless browser; a stop request reports at once that no graph was joined."""
    with started_browser() as started:
        yield started


def say(watched: GraphStore, *statuses: Status) -> None:
    """Have nodes report, with alarms, and fall silent only long after the test."""
    late = time.monotonic() + 1e6
    watched.add_alarms(late, [status for status in statuses if "since" in status.values])
    watched.add_statuses(late, 0, [each for each in statuses if "process" in each.values])
    watched.offered = {each.name: 1 for each in statuses if each.name == "/pump"}


def site_watched(mode: str = "ended") -> GraphStore:
    """Return a store of a site after four hours, with a forecast and a plan.

    With an ended run nothing becomes stale during a test.
    """
    watched = store(mode, SITE, steady=time.monotonic())
    watched.site_note, watched.system = "A note.", BEGIN + 4 * 3600
    add_values(watched, 0, 4 * 3600, {
        "/roof/level": 0.045, "/cistern/level": 1.4, "/pump/command": 0.4, "/pump/flow": 2e-4,
        "/weather/precipitation": 1e-6,
    }, every=10)
    add_plan(watched, 4 * 3600 - 10, (7200.0, 0.0, 0.046), (43_200.0, 1e-4, 0.046))
    add_forecast(watched, 4 * 3600 - 10, np.full((3, 32), 1e-6))
    return watched


@pytest.fixture
def open_page(browser: Any) -> Iterator[Open]:
    """Open the page of a store, with statuses of nodes; its console is ``page.said``."""
    with ExitStack() as stack:
        def opened(
            watched: GraphStore, *said: Status, token: str | None = None, hash_: str = ""
        ) -> Any:
            say(watched, *said)
            port = stack.enter_context(served(watched, token))
            page = browser.new_page(viewport={"width": 1400, "height": 900})
            stack.callback(page.close)
            page.set_default_timeout(LONG_MS)
            page.said, page.asked = [], []
            page.on("console", lambda message: page.said.append(f"{message.type}: {message.text}"))
            page.on("pageerror", lambda error: page.said.append(str(error)))
            page.on("dialog", lambda dialog: page.said.append(f"dialog: {dialog.message}"))
            page.on("request", lambda request: page.asked.append((request.method, request.url)))
            page.goto(f"http://localhost:{port}/{hash_}")
            return page

        yield opened


def until_shown(page: Any, selector: str, text: str | re.Pattern[str] = "") -> Any:
    """Wait until an element is visible with some text, and return it."""
    element = page.locator(selector).filter(has_text=text).first
    element.wait_for()
    return element


def until_drawn(page: Any) -> None:
    page.wait_for_selector("html[data-drawn]", state="attached")


def posted(page: Any) -> list[str]:
    """Return the actions that the page requested."""
    return [url.rpartition("/")[2] for method, url in page.asked if method == "POST"]


def confirm(page: Any, action: str, question: str = "") -> None:
    """Request an action, and confirm its question."""
    page.locator(f"#{action}-button:enabled").click()
    until_shown(page, "#ask", question)
    page.locator("#yes").click()


# ---------------------------------------------------------------------------------- what it shows


def test_it_shows_the_words_of_the_state_and_two_charts(open_page: Open) -> None:
    """Word for word; no other server is contacted. The charts have the site's clock."""
    watched = site_watched()
    watched.site = replace(SITE, time_zone="America/Toronto", utc_offset=-5.0)
    page = open_page(watched)
    until_drawn(page)
    state = make_document(watched, time.monotonic())
    assert [
        [row.locator(part).text_content() for part in ("dt", ".value", ".sentence")]
        for row in page.locator("#values > div").all()
    ] == [
        [tile[part] for part in ("label", "value", "sentence")]
        for name, tile in state["tiles"].items() if name != "summary"
    ]
    for place, text in (
        ("#sentence", state["tiles"]["summary"]["sentence"]), ("#box", state["advice"]),
        ("#time", "2021-07-20 04:59:50 EDT"), ("#notes", "A note."), ("#contact", CONTACT),
    ):
        assert page.locator(place).text_content() == text
    assert len({url.split("/")[2] for _, url in page.asked}) == 1
    series = make_series(watched, 12)
    times, roof = page.evaluate("[plots[0].data[0], plots[0].data[1]]")
    drawn = [[at, level] for at, level in zip(times, roof, strict=True) if level is not None]
    assert drawn == [row for row in series["lines"]["roof"] if row[1] is not None]
    write = "(times) => plots[1].axes[0].values(plots[1], times)"
    assert page.evaluate(write, [BEGIN, BEGIN + 5400]) == ["01:00", "02:30"]
    assert page.said == []


def test_hostile_texts_are_texts_and_it_fits_every_width(open_page: Open) -> None:
    """Markup, control characters and megabytes: shown as text, no wider than a phone.

    There, the stop is visible without scrolling.
    """
    watched = site_watched("simulated")
    watched.site_note = HOSTILE
    alarms = (alarm(f"{HOSTILE}{i}", "x", HOSTILE, HOSTILE) for i in range(50))
    page = open_page(watched, *pump(f"fault: {HOSTILE}"), *alarms)
    for place in ("#alarms li > span", "[data-key=pump] .sentence", "#events li", "#notes li"):
        until_shown(page, place, "<script>")
    until_drawn(page)
    for width in (400, 1400):
        page.set_viewport_size({"width": width, "height": 800})
        wait_for(lambda: page.evaluate(
            "document.documentElement.scrollWidth == document.documentElement.clientWidth"
        ), 60, f"a page that fits {width} px")
        stop = page.locator("#stop-button").bounding_box()
        assert stop["height"] >= 44 and stop["y"] + stop["height"] <= 800  # a finger's size
    assert page.locator("img, body script").count() == 0
    assert page.evaluate("window.hacked") is None and page.said == []


# --------------------------------------------------------------------------- what can be done there


def test_stop_asks_once_and_no_answer_is_older_than_the_state(open_page: Open) -> None:
    """Here no pump node answers, and the page must report it; it also works by keyboard.

    An answer gives way to the state that comes after it.
    """
    watched = site_watched("live")
    page = open_page(watched, *pump("running: as commanded", at_rest=False))
    stop = until_shown(page, "#stop-button", "Stop the pump")
    stop.focus()
    stop.press("Enter")
    until_shown(page, "#ask", "someone releases it. Anyone working on the pump must lock it out")
    page.locator("#no").click()
    assert not page.locator("#ask").is_visible() and posted(page) == []
    confirm(page, "stop")
    until_shown(page, "#box.failed", "no request was sent")
    assert posted(page) == ["stop"]
    turns = alarm("/pump: pump", "pump", "stop_not_followed", "it is still turning", WARN)
    say(watched, turns, *pump("held: a hold", at_rest=False, hold=HOLD))
    until_shown(page, "#box:not(.failed)", "stop it at its drive's panel")
    say(watched, *pump("held: a hold", at_rest=True, hold=HOLD))
    until_shown(page, "#stop-button:enabled:not(.danger)", "The pump is already held off")


def test_with_its_token_it_releases_and_gives_a_dose_after_a_question(open_page: Open) -> None:
    """Not if the situation has changed since the question; the volume is the one named in it."""
    watched = site_watched("live")
    watched.allow_release = True
    held = pump(f"held: {HELD}", hold=HOLD)
    page = open_page(watched, *held, token="secret", hash_="#token=secret")
    page.locator("#release-button:enabled").click()
    say(watched, *pump(f"held: {HELD}", hold=HOLD, fault="a slow start", no_clear=""))
    until_shown(page, "#box.failed", "the situation has changed")
    confirm(page, "clear", "The fault is cleared: a slow start. The pump then starts")
    assert posted(page) == ["clear"]
    say(watched, *pump("off: the command is 0", max_dose=0.5, no_dose=""))
    page.locator("#litres").fill("250")
    with page.expect_request("**/dose") as sent:
        confirm(page, "dose", "Give a dose of 250 L?")
    assert sent.value.post_data_json == {"volume": 0.25, "asked_at": BEGIN + 4 * 3600}


@pytest.mark.parametrize("broken", ["make_series", "make_document"])
def test_a_fresh_page_has_its_stop_if_a_part_cannot_be_shown(
    open_page: Open, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    """Neither the charts nor even the state is needed for it."""
    monkeypatch.setattr(f"greenroof_ros.watch.server.{broken}", fail)
    page = open_page(site_watched("live"), *pump("running", at_rest=False))
    confirm(page, "stop")
    until_shown(page, "#box.failed", "The watcher is busy, so no request was sent")
