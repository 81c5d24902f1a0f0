"""The page in a real browser, at the real server: what it shows, and what can be done there."""

from __future__ import annotations

import json
import re
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsers import started_browser
from graphs import Process, free_ports, wait_for
from page_server import page_files, served
from places import CONFIG, guarding
from simulators import Simulator

from greenroof_ros.model.look_ahead import growing_steps
from greenroof_ros.model.site import read_site
from greenroof_ros.report.drawing import COLOURS
from greenroof_ros.watch.alarms import Alarms
from greenroof_ros.watch.bag import Dated
from greenroof_ros.watch.document import document as read_document
from greenroof_ros.watch.document import series as read_series
from greenroof_ros.watch.store import Store
from greenroof_ros.watch.wire import Status

BEGIN = 1_626_757_200  # 2021-07-20 05:00 UTC
HOSTILE = "<img src=x onerror=hacked=1><script>hacked=2</script>\x00\x1b[31m\u202e" + "A" * 5000
LONG_MS = 60_000  # the machine may be busy


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A browser without a window."""
    with started_browser() as started:
        yield started


def status(name: str, level: int, message: str, **values: str) -> Status:
    if "role" in values:
        values["process"] = '"this machine 1"'
    return Status(name, level, message, "this machine", values)


PUMP = status(
    "/pump", 0, "ready", role='"pump"', process='"a 1"', pump='"off: nothing is commanded"',
    stands="true",
)
CONTROLLER = status("/mpc", 0, "ready", role='"controller"')
ALARM = status("/mpc: program", 2, "cannot solve its program", code="controller_failed")


@contextmanager
def saying(watched: Store, *statuses: Status) -> Iterator[list[Status]]:
    """Have nodes say how they are, four times a second as they do; the list may be changed."""
    said, ended = list(statuses), threading.Event()

    def say() -> None:
        while not ended.wait(0.25):
            watched.add_statuses(time.monotonic(), list(said))

    watched.add_statuses(time.monotonic(), said)
    thread = threading.Thread(target=say)
    thread.start()
    try:
        yield said
    finally:
        ended.set()
        thread.join()


def site_watched(mode: str = "ended") -> Store:
    """Return what is known of a site after four hours, with a forecast and a plan.

    Of a run that has ended nothing grows stale while a test looks.
    """
    watched = Store()
    watched.set_site(read_site(CONFIG / "site.yaml"))
    watched.set_present(mode=mode, factor=30.0, source="heard", note="A note.")
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
        watched.add(topic, seconds * 10**9, values)
    now_ns = int(seconds[-1]) * 10**9
    ends = np.arange(1, 13) * 3600.0
    watched.add_plan(now_ns, np.stack(
        (ends, np.where(ends < 7200, 0.0, 1e-4), np.full(12, 0.046)), axis=1
    ))
    front = np.array([seconds[-1], *growing_steps(1)[1:]])
    rain = np.outer(np.arange(3), np.full(len(front) - 1, 1e-6))
    watched.add_forecast("/forecast/precipitation", now_ns, rain, front)
    return watched


@contextmanager
def opened(
    browser: Any, port: int, width: int = 1400, hash_: str = "", context: Any = None
) -> Iterator[Any]:
    """Open the page; all that a browser complains of is in ``page.said``."""
    with ExitStack() as stack:
        if context is None:
            context = browser.new_context(viewport={"width": width, "height": 900})
            stack.callback(context.close)
        page = context.new_page()
        stack.callback(page.close)
        page.set_default_timeout(LONG_MS)
        page.said, page.asked = [], []
        page.on("console", lambda message: page.said.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: page.said.append(str(error)))
        page.on("dialog", lambda dialog: page.said.append(f"dialog: {dialog.message}"))
        page.on("request", lambda request: page.asked.append((request.method, request.url)))
        page.goto(f"http://localhost:{port}/{hash_}")
        yield page


def until_shown(page: Any, selector: str, text: str | re.Pattern[str] = "") -> Any:
    """Wait until an element is visible with some text, and return it."""
    found = page.locator(selector).filter(has_text=text).first
    found.wait_for()
    return found


def until_drawn(page: Any) -> None:
    page.wait_for_selector("html[data-drawn]", state="attached")


def overflow(page: Any) -> int:
    """By how much the page is wider than the window (px)."""
    return page.evaluate(
        "document.documentElement.scrollWidth - document.documentElement.clientWidth"
    )


def document_of(watched: Store) -> dict[str, Any]:
    return read_document(watched, time.monotonic())


# ---------------------------------------------------------------------------------- what it shows


def test_it_shows_the_words_of_the_document(browser: Any) -> None:
    """Word for word; the console stays empty, and nobody else is asked for anything."""
    watched = site_watched()
    with served(watched) as port, opened(browser, port) as page:
        until_shown(page, ".tile[data-key=controller]")
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
        until_shown(page, "#account td", "m3")  # an ended run's account is closed
        rows = [[row["label"], row["value"]] for row in document_of(watched)["account"]["rows"]]
        assert page.locator("#account tr").evaluate_all(
            "(rows) => rows.map((row) => [...row.cells].map((cell) => cell.textContent))"
        ) == rows
        until_drawn(page)
        assert page.said == []
        assert {url.split("/")[2] for _, url in page.asked} == {f"localhost:{port}"}
        assert not page.locator("#stop").is_visible()  # no pump node is there


def test_level_is_said_by_word_shape_and_colour(browser: Any) -> None:
    watched = site_watched()
    with (
        saying(watched, CONTROLLER, ALARM) as said_by_nodes, served(watched) as port,
        opened(browser, port) as page,
    ):
        looks = []
        for level, name, said in (
            (0, "ok", "No alarms."), (1, "warn", "1 warning."), (2, "error", "1 alarm."),
        ):
            said_by_nodes[1] = status("/mpc: program", level, "because")
            page.wait_for_selector(f"#summary[data-level={name}]")
            until_shown(page, "#summary-word", said)
            looks.append((
                page.locator("#summary-shape").get_attribute("href"),
                page.locator("#summary").evaluate("(one) => getComputedStyle(one).borderColor"),
            ))
        assert len(set(looks)) == len({shape for shape, _ in looks}) == 3


def test_hostile_texts_are_texts(browser: Any) -> None:
    """Markup, control characters and megabytes: shown as text, and no wider than a phone."""
    watched = site_watched()
    statuses = (
        CONTROLLER, status("/mpc: program", 2, HOSTILE),
        *(status(f"{HOSTILE}{i}", 2, HOSTILE) for i in range(50)),
        status("/pump", 0, "ready", role='"pump"', pump=json.dumps(f"fault: {HOSTILE}")),
    )
    watched.add_event(time.time(), HOSTILE)
    watched.set_present(mode="simulated", factor=30.0, source="heard", note=HOSTILE)
    with (
        saying(watched, *statuses), served(watched) as port,
        opened(browser, port, width=400) as page,
    ):
        alarm = until_shown(page, ".alarm .what", "<script>hacked=2</script>")
        assert alarm.text_content() in [row["what"] for row in document_of(watched)["alarms"]]
        until_shown(page, ".tile[data-key=pump] .why", "<script>")
        until_shown(page, ".events li", "<script>")
        until_drawn(page)
        assert page.locator("img, body script").count() == 0
        assert page.evaluate("window.hacked") is None
        assert page.said == []
        assert overflow(page) == 0


@pytest.mark.parametrize("width", [400, 800, 1400])
def test_it_fits_every_width(browser: Any, width: int) -> None:
    watched = site_watched("simulated")
    with (
        saying(watched, PUMP, CONTROLLER, ALARM), served(watched) as port,
        opened(browser, port, width) as page,
    ):
        until_drawn(page)
        until_shown(page, ".alarm")
        assert overflow(page) == 0
        values = page.locator(".tile .value")
        assert min(values.evaluate_all(
            "(all) => all.map((one) => parseFloat(getComputedStyle(one).fontSize))"
        )) >= 24
        assert page.locator("#stop-button").bounding_box()["height"] >= 44  # a finger's


def test_what_is_old_is_said_to_be(browser: Any) -> None:
    """A value that does not come any more is unknown; what was heard last stands beside it."""
    watched = site_watched("simulated")
    read_document(watched, time.monotonic() - 60)  # a look of a minute ago: nothing came since
    with served(watched) as port, opened(browser, port) as page:
        until_shown(page, ".tile.stale[data-key=roof] .value", "unknown")
        sentence = page.locator(".tile[data-key=roof] .sentence").text_content()
        assert re.fullmatch(r"[\d.]+ mm when last heard at [\d:]+", sentence)
        assert page.locator(".tile[data-key=roof] .fill").bounding_box()["width"] == 0
        assert page.locator(".tile[data-key=roof] .state").inner_text().strip() == "not known"
        watched.set_present(mode="ended", factor=None, source="heard", note="")
        until_shown(page, "#heading", "Ended run")
        assert page.locator(".tile.stale").count() == 0


# --------------------------------------------------------------------------------------- charts


def test_charts_have_one_time_axis_and_the_values(browser: Any) -> None:
    watched = site_watched()
    with served(watched) as port, opened(browser, port) as page:
        until_drawn(page)
        places = page.evaluate(
            "[...charts.views.values()].map(({ plot }) => [plot.bbox.left, plot.bbox.width])"
        )
        assert len(places) == 4
        assert np.ptp(np.array(places), axis=0).max() <= 1
        series = read_series(watched, 12)
        shown = page.evaluate("charts.rows.roof.map((row) => row.v)")
        measured = [1000 * row[3] for row in series["lines"]["roof"]]
        assert shown[: len(measured)] == pytest.approx(measured)
        band = page.evaluate("charts.rows.forecast[0]")
        assert [band["low"], band["v"], band["high"]] == pytest.approx([0.0, 3.6, 7.2])
        planned = page.evaluate("charts.rows.plan.map((row) => row.v)")
        assert min(planned) == 0 and max(planned) == pytest.approx(6.0)
        assert page.said == []


def test_nothing_is_drawn_or_read_where_nothing_was_heard(browser: Any) -> None:
    """Two hours without values, and an hour since the rain was heard; a value holds for 10 min."""
    watched = site_watched()
    newest = BEGIN + 4 * 3600 - 10
    later = np.arange(newest + 2 * 3600, newest + 3 * 3600, 10)
    for topic in ("/roof/level", "/pump/flow"):
        watched.add(topic, later * 10**9, np.full(len(later), 0.05))
    # What is drawn: of the canvas' columns in which the line has a pixel of its colour.
    drawn = '''([key, t]) => {
      const { plot } = charts.views.get(key);
      const x = Math.round(plot.valToPos(charts.ms(t), "x", true));
      const { top, height } = plot.bbox;
      const column = new OffscreenCanvas(1, height + 4);
      const copy = column.getContext("2d", { willReadFrequently: true });
      copy.drawImage(plot.ctx.canvas, x, top - 2, 1, height + 4, 0, 0, 1, height + 4);
      const pixels = copy.getImageData(0, 0, 1, height + 4).data;
      const ink = key === "roof" ? [0, 0, 0] : [0, 114, 178];
      return [...Array(height + 4).keys()].some(
        (i) => pixels[4 * i + 3] > 128
          && ink.every((one, c) => Math.abs(pixels[4 * i + c] - one) < 40));
    }'''
    read = '''([key, name, t]) => {
      const { chart } = charts.views.get(key);
      return charts.valueAt(chart, chart.lines.find((line) => line.name === name), charts.ms(t));
    }'''
    with served(watched) as port, opened(browser, port) as page:
        until_drawn(page)
        for key in ("roof", "pump"):
            assert page.evaluate(drawn, [key, newest - 3000])
            assert not page.evaluate(drawn, [key, newest + 1800])
            assert page.evaluate(drawn, [key, newest + 2 * 3600 + 1800])
        for key, name in (("roof", "roof"), ("pump", "flow"), ("rain", "rain")):
            assert page.evaluate(read, [key, name, newest - 5]) != ""
            assert page.evaluate(read, [key, name, newest + 3600]) == ""
        assert page.evaluate(read, ["pump", "flow", newest + 590]) != ""
        assert page.evaluate(read, ["pump", "flow", newest + 610]) == ""
        held = page.evaluate("charts.rows.rain.at(-1).t - charts.ms(0)") / 1000
        assert held == newest + 600
        assert page.said == []


def test_a_band_is_where_a_value_went_beyond_its_line(browser: Any) -> None:
    """A roof that merely fills has none; an hour later one gust makes one, of its stretch alone."""
    watched = Store()
    watched.set_site(read_site(CONFIG / "site.yaml"))
    watched.set_present(mode="ended", factor=None, source="bag", note="")
    seconds = np.arange(0, 7200, 10)
    level = 0.03 + 1e-5 * np.minimum(seconds, 1800)
    watched.add("/roof/level", (BEGIN + seconds) * 10**9, np.where(seconds == 3600, 0.06, level))
    read = """charts.rows.roof_range
      .filter((row) => row.high - row.low > 1e-6)
      .map((row) => [row.t - charts.ms(0), row.low, row.high])"""
    with served(watched) as port, opened(browser, port) as page:
        until_drawn(page)
        (begin, *first), (end, *last) = page.evaluate(read)
        assert first == last == pytest.approx([48.0, 60.0])
        assert begin / 1000 - BEGIN <= 3600 <= end / 1000 - BEGIN
        assert end - begin <= 130_000
        assert page.said == []


def test_a_pump_that_may_turn_is_an_alarm_and_has_no_flow(browser: Any) -> None:
    watched = site_watched("loop")
    pump = replace(PUMP, values={
        **PUMP.values, "pump": '"off: whether the pump stands is not known"', "stands": "false",
        "speed": "null", "flow": "null",
    })
    part = status("/pump: pump", 1, "off: whether the pump stands is not known")
    with saying(watched, pump, part), served(watched) as port, opened(browser, port) as page:
        tile = until_shown(page, ".tile[data-key=pump][data-tone=error]", "unknown")
        until_shown(page, "#summary[data-level=error]", "whether the pump stands is not known")
        assert "L/min" not in tile.inner_text() and "\noff" not in tile.inner_text()
        until_drawn(page)
        last = "charts.rows.flow.at(-1).v"
        page.wait_for_function(f"{last} === null")
        assert page.said == []


def test_a_recording_has_no_tick_and_shows_its_incidents(browser: Any) -> None:
    watched = site_watched()
    with served(watched) as port, opened(browser, port) as page:
        until_shown(page, "#summary", "Alarms are not known")
        assert "ok" not in page.locator("#summary-shape").get_attribute("href")
        watched.set_incidents([
            Dated("pump", "drive", "no connection", "drive_lost", BEGIN + 60.0, BEGIN + 90.0)
        ])
        row = until_shown(page, ".alarm.over", "pump: drive")
        assert not row.locator("button").is_visible()
        until_shown(page, "#summary[data-level=warn]", "1 incident, over.")
        lasts = Dated("pump", "drive", "no connection", "drive_lost", BEGIN + 60.0, None)
        watched.set_incidents([lasts])
        until_shown(page, ".alarm:not(.over)", "pump: drive")
        until_shown(page, ".tile[data-key=pump][data-tone=error]", "unknown")
        assert page.said == []


def test_the_release_of_a_stop_stands_beside_it(browser: Any) -> None:
    watched = site_watched("loop")
    pump = replace(PUMP, values={**PUMP.values, "stop": '"an operator stopped it"'})
    with saying(watched, PUMP) as said, served(watched) as port, opened(browser, port) as page:
        until_shown(page, "#stop-button")
        assert not page.locator("#release").is_visible()
        said[:] = [pump]
        shown = until_shown(page, "#release-call").inner_text()
        assert shown == 'ros2 service call /pump/stop std_srvs/srv/SetBool "{data: false}"'
        said[:] = [PUMP]
        page.wait_for_selector("#release", state="hidden")


def test_a_stop_of_the_page_is_released_there_after_a_question(browser: Any) -> None:
    """With the token alone; here nobody answers, and the page must say so."""
    watched = site_watched("loop")
    watched.allow_release = True
    stopped = replace(PUMP, values={
        **PUMP.values, "stop": '"somebody stopped it on the page"', "stopped_by": '["page"]',
    })
    with (
        saying(watched, stopped), served(watched, "secret") as port,
        opened(browser, port, hash_="#token=secret") as page,
    ):
        until_shown(page, "#release", "locks it out at the pump itself")
        assert not page.locator("#release-ros").is_visible()
        page.locator("#release-button").click()
        until_shown(page, "#ask", "starts by itself when the controller asks for it")
        page.locator("#ask-no").click()
        assert [url for method, url in page.asked if method == "POST"] == []
        page.locator("#release-button").click()
        page.locator("#ask-yes").click()
        until_shown(page, "#answer.failed", "is not known")
        assert [url for method, url in page.asked if method == "POST"] == [
            f"http://localhost:{port}/release"
        ]
        assert page.said == []


def test_pointer_and_keyboard_read_values(browser: Any) -> None:
    watched = site_watched()
    with served(watched) as port, opened(browser, port) as page:
        until_drawn(page)
        frame = page.locator(".frame").first
        frame.scroll_into_view_if_needed()
        frame.hover(position={"x": 150, "y": 60})
        tip = until_shown(page, ".tip", "measured").inner_text()
        at, number = re.search(r"(\d{4}-\S+ \S+)[\s\S]*?([\d.]+)[^\n]* mm", tip).groups()
        moment = np.datetime64(at.replace(" ", "T")).astype("datetime64[s]").astype(int)
        offset = document_of(watched)["time"]["utc_offset"]
        rows = np.array(read_series(watched, 12)["lines"]["roof"])
        level = np.interp(moment - offset * 3600, rows[:, 0], rows[:, 3])
        assert float(number) == pytest.approx(1000 * level, abs=0.06)
        page.mouse.move(5, 5)
        assert page.locator(".tip:visible").count() == 0
        frame.focus()
        frame.press("ArrowLeft")
        assert "measured" in until_shown(page, ".tip").inner_text()
        assert "measured" in page.locator("#announced").text_content()


def test_zoom_pause_and_how_far_back(browser: Any) -> None:
    watched = site_watched()
    seen = "(({ min, max }) => [min, max])(charts.views.get('pump').plot.scales.x)"
    with served(watched) as port, opened(browser, port) as page:
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
        page.locator("#pause").click()
        watched.add("/roof/level", np.array([(BEGIN + 5 * 3600) * 10**9]), np.array([0.05]))
        until_shown(page, ".tile[data-key=roof] .value", "50.0 mm")  # tiles go on
        newest = "charts.rows.roof.at(-1).v"
        page.wait_for_timeout(3000)
        assert page.evaluate(newest) < 50
        page.locator("#pause").click()
        wait_for(lambda: page.evaluate(newest) == 50, 60, "what came since")
        page.locator("[data-hours='3']").click()
        wait_for(lambda: page.evaluate(seen)[0] > whole[0], 60, "three hours")
        left, right = page.evaluate(seen)
        assert (right - left) / 3_600_000 == pytest.approx(6, abs=0.1)
        assert page.said == []


def test_a_low_outlet_has_its_line_and_no_words_stand_on_others(browser: Any) -> None:
    """In chart and tile, at a desk and on a phone: the words of three references."""
    watched = site_watched()
    with served(watched) as port:
        watched.set_site(replace(
            read_site(CONFIG / "site.yaml"), low_outlet_level=1.0, low_outlet_radius=0.02
        ))
        for width in (1400, 400):
            with opened(browser, port, width) as page:
                until_drawn(page)
                marks = page.evaluate("charts.views.get('cistern').marks")
                assert [(one["text"], one["inside"]) for one in marks] == [
                    ("suction level 750 mm", True), ("low outlet 1000 mm", True),
                    ("outlet 3000 mm \u2191", False),
                ]
                shown = page.locator(".tile[data-key=cistern] .text")
                words = [one.bounding_box() for one in shown.all()]
                assert len(words) == 3
                for one, other in combinations(words, 2):
                    assert (
                        one["x"] + one["width"] <= other["x"]
                        or other["x"] + other["width"] <= one["x"]
                        or one["y"] + one["height"] <= other["y"] + 1
                        or other["y"] + other["height"] <= one["y"] + 1
                    )
                assert page.said == []


def test_colours_are_the_reports() -> None:
    """On white each is one of Okabe and Ito's, as in the report."""
    (style,) = (file for file in page_files() if file.name == "page.css")
    light = style.read_text(encoding="utf-8").partition("@media")[0]
    for name in ("roof", "cistern", "flow", "command", "rain", "rain-fill", "evapotranspiration"):
        (colour,) = re.findall(rf"--{name}: (#\w+);", light)
        assert colour in COLOURS, name


