"""The page in a real browser, at the real server: what it shows, and what can be done there."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import datetime, timezone
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pytest
from browsers import started_browser
from graphs import wait_for
from page_inputs import (
    ERROR,
    HELD,
    HOLD,
    SECOND,
    START,
    add_series,
    fail,
    node,
    pump_report,
    store,
)
from page_server import served
from peers import repeating
from places import CONFIG

from greenroof_ros.site.file import read_site
from greenroof_ros.site.horizon import growing_steps
from greenroof_ros.watch import feed
from greenroof_ros.watch.document import make_document as read_document
from greenroof_ros.watch.document import make_series as read_series
from greenroof_ros.watch.store import GraphStore
from greenroof_ros.watch.wire import WireStatus

BEGIN = START // SECOND
SITE = read_site(CONFIG / "site.yaml")
HOSTILE = "<img src=x onerror=hacked=1><script>hacked=2</script>\x00\x1b[31m\u202e" + "A" * 5000
LONG_MS = 60_000  # the machine may be busy
CANNOT = "cannot solve its program"

Open = Callable[..., Any]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless browser; a stop request soon reports that no one answers."""
    with pytest.MonkeyPatch.context() as patch, started_browser() as started:
        patch.setattr(feed, "_STOP_S", 0.5)
        yield started


def pump(state: str = "off: nothing is commanded", **values: Any) -> list[WireStatus]:
    return node("/pump", "pump", **pump_report(state), **{"stands": True, **values})


def mpc(level: int = ERROR, what: str = CANNOT) -> list[WireStatus]:
    return node("/mpc", "controller", ("program", level, what, "controller_failed"))


@contextmanager
def saying(watched: GraphStore, statuses: list[WireStatus]) -> Iterator[None]:
    """Have nodes report four times a second as real ones do; the list can be changed."""
    def say() -> None:
        watched.add_statuses(time.monotonic(), list(statuses))

    say()
    with repeating(say, 0.25):
        yield


def site_watched(mode: str = "ended") -> GraphStore:
    """Return a store of a site after four hours, with a forecast and a plan.

    With an ended run nothing becomes stale during a test.
    """
    watched = store(mode, SITE)
    watched.set_present(mode=mode, factor=30.0, note="A note.")
    seconds = np.arange(BEGIN, BEGIN + 4 * 3600, 10)
    phase = (seconds - BEGIN) / 3000
    for topic, values in {
        "/roof/level": 0.045 + 0.001 * np.sin(phase),
        "/cistern/level": 1.4 + 0.1 * np.cos(phase),
        "/pump/command": np.where(phase % 2 < 1, 0.0, 0.4),
        "/pump/flow": np.where(phase % 2 < 1, 0.0, 2e-4),
        "/weather/precipitation": np.where(phase % 3 < 1, 1e-6, 0.0),
        "/weather/evapotranspiration": np.full(len(seconds), 2e-6),
    }.items():
        add_series(watched, topic, seconds * SECOND, values)
    now_ns = int(seconds[-1]) * SECOND
    ends = np.arange(1, 13) * 3600.0
    watched.add_plan(now_ns, np.stack(
        (ends, np.where(ends < 7200, 0.0, 1e-4), np.full(12, 0.046), np.zeros(12)), axis=1
    ))
    front = np.array([seconds[-1], *growing_steps(1)[1:]])
    rain = np.outer(np.arange(3), np.full(len(front) - 1, 1e-6))
    watched.add_forecast(now_ns, rain, front)
    return watched


@contextmanager
def opened(browser: Any, port: int, hash_: str = "") -> Iterator[Any]:
    """Open the page; the browser's console messages are in ``page.said``."""
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.set_default_timeout(LONG_MS)
    page.said, page.asked = [], []
    page.on("console", lambda message: page.said.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: page.said.append(str(error)))
    page.on("dialog", lambda dialog: page.said.append(f"dialog: {dialog.message}"))
    page.on("request", lambda request: page.asked.append((request.method, request.url)))
    page.goto(f"http://localhost:{port}/{hash_}")
    try:
        yield page
    finally:
        page.close()


