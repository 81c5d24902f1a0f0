"""The document in a terminal: the same facts and words as on the page, at 80 by 24 and up."""

from __future__ import annotations

import math
import os
import select
import signal
import sys
import termios
import textwrap
import time
import tty
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from typing import Any, ClassVar

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from greenroof_ros.common.processes import InterruptedRun, Signals
from greenroof_ros.graph.looker import StopFailedError
from greenroof_ros.watch.document import document as document_of
from greenroof_ros.watch.document import series as series_of
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.store import Store

# How often the document is looked at (s), and at the charts.
_LOOK_S, _CHARTS_S = 0.5, 2.0
# How often before there was anything to show (s).
_FIRST_S = 0.1
# How often all is printed where nothing can be drawn over (s): into a file, on a dumb terminal.
_PRINT_S = 10.0
# For how long the values of a graph that is there may take to be heard (s).
_FOUND_S = 3.0
_HOURS = 12.0
# The least that is drawn for; what is smaller shows the upper left of it.
_LEAST_WIDTH, _LEAST_HEIGHT = 40, 10
# More lines than any sentence or list has.
_WHOLE = 100
_LABEL, _VALUE, _RANGE = 13, 15, 18
_BARS, _ASCII_BARS = "▁▂▃▄▅▆▇█", "_.:-=+*#"
_WORDS = {"error": "Alarm", "warn": "Warning", "stale": "Not heard"}
_CHARTS = {"roof": "Roof", "cistern": "Cistern", "rain": "Rain", "flow": "Pump"}
# Words say everything; colours repeat it, and are told apart by who sees no red or green.
_STYLES = {
    "error": "bold bright_red", "stale": "bold bright_magenta", "warn": "bold yellow",
    "ok": "bold bright_blue", "alarm": "bold bright_red", "fault": "bold bright_red",
    "held": "bold yellow", "low": "yellow", "high": "yellow", "unknown": "bright_magenta",
    "head": "bold", "dim": "dim",
}


def pages(
    document: Mapping[str, Any], series: Mapping[str, Any], width: int, height: int | None,
    color: bool, *, ascii_only: bool = False,
) -> list[Group]:
    """Return the document as pages of a terminal, at most so wide and of so many lines.

    What must be seen is on the first page: the summary, what to do, the five tiles and the alarms;
    charts, account and events where there is room left. The pages behind it have all of it whole.

    Args:
        document: of :func:`greenroof_ros.watch.document.document`.
        series: of :func:`greenroof_ros.watch.document.series`.
        width: of the terminal, columns.
        height: of the terminal, lines; None for one page of all, where none can be turned.
        color: whether there may be colour.
        ascii_only: whether the terminal has no other characters.
    """
    page = _Page(max(width, _LEAST_WIDTH), color=color, ascii_only=ascii_only)
    whole = _whole(page, document, series)
    if height is None:
        return [Group(*whole)]
    each = max(height, _LEAST_HEIGHT) - 1
    parts = [
        _first(page, document, series, each),
        *(whole[begin:begin + each] for begin in range(0, len(whole), each)),
    ]
    found = []
    for number, lines in enumerate(parts, 1):
        keys = page.line((f"page {number} of {len(parts)}; space turns it, q ends", "dim"))
        filled = [*lines, *[Text()] * (each - len(lines)), keys]
        found.append(Group(*filled[:max(height, 1)]))
    return found


def _first(
    page: _Page, document: Mapping[str, Any], series: Mapping[str, Any], height: int
) -> list[Text]:
    """Return the first page, in so many lines."""
    lines = [*_head(page, document), *_tiles(page, document["tiles"], 2)]
    notes = " ".join(document["notes"])
    foot = [*(page.wrapped(notes, 1, style="dim") if notes else []), *_stop(page, document)]
    room = height - len(lines) - len(foot)
    alarms = _alarms(page, document["alarms"], document["advice"], room - 1)
    charts = _charts(page, series)
    if len(charts) > room - len(alarms) - 2:
        charts = []  # a part of them would not be told from the whole
    for part in (alarms, charts):
        if part:
            lines += [Text(), *part]
            room -= len(part) + 1
    for make in (_account, _events):
        if room > 2 and (part := make(page, document, room - 1)):
            lines += [Text(), *part]
            room -= len(part) + 1
    return [*lines, *[Text()] * room, *foot][:height]