# --------------------------------------------------------------------------- what can be done there


def test_acknowledged_alarms_stay_listed_and_the_list_keeps_the_focus(browser: Any) -> None:
    watched = site_watched()
    weather = status("/weather: forecast", 1, "its forecast is old")
    nodes = CONTROLLER, status("/weather", 0, "ready", role='"weather"')
    with (
        saying(watched, *nodes, weather, ALARM) as said, served(watched) as port,
        opened(browser, port) as page,
    ):
        row = until_shown(page, ".alarm", "cannot solve its program")
        other = page.locator(".alarm", has_text="its forecast is old").locator("button")
        other.focus()
        row.locator("button").click()
        until_shown(page, ".alarm .when", "acknowledged")
        assert not row.locator("button").is_visible()
        other.focus()
        said[-1] = status("/mpc: program", 0, "solves it")
        until_shown(page, ".alarm.over", "cannot solve its program")
        assert other.evaluate("(one) => document.activeElement === one")
        assert page.said == []


def test_stop_asks_once_and_says_what_came_of_it(browser: Any) -> None:
    """Here no pump node answers, and the page must say so; by the keyboard, too."""
    watched = site_watched("simulated")
    with saying(watched, PUMP), served(watched) as port, opened(browser, port) as page:
        stop = until_shown(page, "#stop-button", "Keep the pump off")
        stop.click()
        page.locator("#ask-no").click()
        assert not page.locator("#ask").is_visible()
        stop.focus()
        stop.press("Enter")
        until_shown(page, "#ask", "somebody releases it")
        page.keyboard.press("Escape")
        assert [url for method, url in page.asked if method == "POST"] == []
        stop.click()
        page.locator("#ask-yes").click()
        until_shown(page, "#answer.failed", "is not known")
        assert len([url for method, url in page.asked if method == "POST"]) == 1
        until_shown(page, "#stop-button:enabled")
        assert page.said == []