@pytest.fixture
def open_page(browser: Any) -> Iterator[Open]:
    """Open the page of a store, with statuses of nodes; its console must stay empty."""
    with ExitStack() as stack:
        pages = []

        def open_page(watched: GraphStore, said: list[WireStatus] | None = None) -> Any:
            if said is not None:
                stack.enter_context(saying(watched, said))
            port = stack.enter_context(served(watched))
            pages.append(stack.enter_context(opened(browser, port)))
            return pages[-1]

        yield open_page
        assert [page.said for page in pages] == [[] for _ in pages]


@pytest.fixture(scope="module")
def ended_run(browser: Any) -> Iterator[tuple[GraphStore, Any]]:
    """An ended run and its page, for tests that change neither."""
    watched = site_watched()
    with served(watched) as port, opened(browser, port) as page:
        until_drawn(page)
        yield watched, page
        assert page.said == []
        assert {url.split("/")[2] for _, url in page.asked} == {f"localhost:{port}"}


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


def overflow(page: Any) -> int:
    """Return by how much the page is wider than the window (px)."""
    return page.evaluate(
        "document.documentElement.scrollWidth - document.documentElement.clientWidth"
    )


def document_of(watched: GraphStore) -> dict[str, Any]:
    return read_document(watched, time.monotonic())


# ---------------------------------------------------------------------------------- what it shows


def test_it_shows_the_words_of_the_document(ended_run: tuple[GraphStore, Any]) -> None:
    """Word for word; the console stays empty, and no other server is contacted."""
    watched, page = ended_run
    document = document_of(watched)
    for key in ("roof", "cistern", "pump", "rain", "controller"):
        tile, shown = document["tiles"][key], page.locator(f".tile[data-key={key}]")
        assert shown.locator("h2 > span").first.text_content() == tile["label"]
        assert shown.locator(".value").text_content() == tile["value"]
        assert shown.locator(".sentence").text_content() == tile["sentence"]
        assert shown.locator(".why").text_content() == tile.get("why", "")
    for mark in document["tiles"]["cistern"]["marks"]:
        assert mark["label"] in page.locator(".tile[data-key=cistern] .gauge").inner_text()
    summary = page.locator("#summary").inner_text()
    assert document["tiles"]["summary"]["sentence"] in summary
    assert document["advice"] in summary
    assert page.locator("#heading").inner_text() == document["heading"]
    assert page.locator("#time").inner_text() == document["time"]["text"]
    assert page.locator("#notes li").all_inner_texts() == document["notes"]
    assert not page.locator("#stop").is_visible()  # no pump node is there


def test_it_reports_how_it_is_by_word_shape_and_colour(open_page: Open) -> None:
    said = mpc()
    page = open_page(site_watched(), said)
    looks = []
    for level, name, word in (
        (0, "ok", "No alarms."), (1, "warn", "1 warning."), (2, "error", "1 alarm."),
    ):
        said[:] = mpc(level, "because")
        page.wait_for_selector(f"#summary[data-level={name}]")
        until_shown(page, "#summary-word", word)
        looks.append((
            page.locator("#summary-shape").get_attribute("href"),
            page.locator("#summary").evaluate("(summary) => getComputedStyle(summary).borderColor"),
        ))
    assert len(set(looks)) == len({shape for shape, _ in looks}) == 3


def test_hostile_texts_are_texts(open_page: Open) -> None:
    """Markup, control characters and megabytes: shown as text, no wider than a phone."""
    watched = site_watched("simulated")
    watched.add_event(HOSTILE)
    watched.set_present(mode="simulated", factor=30.0, note=HOSTILE)
    page = open_page(watched, [
        *mpc(what=HOSTILE), *pump(f"fault: {HOSTILE}"),
        *(WireStatus(f"{HOSTILE}{i}", ERROR, HOSTILE) for i in range(50)),
    ])
    page.set_viewport_size({"width": 400, "height": 900})
    alarm = until_shown(page, ".alarm .what", "<script>hacked=2</script>")
    assert alarm.text_content() in [row["what"] for row in document_of(watched)["alarms"]]
    until_shown(page, ".tile[data-key=pump] .why", "<script>")
    until_shown(page, ".events li", "<script>")
    until_drawn(page)
    assert page.locator("img, body script").count() == 0
    assert page.evaluate("window.hacked") is None
    assert overflow(page) == 0