def _whole(
    page: _Page, document: Mapping[str, Any], series: Mapping[str, Any]
) -> list[Text]:
    """Return all there is, nothing of it cut off."""
    lines = [*_head(page, document), *_tiles(page, document["tiles"], _WHOLE)]
    for part in (
        _alarms(page, document["alarms"], document["advice"], _WHOLE * _WHOLE, most=_WHOLE),
        _charts(page, series),
        _account(page, document, _WHOLE),
        _events(page, document, _WHOLE, most=_WHOLE),
        [one for note in document["notes"] for one in page.wrapped(note, _WHOLE)],
        _stop(page, document),
    ):
        if part:
            lines += [Text(), *part]
    return lines


class _Page:
    """How wide lines are, and what they may consist of."""

    def __init__(self, width: int, *, color: bool, ascii_only: bool) -> None:
        self.width = width
        self._color = color
        self._ascii = ascii_only
        self.bars = _ASCII_BARS if ascii_only else _BARS

    def line(self, *parts: tuple[str, str]) -> Text:
        """Return a line of (text, style), cut where it is too long."""
        line = Text(no_wrap=True)
        for text, style in parts:
            line.append(self._printable(text), _STYLES.get(style, "") if self._color else "")
        line.truncate(self.width, overflow="crop" if self._ascii else "ellipsis")
        return line

    def wrapped(self, text: str, most: int, *, indent: str = "", style: str = "") -> list[Text]:
        """Return a text as so many lines at most, the last one cut where there is more."""
        if most < 1:
            return []
        lines = textwrap.wrap(
            self._printable(text), self.width - len(indent), break_on_hyphens=False
        ) or [""]
        if len(lines) > most:
            lines = [*lines[:most - 1], " ".join(lines[most - 1:])]
        return [self.line((indent + one, style)) for one in lines]

    def _printable(self, text: str) -> str:
        """Return a text without what a terminal would act on, or does not have."""
        if not text.isprintable():
            text = "".join(one if one.isprintable() else "?" for one in text)
        return text.encode("ascii", "replace").decode() if self._ascii else text


def _head(page: _Page, document: Mapping[str, Any]) -> list[Text]:
    summary = document["tiles"]["summary"]
    where = f"{document['heading']} {document['namespace']}".strip()
    now = document["time"]["text"]
    gap = " " * max(2, page.width - len(where) - len(now))
    return [
        page.line((where, "head"), (gap, ""), (now, "")),
        *page.wrapped(f"{summary['word']} {summary['sentence']}", 2, style=summary["level"]),
        *page.wrapped(f"What to do: {document['advice']}", _WHOLE),
        Text(),
    ]


def _tiles(page: _Page, tiles: Mapping[str, Mapping[str, Any]], most: int) -> list[Text]:
    """Return the five tiles, each sentence in so many lines at most."""
    lines, indent = [], " " * (_LABEL + 1)
    for name in ("roof", "cistern", "pump", "rain", "controller"):
        tile = tiles[name]
        label, value = f"{tile['label']:{_LABEL}} ", f"{tile['value']:{_VALUE}} "
        # The numbers that the page has beside its gauges.
        marks = ", ".join(mark["label"] for mark in tile.get("marks", ()))
        sentence = f"{tile['sentence']} ({marks})" if marks else tile["sentence"]
        first, *rest = textwrap.wrap(
            sentence, page.width, initial_indent="_" * len(label + value),
            subsequent_indent=indent, break_on_hyphens=False,
        ) or [""]
        style = "alarm" if tile.get("alarm") else tile.get("state", "") or "head"
        lines.append(page.line((label, ""), (value, style), (first[len(label + value):], "")))
        if rest:
            lines += page.wrapped(" ".join(map(str.strip, rest)), most - 1, indent=indent)
        why = tile.get("why", "")
        if why and why not in tile["sentence"]:
            lines += page.wrapped(why, most - 1, indent=indent)
    return lines