def test_a_stop_that_was_only_accepted_keeps_its_button(browser: Any) -> None:
    """What was answered goes when the pump stands, and the warning with it."""

    def pump(why: str, *, stands: bool) -> Status:
        state = json.dumps(f"held: an operator stopped it{why}")
        return status(
            "/pump", 0, "ready", role='"pump"', process='"a 1"', pump=state,
            stands=json.dumps(stands), stop=json.dumps("an operator stopped it"),
        )

    watched = site_watched("simulated")
    with saying(watched, PUMP) as said, served(watched) as port, opened(browser, port) as page:
        until_shown(page, "#stop-button", "Keep the pump off").click()
        page.locator("#ask-yes").click()
        until_shown(page, "#answer.failed", "is not known")
        said[:] = [pump("; the pump still turns, at 0.80 of its speed", stands=False)]
        until_shown(page, "#stop-warning", "Stop it at its drive's panel")
        until_shown(page, "#stop-button:enabled", "Stop the pump")
        said[:] = [pump("", stands=True)]
        until_shown(page, "#stop-button:disabled", "The pump is held off")
        page.wait_for_selector("#stop-warning", state="hidden")
        page.wait_for_selector("#answer", state="hidden")
        assert page.said == []


def test_stop_gets_through_with_six_pages_open(browser: Any) -> None:
    """A browser has six connections to a server, and each page keeps one."""
    context = browser.new_context()
    watched = site_watched("simulated")
    with saying(watched, PUMP), served(watched) as port, ExitStack() as stack:
        stack.callback(context.close)
        pages = []
        for _ in range(6):
            pages.append(stack.enter_context(opened(browser, port, context=context)))
            until_shown(pages[-1], "#stop-button")
        pages[2].locator("#stop-button").click()
        pages[2].locator("#ask-yes").click()
        until_shown(pages[2], "#answer.failed", "is not known")
        assert not pages[2].locator("#lost").is_visible()