def test_it_fits_every_width(open_page: Open) -> None:
    """No list is cut at its end, no texts overlap, not even three references, or leave their tile.

    The target of 450 mm in 500 mm of soil is in the middle of its tile. Events scroll
    automatically, but not on a phone, which shows no scrollbar.
    """
    watched = site_watched("simulated")
    for number in range(60):
        watched.add_event(f"event {number}")
    long = "the drive at its gateway does not answer " * 12
    parts = [(f"part {i}", ERROR, long) for i in range(12)]
    page = open_page(watched, [*pump(), *node("/mpc", "controller", *parts)])
    watched.set_site(replace(
        SITE, low_outlet_level=1.0, low_outlet_radius=0.02, z_veg=0.45, x2_star=0.45 * SITE.a2
    ))
    until_drawn(page)
    until_shown(page, ".alarm")
    page.locator(".tile[data-key=cistern] .text").nth(2).wait_for()
    for width in (400, 800, 1400):
        page.set_viewport_size({"width": width, "height": 900})
        wait_for(lambda: overflow(page) == 0, 60, f"a page that fits {width} px")
        hidden = page.locator("#events").evaluate("(list) => list.scrollHeight - list.clientHeight")
        assert (hidden > 1) == (width > 400)
        values = page.locator(".tile .value")
        assert values.evaluate_all(
            "(values) => values.map((value) => value.scrollWidth - value.clientWidth)"
        ) == [0] * 5
        assert min(values.evaluate_all(
            "(all) => all.map((value) => parseFloat(getComputedStyle(value).fontSize))"
        )) >= 24
        assert page.locator("#stop-button").bounding_box()["height"] >= 44  # a finger's size
        assert page.evaluate(
            "[...document.querySelectorAll('main p, main ul, #heading')].filter((text) =>"
            " !text.closest('.unseen') && text.scrollHeight > text.clientHeight + 1)"
            ".map((text) => text.outerHTML)"
        ) == []
        lines = page.evaluate(  # in one evaluation: the page keeps changing
            "[...document.querySelectorAll('.alarm p')].map((line) => line.getBoundingClientRect())"
            ".filter((box) => box.height).map((box) => [box.top, box.bottom])"
        )
        assert len(lines) > 12
        assert all(line[1] <= below[0] + 1 for line, below in pairwise(lines))
        references = page.evaluate("""[...document.querySelectorAll(".gauge")].map((gauge) => {
            const words = [...gauge.querySelectorAll(".text")].map((text) => {
                const range = document.createRange();
                range.selectNodeContents(text);
                return range.getBoundingClientRect();
            });
            return { gauge: gauge.getBoundingClientRect(), words };
        })""")
        assert [len(tile["words"]) for tile in references] == [2, 3]
        for gauge, words in map(dict.values, references):
            assert all(
                gauge["left"] - 1 <= word["left"] and word["right"] <= gauge["right"] + 1
                for word in words
            )
            for word, other in combinations(words, 2):
                assert (
                    word["right"] <= other["left"] or other["right"] <= word["left"]
                    or word["bottom"] <= other["top"] + 1 or other["bottom"] <= word["top"] + 1
                )


# --------------------------------------------------------------------------------------- charts


def test_charts_have_one_time_axis_and_the_values(ended_run: tuple[GraphStore, Any]) -> None:
    watched, page = ended_run
    places = page.evaluate(
        "[...charts.views.values()].map(({ plot }) => [plot.bbox.left, plot.bbox.width])"
    )
    assert len(places) == 4
    assert np.ptp(np.array(places), axis=0).max() <= 1
    measured = [1000 * row[3] for row in read_series(watched, 12)["lines"]["roof"]]
    shown = page.evaluate("charts.rows.roof.map((row) => row.v)")
    assert shown[: len(measured)] == pytest.approx(measured)
    expected = page.evaluate("charts.rows.forecast[0].v")
    block = page.evaluate("charts.blocks.forecast[0]")
    assert [block["low"], expected, block["high"]] == pytest.approx([0.0, 3.6, 7.2])
    planned = page.evaluate("charts.rows.plan.map((row) => row.v)")
    assert min(planned) == 0 and max(planned) == pytest.approx(6.0)