def _alarms(
    page: _Page, rows: Sequence[Mapping[str, Any]], advice: str, room: int, *, most: int = 2
) -> list[Text]:
    """Return the alarms in so many lines: causes first, then what follows from them.

    Args:
        page: for the lines.
        rows: the alarms.
        advice: what stands above already.
        room: how many lines there are.
        most: in how many lines at most each sentence of an alarm is.
    """
    present = [row for row in rows if row["over"] is None]
    over = [row for row in rows if row["over"] is not None]
    if not rows or room < 2:
        return []
    lines = [page.line((f"Alarms: {len(present)} now, {len(over)} over", "head"))]
    parts = [_alarm(page, row, advice, most) for row in present]
    parts += [[page.line(
        (f"over   {row['id']}  {row['since_text']} to {row['over_text']}: {row['what']}", "dim")
    )] for row in over]
    for number, part in enumerate(parts):
        left = room - len(lines)
        if len(part) > left - (number < len(parts) - 1):
            hidden = len(parts) - number
            if left > 1 and number < len(present):
                lines += part[:left - 1]
                hidden -= 1
            if hidden:
                lines.append(page.line((f"and {hidden} more", "dim")))
            break
        lines += part
    return lines


def _alarm(page: _Page, row: Mapping[str, Any], said_already: str, most: int) -> list[Text]:
    since = f"{'at least ' if row['since_at_least'] else ''}since {row['since_text']}"
    seen = ", acknowledged" if row["acknowledged"] else ""
    head = [
        (f"{_WORDS[row['level']]}  ", row["level"]), (f"{row['id']}  ", "head"),
        (f"{since}{seen}", ""),
    ]
    if row.get("follows"):
        head.append((f"; follows from {row['follows']}", "dim"))
        if most < _WHOLE:
            return [page.line(*head)]
    lines = [page.line(*head)]
    if row["do"] != said_already:
        lines += page.wrapped(row["do"], most, indent=" " * 7)
    return [*lines, *page.wrapped(row["what"], most, indent=" " * 7, style="dim")]


def _charts(page: _Page, series: Mapping[str, Any]) -> list[Text]:
    """Return the last hours and the next as rows of bars, of what there is anything of."""
    if series.get("now") is None:
        return []
    now, end = series["now"], series["to"]
    columns = (page.width - 9 - _RANGE - 1) // 2
    lines = []
    for name, label in _CHARTS.items():
        rows = [row for row in series["lines"].get(name, []) if row[1] is not None]
        line = ((at, at, greatest) for at, _, greatest, _ in rows)
        past = _columns(line, series["from"], now + 1e-3, columns)
        ahead = _columns(_ahead(name, series), now, end, columns)
        known = [value for value in [*past, *ahead] if value is not None]
        known += [least for _, least, *_ in rows]
        if not known:
            continue
        display = series["display"][name]
        low, high = min(known), max(known)
        decimals = display["decimals"]
        shown = "-".join(
            f"{value * display['factor'] + 0.0:.{decimals}f}" for value in sorted({low, high})
        )
        bars = [_bars(part, low, high, page.bars) for part in (past, ahead)]
        lines.append(page.line(
            (f"{label:8} ", ""), (f"{shown + ' ' + display['unit']:{_RANGE}}", ""),
            (bars[0], ""), ("|", "dim"), (bars[1], "dim"),
        ))
    if not lines:
        return []
    hours = round((now - series["from"]) / 3600)
    title = f"{f'Last {hours} h':{9 + _RANGE}}"
    ahead_text = f"next {round((end - now) / 3600)} h, as expected"
    return [page.line((f"{title:{9 + _RANGE + columns}}|", "head"), (ahead_text, "head")), *lines]


def _ahead(name: str, series: Mapping[str, Any]) -> list[tuple[float, float, float]]:
    """Return what is expected of a line: begin, end and value of each step."""
    if name == "rain":
        return [(begin, end, mean) for begin, end, mean, *_ in series["forecast"]]
    if name == "flow":
        return [(begin, end, flow) for begin, end, flow, _ in series["plan"]]
    if name == "roof":
        return [(begin, end, level) for begin, end, _, level in series["plan"]]
    return []