def test_a_lost_connection_is_said_and_found_again(browser: Any) -> None:
    watched = site_watched()
    with ExitStack() as stack:
        with served(watched) as port:
            page = stack.enter_context(opened(browser, port))
            until_shown(page, ".tile[data-key=roof]")
            until_drawn(page)
            at = document_of(watched)["time"]["text"]
        until_shown(page, "#lost", f"Not connected: what is shown is of {at}.")
        assert page.locator(".tile[data-key=roof] .value").is_visible()
        watched.add("/roof/level", np.array([(BEGIN + 5 * 3600) * 10**9]), np.array([0.05]))
        with served(watched, port=port):
            until_shown(page, ".tile[data-key=roof] .value", "50.0 mm")
            assert not page.locator("#lost").is_visible()


def test_a_page_that_comes_back_is_not_believed_before_it_hears_anew(browser: Any) -> None:
    """What it shows is of when it was hidden, be that hours ago."""
    hide = """(hidden) => {
        Object.defineProperty(document, "hidden", { value: hidden, configurable: true });
        document.dispatchEvent(new Event("visibilitychange"));
        return document.getElementById("lost").hidden;
    }"""
    watched = site_watched()
    with served(watched) as port, opened(browser, port) as page:
        until_shown(page, ".tile[data-key=roof]")
        assert page.evaluate(hide, True) is False
        watched.add_statuses(time.monotonic(), [CONTROLLER, ALARM])
        wait_for(lambda: page.title() == "1 alarm. Green roof", 60, "the title")
        assert page.locator(".alarm").count() == 0  # of all else it hears nothing
        assert page.evaluate(hide, False) is False  # seen again, and nothing heard yet
        page.wait_for_selector("#lost", state="hidden")
        assert page.locator(".lost-link").count() == 0