# Of a rectangle of a chart's canvas (values on its axes): the maximum opacity of this colour.
OPACITY = """([key, from, to, high, low, ink]) => {
  const { plot } = charts.views.get(key);
  const [x0, x1] = [from, to].map((t) => Math.round(plot.valToPos(charts.ms(t), "x", true)));
  const [y0, y1] = [high, low].map((v) => Math.round(plot.valToPos(v, "left", true)));
  const [width, height] = [x1 - x0 + 1, y1 - y0];
  const copy = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  copy.drawImage(plot.ctx.canvas, -x0, -y0);
  const pixels = copy.getImageData(0, 0, width, height).data;
  return Math.max(...[...Array(width * height).keys()].map((i) => {
    const [opacity, ...shades] = [3, 0, 1, 2].map((c) => pixels[4 * i + c]);
    return ink.every((shade, c) => Math.abs(shades[c] - shade) < 40) ? opacity / 255 : 0;
  }));
}"""
BLACK, BLUE = [0, 0, 0], [0, 114, 178]
READ = '''([key, name, t]) => {
  const { chart } = charts.views.get(key);
  return charts.valueAt(chart, chart.lines.find((line) => line.name === name), charts.ms(t));
}'''


def test_lines_and_blocks_are_where_values_were(open_page: Open) -> None:
    """Two hours without values, in which a value holds for 10 min; a line ends at its last value.

    A block is drawn where values went beyond their line: a roof that only fills has none; a single
    gust has one, of its stretch only. The pump ran just before the gap.
    """
    watched = store("ended", SITE)
    before = np.arange(0, 4 * 3600, 10)
    newest = BEGIN + int(before[-1])
    level = np.where(before == 3600, 0.06, 0.03 + 1e-5 * np.minimum(before, 1800))
    flow = np.where(before == before[-1] - 10, 8e-3, 2e-4)
    after = newest + np.arange(2 * 3600, 3 * 3600, 10)
    for topic, values, last in (
        ("/roof/level", level, 0.048), ("/pump/flow", flow, 2e-4),
        ("/weather/precipitation", np.full(len(before), 1e-6), None),
    ):
        add_series(watched, topic, (BEGIN + before) * SECOND, values)
        if last is not None:
            add_series(watched, topic, after * SECOND, last)
    page = open_page(watched)
    until_drawn(page)
    for key, high, low, ink in (("roof", 60, 25, BLACK), ("pump", 400, 2, BLUE)):
        for at, there in ((-3000, True), (1800, False), (2 * 3600 + 1800, True)):
            column = [newest + at, newest + at, high, low, ink]
            assert (page.evaluate(OPACITY, [key, *column]) > 0.5) == there, (key, at)
    for key, name in (("roof", "roof"), ("pump", "flow"), ("rain", "rain")):
        assert page.evaluate(READ, [key, name, newest - 5]) != ""
        assert page.evaluate(READ, [key, name, newest + 3600]) == ""
    assert page.evaluate(READ, ["pump", "flow", newest + 590]) != ""
    assert page.evaluate(READ, ["pump", "flow", newest + 610]) == ""
    assert page.evaluate("charts.rows.rain.at(-1).t - charts.ms(0)") / 1000 == newest
    assert page.evaluate(READ, ["pump", "flow", BEGIN + 5]) == "12.0 L/min"
    blocks = """(name) => charts.blocks[name].map(({ from, to, low, high }) => (
        [...[from, to].map((t) => (t - charts.ms(0)) / 1000), low, high]))"""
    ((begin, end, *gust),) = page.evaluate(blocks, "roof")
    assert begin - BEGIN <= 3600 <= end - BEGIN
    assert end - begin == read_series(watched, 12)["stretch"] == 80
    assert gust == pytest.approx([48.0, 60.0])
    ((begin, end, *pumped),) = page.evaluate(blocks, "flow")
    assert begin <= newest - 10 < newest < end <= newest + 80
    assert pumped == pytest.approx([12.0, 480.0])
    assert page.evaluate(READ, ["pump", "flow", newest - 5]) == "12.0 (12.0 to 480.0) L/min"
    # Blocks are named next to their chart.
    assert [text.split("\n") for text in page.locator(".charts .head").all_inner_texts()] == [
        ["Roof level", "measured", "its range", "good"], ["Cistern level"],
        ["Pump", "flow", "its range"], ["Rain and evapotranspiration", "rain"],
    ]