def _columns(
    steps: Iterable[tuple[float, float, float]], first: float, last: float, columns: int
) -> list[float | None]:
    """Return the greatest value in each of equally long times; None where there is none."""
    found: list[float | None] = [None] * columns
    width = (last - first) / columns
    for begin, end, value in steps:
        column = math.floor((begin - first) / width)
        until = max(column + 1, math.ceil((end - first) / width))
        for at in range(max(0, column), min(columns, until)):
            known = found[at]
            found[at] = value if known is None else max(known, value)
    return found


def _bars(values: Sequence[float | None], low: float, high: float, bars: str) -> str:
    """Return a bar for each value, between the least and the greatest; a blank for none.

    Where all are the same the bars are half as high as they may be, and of nothing the lowest.
    """
    step = (high - low) / (len(bars) - 1)
    constant = bars[len(bars) // 2 if high else 0]
    return "".join(
        " " if value is None else bars[round((value - low) / step)] if step > 0 else constant
        for value in values
    )


def _account(page: _Page, document: Mapping[str, Any], room: int) -> list[Text]:
    account = document["account"]
    rows = [row for row in account["rows"] if row["number"] is not None]
    if not rows:
        return []
    entries = "; ".join(f"{row['label'].lower()} {row['value']}" for row in rows)
    title = f"Water {account['since_text']}, {account['sentence']}"
    return [page.line((title, "head")), *page.wrapped(entries, room - 1, indent="  ")]


def _events(
    page: _Page, document: Mapping[str, Any], room: int, *, most: int = 1
) -> list[Text]:
    events = document["events"][:room - 1]
    if not events:
        return []
    return [
        page.line(("Events", "head")),
        *(
            line for one in events
            for line in page.wrapped(f"{one['at_text']}  {one['what']}", most, indent="  ")
        ),
    ]


def _stop(page: _Page, document: Mapping[str, Any]) -> list[Text]:
    """Return how the pump is stopped and released, and what is wrong with that."""
    stop = document["stop"]
    lines = page.wrapped(stop["warning"], 3, style="error") if stop["warning"] else []
    for what, call in (("stop", stop["call"]), ("release", stop["release"])):
        if call:
            # On a line of its own and whole: the first part of a stop alone would release the pump.
            known = next((
                text for text in (f"{what} the pump: {call}", f"{what}: {call}", call)
                if len(text) <= page.width
            ), f"{what} the pump: see the page or the documentation")
            lines.append(page.line((known, "dim")))
    keys = [name for here, name in (
        ("release_here", "r releases the pump"), ("clear_here", "c clears its fault"),
    ) if stop.get(here)]
    if keys:
        lines.append(page.line(("; ".join(keys), "head")))
    asked = document.get("asked", "")
    return [*lines, *page.wrapped(asked, 8, style="head")] if asked else lines


def run(store: Store, feed: Feed) -> None:
    """Show what is known until q is pressed, or a signal or the end of the terminal comes.

    The space bar turns to the next page, and from the last to the first. Where the pump may be
    released here, or its fault be cleared, r and c do so, once y has confirmed it.

    On a terminal all of it is used, and given back as it was. Where nothing can be drawn over, in
    a file or on a dumb terminal, the document is printed again and again.

    Args:
        store: what is known.
        feed: asks the pump node.
    """
    signals, console = Signals(), Console(highlight=False)
    ascii_only = not console.encoding.lower().startswith("utf")
    color = console.color_system is not None and not console.no_color
    drawn = console.is_terminal and not console.is_dumb_terminal
    document: dict[str, Any] = {"stop": {}}
    charts: dict[str, Any] = {}
    charts_at = shown_at = -math.inf
    before: object = None
    number, begun = 0, time.monotonic()
    release = _Release(feed)

    def parts(width: int, height: int | None) -> list[Group]:
        return pages(document, charts, width, height, color, ascii_only=ascii_only)

    with suppress(InterruptedRun, OSError), _keys() as pressed, (
        Live(console=console, screen=True, auto_refresh=False) if drawn else nullcontext()
    ) as live:
        while (keys := pressed(_FIRST_S if before is None else _LOOK_S)) is not None:
            if b"q" in keys.lower():
                break
            turned = keys.count(b" ")
            release.press(keys, document["stop"])
            signals.check()
            now = time.monotonic()
            document = {**document_of(store, now), "asked": release.asks}
            unknown = document["mode"] == "none" or document["tiles"]["roof"]["number"] is None
            if unknown and now - begun < _FOUND_S:
                continue  # that it is not known is said when that is known
            if now - charts_at >= _CHARTS_S:
                charts, charts_at = _series(store), now
            size = console.size
            if live is None:
                if now - shown_at >= _PRINT_S:
                    console.print(*parts(size.width, None), end="\n\n")
                    shown_at = now
            elif turned or before != (document, charts, size):
                found = parts(size.width, size.height)
                # As many pages as there are now: alarms come and go.
                number = min(number, len(found) - 1)
                number = (number + turned) % len(found)
                live.update(found[number], refresh=True)
            before = (document, charts, size)


def _series(store: Store) -> dict[str, Any]:
    """Return the charts of the last 12 h; of a run that is younger, of fewer hours."""
    series = series_of(store, _HOURS)
    begins = [rows[0][0] for rows in series["lines"].values() if rows]
    if not begins or series["now"] is None:
        return series
    known = (series["now"] - min(begins)) / 3600
    hours = next(one for one in (1.0, 3.0, 6.0, math.inf) if known <= one)
    return series if hours > 6.0 else series_of(store, hours)


class _Release:
    """Releases the pump, and clears its fault, after a confirmation.

    Attributes:
        asks: what stands at the foot: a question, or what came of it; empty for nothing.
    """

    _KEYS: ClassVar = {b"r": ("release", "release_here", "release_then"),
                       b"c": ("clear", "clear_here", "clear_then")}

    def __init__(self, feed: Feed) -> None:
        self.asks = ""
        self._feed, self._action = feed, ""

    def press(self, keys: bytes, stop: Mapping[str, Any]) -> None:
        """Take the keys that were pressed, where the pump is so (as the document has it)."""
        for key in (keys[i:i + 1] for i in range(len(keys))):
            if key in self._KEYS and stop.get(self._KEYS[key][1]):
                self._action, _, then = self._KEYS[key]
                self.asks = f"{self._action.capitalize()} the pump? {stop[then]} y: yes, n: no"
            elif self._action:
                action, self._action, self.asks = self._action, "", ""
                if key.lower() == b"y":
                    try:
                        self.asks = self._feed.ask(action)
                    except StopFailedError as failure:
                        self.asks = str(failure)


@contextmanager
def _keys() -> Iterator[Callable[[float], bytes | None]]:
    """Take single keys from the terminal, and give it back as it was.

    Yields:
        What waits for so long (s), less where a signal or a key comes, and returns the keys that
        were pressed; None where the terminal is gone.
    """
    waking, woken = os.pipe()
    for end in (waking, woken):
        os.set_blocking(end, False)
    wakes = signal.set_wakeup_fd(woken, warn_on_full_buffer=False)
    resized = signal.signal(signal.SIGWINCH, lambda *_: None)
    keyboard = sys.stdin.fileno() if sys.stdin.isatty() else None
    settings = None if keyboard is None else termios.tcgetattr(keyboard)

    def pressed(seconds: float) -> bytes | None:
        heard = [waking] if keyboard is None else [waking, keyboard]
        ready, _, _ = select.select(heard, [], [], seconds)
        if waking in ready:
            os.read(waking, 1000)
        if keyboard not in ready:
            return b""
        return os.read(keyboard, 1000) or None

    try:
        if keyboard is not None:
            tty.setcbreak(keyboard)
        yield pressed
    finally:
        if keyboard is not None and settings is not None:
            with suppress(termios.error):  # the terminal is gone
                termios.tcsetattr(keyboard, termios.TCSADRAIN, settings)
        signal.signal(signal.SIGWINCH, resized)
        signal.set_wakeup_fd(wakes)
        os.close(waking)
        os.close(woken)