def test_an_acknowledgement_that_is_refused_is_said(browser: Any) -> None:
    """The alarm went in the moment in which somebody pressed its button."""
    watched = site_watched()
    watched.add_statuses(time.monotonic(), [ALARM])
    with served(watched) as port, opened(browser, port) as page:
        button = until_shown(page, ".alarm button").element_handle()
        watched.alarms = Alarms()  # of another graph
        page.wait_for_selector(".alarm", state="detached")
        button.evaluate("(one) => one.click()")
        until_shown(page, "#answer.failed", "This alarm is not listed any more.")


def test_all_alarms_are_shown_whole(browser: Any) -> None:
    """None is cut at the end of a list, and no text lies over another one."""
    watched = site_watched()
    long = "the drive at its gateway does not answer " * 12
    watched.add_statuses(time.monotonic(), [
        CONTROLLER, *(status(f"/mpc: part {i}", 2, long) for i in range(12)),
    ])
    with served(watched) as port, opened(browser, port, 800) as page:
        until_shown(page, ".alarm")
        cut = page.evaluate(
            "[...document.querySelectorAll('main p, main ul, #heading')].filter((one) =>"
            " !one.closest('.unseen') && one.scrollHeight > one.clientHeight + 1)"
            ".map((one) => one.outerHTML)"
        )
        assert cut == []
        lines = page.evaluate(  # at one moment: the page goes on
            "[...document.querySelectorAll('.alarm p')].map((one) => one.getBoundingClientRect())"
            ".filter((box) => box.height).map((box) => [box.top, box.bottom])"
        )
        assert len(lines) > 12
        assert all(one[1] <= other[0] + 1 for one, other in pairwise(lines))