def test_a_short_run_of_the_pump_is_seen(open_page: Open) -> None:
    """Runs of 10 s in twelve hours, where a pixel has minutes; blocks are three tenths opaque."""
    width = 400
    watched = store("ended", SITE)
    seconds, runs = np.arange(0, 12 * 3600, 10), np.arange(3600, 12 * 3600, 5010)
    flow = np.where(np.isin(seconds, runs), 8e-3, 0.0)
    add_series(watched, "/pump/flow", (BEGIN + seconds) * SECOND, flow)
    page = open_page(watched)
    page.set_viewport_size({"width": width, "height": 900})
    until_drawn(page)
    read = "charts.views.get('pump').plot.width"
    wait_for(lambda: abs(page.evaluate(read) - width) < 60, 60, "charts of this width")
    for run in runs.tolist():
        at = [BEGIN + run - 60, BEGIN + run + 60]
        assert page.evaluate(OPACITY, ["pump", *at, 470, 20, BLUE]) == pytest.approx(0.3, abs=0.02)
    at = [BEGIN + 4200, BEGIN + 4800]
    assert page.evaluate(OPACITY, ["pump", *at, 470, 20, BLUE]) == 0


def test_pointer_and_keyboard_read_values(ended_run: tuple[GraphStore, Any]) -> None:
    watched, page = ended_run
    frame = page.locator(".frame").first
    frame.scroll_into_view_if_needed()
    frame.hover(position={"x": 150, "y": 60})
    tip = until_shown(page, ".tip", "measured").inner_text()
    at, number = re.search(r"(\d{4}-\S+ \S+)[\s\S]*?([\d.]+)[^\n]* mm", tip).groups()
    moment = np.datetime64(at.replace(" ", "T")).astype("datetime64[s]").astype(int)
    ((_, offset),) = document_of(watched)["time"]["clock"]
    rows = np.array(read_series(watched, 12)["lines"]["roof"])
    level = np.interp(moment - offset * 3600, rows[:, 0], rows[:, 3])
    assert float(number) == pytest.approx(1000 * level, abs=0.06)
    page.mouse.move(5, 5)
    assert page.locator(".tip:visible").count() == 0
    frame.focus()
    frame.press("ArrowLeft")
    assert "measured" in until_shown(page, ".tip").inner_text()
    assert "measured" in page.locator("#announced").text_content()
    frame.press("Escape")


# The writing of a time (s since 1970) by the charts: on the axis and at the pointer.
WRITTEN = """(at) => {
    const { plot } = charts.views.get("rain");
    const [axis] = plot.axes;
    return axis.values(plot, [at * 1000])[0];
}"""