def test_equal_events_of_a_moment_stay_as_many_as_they_are(browser: Any) -> None:
    """In simulated time that stands, or between two reports, a parameter goes to and fro."""
    watched = site_watched()
    with served(watched) as port, opened(browser, port) as page:
        for number in range(3):
            watched.add_event(BEGIN, "/mpc: weight was changed from 1 to 2")
            watched.add_event(BEGIN, "/mpc: weight was changed from 2 to 1")
            until_shown(page, "#events li")
            page.wait_for_function(
                "(most) => document.querySelectorAll('#events li').length >= most",
                arg=2 * (number + 1),
            )
            assert page.locator("#events li").count() == 2 * (number + 1)
        assert page.said == []


def test_the_token_is_sent_from_the_address(browser: Any) -> None:
    """Without the right one the page says what is missing, and shows nothing."""
    with served(site_watched(), token="secret") as port, opened(
        browser, port, hash_="#token=wrong"
    ) as page:
        until_shown(page, "#lost", "the address needs its token")
        assert page.locator(".tile").count() == 0
        page.evaluate("location.hash = '#token=secret'")
        until_shown(page, ".tile[data-key=roof] .value", "mm")
        assert not page.locator("#lost").is_visible()
        assert page.context.cookies() == []


def test_stop_holds_a_real_pump(browser: Any, domain: int, tmp_path: Path) -> None:
    """Through a reload, and when the watcher is started again."""

    (port,) = free_ports(1)

    def watch() -> Process:
        process = Process(domain, "watch", "--port", str(port), cwd=tmp_path)
        wait_for(lambda: f":{port}/" in process.stdout(), 60, "the page's address")
        return process

    with Simulator(
        "drive_simulator", "--drive", "danfoss_fc202", "--speed", "20", "--port", "0"
    ) as drive:
        run = Process(
            domain, "bringup", "--drive", guarding("danfoss_fc202", tmp_path / "drives"),
            "--drive-at", f"gateway://127.0.0.1:{drive.ports[0]}", "--hours", "3", "--speed", "20",
            "--controller", "onoff", "--output", "run", cwd=tmp_path,
        )
        watcher = watch()
        with opened(browser, port) as page:
            until_shown(page, "#stop-button", re.compile("Stop the pump|Keep the pump off")).click()
            page.locator("#ask-yes").click()
            until_shown(page, "#answer:not(.failed)", "held")
            held = ".tile[data-key=pump][data-state=held]"
            until_shown(page, held, "somebody stopped it on the page")
            page.reload()
            until_shown(page, held)
            assert until_shown(page, "#stop-button", "The pump is held off").is_disabled()
            watcher.process.send_signal(signal.SIGINT)
            assert watcher.wait(120) == 0
            until_shown(page, "#lost", "Not connected")
            watch()
            page.wait_for_selector("#lost", state="hidden")
            until_shown(page, held)
            run.process.send_signal(signal.SIGINT)
            until_shown(page, "#heading", "Ended run")
            assert not page.locator("#stop-button:enabled").is_visible()