def test_every_time_is_by_the_sites_clock(open_page: Open) -> None:
    """Heading, axis, pointer and answers, regardless of the browser's zone: it is UTC here.

    Toronto's clocks went back an hour at 06:00 UTC on 7 November 2021, in the middle of the charts.
    """
    change = int(datetime(2021, 11, 7, 6, tzinfo=timezone.utc).timestamp())
    site = replace(SITE, time_zone="America/Toronto", utc_offset=-5.0)
    watched = store("ended")
    seconds = np.arange(change - 7200, change + 7200, 10)
    for topic in ("/roof/level", "/cistern/level", "/weather/precipitation"):
        add_series(watched, topic, seconds * SECOND, 1e-6)
    page = open_page(watched, pump())
    watched.set_site(site)
    until_shown(page, "#time", "2021-11-07 02:59:50 EST, America/Toronto")
    until_drawn(page)
    assert [page.evaluate(WRITTEN, change + at) for at in (-3600, -1800, 0, 5400)] == [
        "01:00", "01:30", "01:00", "02:30"
    ]
    frame = page.locator(".frame").first
    frame.scroll_into_view_if_needed()
    frame.hover(position={"x": 700, "y": 60})
    tip = until_shown(page, ".tip", "measured").inner_text()
    assert tip.startswith("2021-11-07 0")
    until_shown(page, "#stop-button", "Keep the pump off").click()
    page.locator("#ask-yes").click()
    answer = until_shown(page, "#answer.failed", "no request was sent").inner_text()
    assert re.match("0(2:59:5|3:00:)", answer)


def test_zoom_and_how_far_back(open_page: Open) -> None:
    watched = site_watched()
    seen = "(({ min, max }) => [min, max])(charts.views.get('pump').plot.scales.x)"
    page = open_page(watched)
    until_drawn(page)
    frame = page.locator(".frame").nth(2)
    frame.scroll_into_view_if_needed()
    whole = page.evaluate(seen)
    box = frame.bounding_box()
    page.mouse.move(box["x"] + 300, box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 500, box["y"] + 40, steps=4)
    page.mouse.up()
    wait_for(lambda: page.evaluate(seen) != whole, 60, "a zoom")
    zoomed = page.evaluate(seen)
    assert whole[0] < zoomed[0] < zoomed[1] < whole[1]
    page.locator("#zoom-all").click()
    wait_for(lambda: page.evaluate(seen) == whole, 60, "the whole time")
    assert page.locator("#zoom-all").is_disabled()
    page.locator("[data-hours='3']").click()
    pressed = page.locator("[data-hours][aria-pressed=true]")
    assert [button.text_content() for button in pressed.all()] == ["3 h"]
    wait_for(lambda: page.evaluate(seen)[0] > whole[0], 60, "three hours")
    left, right = page.evaluate(seen)
    assert (right - left) / 3_600_000 == pytest.approx(6, abs=0.1)


def test_the_words_of_an_axis_can_be_read(ended_run: tuple[GraphStore, Any]) -> None:
    """By day and by night, with a contrast of at least 4.5, as level AA of WCAG 2.1 asks for."""
    _, page = ended_run
    read = (
        "[...charts.views.values()].flatMap(({ plot }) => plot.axes).map((axis) => axis.stroke())"
    )
    for scheme, card, inks in (
        ("dark", "rgb(31, 37, 40)", {"#eef2f4", "#E98A4A", "#2DBE93"}),
        ("light", "rgb(255, 255, 255)", {"#1c2226", "#a83a00", "#00694d"}),
    ):
        page.emulate_media(color_scheme=scheme)
        wait_for(lambda inks=inks: {*page.evaluate(read)} == inks, 60, "the words' colours")
        colour = page.locator(".charts").evaluate("(box) => getComputedStyle(box).backgroundColor")
        assert colour == card


# --------------------------------------------------------------------------- what can be done there


def test_alarms_and_events_are_listed(open_page: Open) -> None:
    """Equal events at the same time are all kept: while simulated time stands, or between two reports,
    a parameter can change back and forth.
    """
    watched = site_watched()
    weather = node("/weather", "weather", ("forecast", 1, "its forecast is old"))
    said = [*weather, *mpc()]
    page = open_page(watched, said)
    until_shown(page, ".alarm", CANNOT)
    # What to do is stated once, at the top.
    todo = wait_for(lambda: document_of(watched)["alarms"][0]["do"], 60, "what to do")
    assert page.locator("body").inner_text().count(todo) == 1
    assert todo in page.locator("#advice").inner_text()
    said[:] = [*weather, *mpc(0, "solves it")]
    wait_for(lambda: page.inner_text("#past-word") == "1 alarm is over", 60, "one line")
    assert not page.locator(".alarm.over").is_visible()
    assert todo not in page.locator("body").inner_text()
    page.click("#past-word")
    until_shown(page, ".alarm.over", CANNOT)
    events = page.locator("#events li")
    count = events.count()
    for number in range(1, 3):
        watched.add_event("/mpc: weight was changed from 1 to 2")
        watched.add_event("/mpc: weight was changed from 2 to 1")
        wait_for(lambda n=number: events.count() >= count + 2 * n, 60, "the events")
        assert events.count() == count + 2 * number


def test_stop_asks_once_and_reports_what_came_of_it(open_page: Open) -> None:
    """Here no pump node answers, and the page must report it; it also works by keyboard.

    If the stop was only accepted, the button stays. Answer and warning disappear when the pump
    stands; the command that releases the pump is shown for as long as it is stopped.
    """
    said = pump()
    page = open_page(site_watched("live"), said)
    # A browser has six connections to a server; five other pages keep one each.
    page.evaluate("""async () => {
        for (let i = 0; i < 5; i += 1) {
            (await fetch("/events?hours=3")).body.pipeTo(new WritableStream());
        }
    }""")
    stop = until_shown(page, "#stop-button", "Keep the pump off")
    stop.click()
    page.locator("#ask-no").click()
    assert not page.locator("#ask").is_visible()
    stop.focus()
    stop.press("Enter")
    until_shown(page, "#ask", "someone releases it. Anyone working on the pump must lock it out")
    page.keyboard.press("Escape")
    assert posted(page) == []
    stop.click()
    page.locator("#ask-yes").click()
    until_shown(page, "#answer.failed", "no request was sent")
    assert posted(page) == ["stop"]
    until_shown(page, "#stop-button:enabled")
    assert not page.locator("#lost").is_visible()
    assert not page.locator("#release").is_visible()
    turns = f"held: {HELD}; the pump is still turning, at 0.80 of its rated speed"
    said[:] = pump(turns, stands=False, hold=HOLD)
    until_shown(page, "#stop-warning", "stop it at its drive's panel")
    until_shown(page, "#stop-button:enabled", "Stop the pump")
    said[:] = pump(f"held: {HELD}", hold=HOLD)
    until_shown(page, "#stop-button:enabled", "The pump is held off")
    page.wait_for_selector("#stop-warning", state="hidden")
    page.wait_for_selector("#answer", state="hidden")
    shown = until_shown(page, "#release-call").inner_text()
    assert shown == "greenroof release"
    until_shown(page, "#hold", "A hold by the operator.")
    said[:] = pump()
    page.wait_for_selector("#release", state="hidden")


def test_with_its_token_it_releases_and_gives_a_dose_after_a_question(browser: Any) -> None:
    """Without the right token the page states that it is missing, and shows nothing.

    The volume is the one named in the question; if no dose is permitted, the page states why.
    """
    watched = site_watched("live")
    watched.allow_release = True
    said = pump(f"held: {HELD}", hold=HOLD)
    with (
        saying(watched, said), served(watched, "secret") as port,
        opened(browser, port, hash_="#token=wrong") as page,
    ):
        until_shown(page, "#lost", "the address is not valid without its token")
        assert page.locator(".tile").count() == 0
        page.evaluate("location.hash = '#token=secret'")
        until_shown(page, ".tile[data-key=roof] .value")
        assert not page.locator("#lost").is_visible()
        assert page.context.cookies() == []
        page.said.clear()
        until_shown(page, "#release", "must lock it out at the pump itself")
        assert not page.locator("#release-by-hand").is_visible()
        page.locator("#release-button").click()
        until_shown(page, "#ask", "starts automatically when the controller requires it")
        page.locator("#ask-no").click()
        assert posted(page) == []
        page.locator("#release-button").click()
        page.locator("#ask-yes").click()
        until_shown(page, "#answer.failed", "no request was sent")
        assert posted(page) == ["release"]
        page.locator("#release-button").click()
        said[:] = pump(f"held: {HELD}", hold=HOLD, fault="a slow start", no_clear="")
        until_shown(page, "#answer.failed", "the situation has changed")
        assert not page.locator("#ask").is_visible()
        page.locator("#clear-button").click()
        until_shown(page, "#ask", "The pump nevertheless stays off: a hold by the operator.")
        page.locator("#ask-yes").click()
        until_shown(page, "#answer.failed", "no request was sent")
        assert posted(page) == ["release", "clear"]
        said[:] = pump("off: the command is 0", max_dose=0.5, no_dose="")
        page.wait_for_selector("#dose-button", state="visible")
        volume = page.locator("#dose-volume")
        for wrong in ("", "0.6", "-0.1", "0"):
            volume.fill(wrong)
            page.locator("#dose-button").click()
            limits = "A dose must be at most 0.5 m³, equivalent to "
            until_shown(page, "#answer.failed", limits)
        volume.fill("0.25")
        page.locator("#dose-button").click()
        until_shown(page, "#ask", "Give a dose of 0.25 m³?")
        with page.expect_request("**/dose") as sent:
            page.locator("#ask-yes").click()
        body = sent.value.post_data_json
        assert (body["volume"], body.keys()) == (0.25, {"volume", "asked_at"})
        assert time.time() - 10 < body["asked_at"] < time.time()
        until_shown(page, "#answer.failed", "no request was sent")
        page.locator("#dose-button").click()
        said[:] = pump("held: frost", max_dose=0.5, no_dose="the pump may not run: frost")
        until_shown(page, "#dose", "No dose is possible now: the pump may not run: frost.")
        until_shown(page, "#answer.failed", "the situation has changed")
        assert not page.locator("#dose-button").is_visible()
        assert page.said == []


def test_what_is_not_responding_now_is_reported_to_be_of_before(browser: Any) -> None:
    """For a page that lost its connection; then it is updated again."""
    watched = site_watched()
    with ExitStack() as stack:
        with served(watched) as port:
            page = stack.enter_context(opened(browser, port))
            until_shown(page, ".tile[data-key=roof]")
            watched.add_statuses(time.monotonic(), mpc())
            wait_for(lambda: page.title() == "1 alarm. Green roof", 60, "the title")
            at = document_of(watched)["time"]["text"]
        until_shown(page, "#lost", f"Not connected: the values shown are from {at}.")
        assert page.locator(".tile[data-key=roof] .value").is_visible()
        watched.add("/roof/level", (BEGIN + 5 * 3600) * SECOND, 0.05)  # an hour later
        with served(watched, port=port):
            until_shown(page, ".tile[data-key=roof] .value", "50.0 mm")
            assert not page.locator("#lost").is_visible()


def _without_summary(store: GraphStore, wall: float) -> dict[str, Any]:
    """Return the document with a tile that the browser cannot show."""
    document = read_document(store, wall)
    document["tiles"]["summary"] = None
    return document


@pytest.mark.parametrize(("broken", "instead"), [
    ("make_series", fail), ("make_document", _without_summary),
])
def test_a_fresh_page_has_its_stop_if_a_part_cannot_be_shown(
    browser: Any, monkeypatch: pytest.MonkeyPatch, broken: str, instead: Callable[..., Any]
) -> None:
    """Neither a tile, nor the charts, nor even the whole document is needed for it."""
    watched = site_watched("live")
    watched.update(time.monotonic())
    monkeypatch.setattr(f"greenroof_ros.watch.server.{broken}", instead)
    with saying(watched, pump("running", stands=False)), served(watched) as port:
        page = browser.new_page()
        page.set_default_timeout(LONG_MS)
        page.goto(f"http://127.0.0.1:{port}/")
        if instead is _without_summary:  # no other tile is hidden
            page.wait_for_selector("[data-key=pump] .value")
            page.wait_for_selector("#notes li:has-text('This browser cannot show')")
            assert page.inner_text("[data-key=roof] h2").startswith("Roof level")
        page.click("#stop-button")
        page.click("#ask-yes")
        page.wait_for_selector("#answer.failed")
        assert "The watcher is busy, so no request was sent" in page.inner_text("#answer")
        page.close()
