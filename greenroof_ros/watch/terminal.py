"""The document in a terminal of 80 by 24 or more: the same facts and words as on the page."""

from __future__ import annotations

import math
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from typing import Any, ClassVar

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.padding import Padding
from rich.segment import Segment, SegmentLines
from rich.style import Style
from rich.table import Table
from rich.text import Text

from greenroof_ros.common.processes import InterruptedRun, Signals
from greenroof_ros.graph.looker import StopFailedError
from greenroof_ros.watch.document import document as document_of
from greenroof_ros.watch.document import series as series_of
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.store import Store
from greenroof_ros.watch.words import SPACE

# How often the document and the charts are made (s).
_LOOK_S, _CHARTS_S = 0.5, 2.0
# How often before there is anything to show (s).
_FIRST_S = 0.1
# How often all is printed if nothing can be drawn over (s): in a file, or on a dumb terminal.
_PRINT_S = 10.0
# How long the first values of a running graph may take (s).
_FOUND_S = 3.0
_HOURS = 12.0
# The least width that is drawn for; a narrower terminal shows the left part.
_LEAST_WIDTH = 40
_LABEL, _VALUE, _RANGE = 13, 15, 18
# More lines than any document has.
_ENDLESS = 1_000_000
_BARS, _ASCII_BARS = "▁▂▃▄▅▆▇█", "_.:-=+*#"
_WORDS = {"error": "Alarm", "warn": "Warning", "stale": "Not heard"}
_CHARTS = {"roof": "Roof", "cistern": "Cistern", "rain": "Rain", "flow": "Pump"}
# Words say everything; colours repeat it, and can be distinguished without seeing red or green.
_ALARM, _HEAD, _DIM = "bold bright_red", "bold", "dim"
_STYLES = {
    "error": _ALARM, "stale": "bold bright_magenta", "warn": "bold yellow",
    "ok": "bold bright_blue", "alarm": _ALARM, "fault": _ALARM,
    "held": "bold yellow", "low": "yellow", "high": "yellow", "unknown": "bright_magenta",
}


def pages(
    document: Mapping[str, Any], series: Mapping[str, Any], console: Console, height: int | None
) -> list[SegmentLines]:
    """Return the document as pages for a terminal, the most important parts first.

    Args:
        document: from :func:`greenroof_ros.watch.document.document`.
        series: from :func:`greenroof_ros.watch.document.series`.
        console: gives the width and the characters that can be shown.
        height: of the terminal (lines); None for a single page, if pages cannot be turned.
    """
    options = console.options.update(width=max(console.width, _LEAST_WIDTH), height=None)
    parts = _parts(document, series, options.max_width, ascii_only=options.ascii_only)
    fit = _ENDLESS if height is None else max(1, height - 1)
    lines: list[list[Segment]] = []
    for part in parts:
        block, room = console.render_lines(part, options, pad=False), fit - len(lines) % fit
        if isinstance(part, Group) and room < len(block) <= fit:
            lines += [[]] * room  # the block stays on one page
        lines += block
    if options.ascii_only:
        lines = [[Segment(_ascii(part.text), part.style) for part in line] for line in lines]
    if height is None:
        return [SegmentLines(lines, new_lines=True)]
    begins, drawn = range(0, len(lines), fit), []
    for number, begin in enumerate(begins, 1):
        seen = lines[begin:begin + fit]
        keys = f"page {number} of {len(begins)}; space turns the page, q quits"
        filled = [*seen, *[[]] * (fit - len(seen)), [Segment(keys, Style.parse(_DIM))]]
        drawn.append(SegmentLines(filled, new_lines=True))
    return drawn


def _ascii(text: str) -> str:
    """Return a text in ASCII, as long as before: m³ is m3, other characters are ``?``."""
    plain = text.replace("³", "3").replace(SPACE, " ")
    return plain.encode("ascii", "replace").decode()


def _parts(
    document: Mapping[str, Any], series: Mapping[str, Any], width: int, *, ascii_only: bool
) -> Iterator[RenderableType]:
    """Yield the parts of the document, the most important first."""
    summary = document["tiles"]["summary"]
    top = Table.grid(expand=True)
    top.add_column()
    top.add_column(justify="right")
    where = f"{document['heading']} {document['namespace']}".strip()
    top.add_row(Text(where, _HEAD), Text(document["time"]["text"]))
    yield top
    yield Text(f"{summary['word']} {summary['sentence']}", _STYLES[summary["level"]])
    yield Text(f"What to do: {document['advice']}")
    yield from _stop(document, width)
    yield Text()
    yield _tiles(document["tiles"])
    yield from (Text(note, _DIM) for note in document["notes"])
    charts = _charts(series, width, _ASCII_BARS if ascii_only else _BARS)
    for part in (
        _alarms(document), [Group(*charts)] if charts else [], _account(document["account"]),
        _events(document["events"]),
    ):
        if part:
            yield Text()
            yield from part


def _tiles(tiles: Mapping[str, Mapping[str, Any]]) -> Table:
    table = Table.grid(padding=(0, 1, 0, 0))
    table.add_column(width=_LABEL)
    for name in ("roof", "cistern", "pump", "rain", "controller"):
        tile = tiles[name]
        # The numbers beside the gauges of the page.
        marks = ", ".join(mark["label"] for mark in tile.get("marks", ()))
        why = tile.get("why", "")
        table.add_row(tile["label"], Text.assemble(
            (f"{tile['value']:{_VALUE}} ", _ALARM if tile.get("alarm") else
             _STYLES.get(tile["state"], _HEAD)),
            tile["sentence"], f" ({marks})" if marks else "",
            f"\n{why}" if why and why not in tile["sentence"] else "",
        ))
    return table


def _alarms(document: Mapping[str, Any]) -> list[RenderableType]:
    """Return the alarms: causes first, then what follows from them, then what is over."""
    rows = document["alarms"]
    present = [row for row in rows if row["over"] is None]
    if not rows:
        return []
    return [
        Text(f"Alarms: {len(present)} now, {len(rows) - len(present)} over", _HEAD),
        *(part for row in present for part in _alarm(row, document["advice"])),
        *(Text(
            f"over   {row['id']}  {row['since_text']} to {row['over_text']}: {row['what']}", _DIM
        ) for row in rows if row["over"] is not None),
    ]


def _alarm(row: Mapping[str, Any], said_already: str) -> Iterator[RenderableType]:
    since = f"since {'before ' if row['since_at_least'] else ''}{row['since_text']}"
    yield Text.assemble(
        (f"{_WORDS[row['level']]}  ", _STYLES[row["level"]]), (f"{row['id']}  ", _HEAD),
        since, ", acknowledged" if row["acknowledged"] else "",
        (f"; follows from {row['follows']}" if row["follows"] else "", _DIM),
    )
    # What to do about an alarm that follows is shown with its cause.
    if row["do"] != said_already and not row["follows"]:
        yield Padding(Text(row["do"]), (0, 0, 0, 7))
    yield Padding(Text(row["what"], _DIM), (0, 0, 0, 7))


def _charts(series: Mapping[str, Any], width: int, bars: str) -> list[RenderableType]:
    """Return the last and the next hours as rows of bars, without lines that have no values."""
    if series.get("now") is None:
        return []
    now, end = series["now"], series["to"]
    columns = (width - 9 - _RANGE - 1) // 2
    lines: list[RenderableType] = []
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
        lines.append(Text.assemble(
            f"{label:8} {shown + ' ' + display['unit']:{_RANGE}}", _bars(past, low, high, bars),
            (f"|{_bars(ahead, low, high, bars)}", _DIM), no_wrap=True,
        ))
    if not lines:
        return []
    hours = round((now - series["from"]) / 3600)
    title = f"{f'Last {hours} h':{9 + _RANGE + columns}}|next {round((end - now) / 3600)} h"
    return [Text(f"{title}, as expected", _HEAD, no_wrap=True), *lines]


def _ahead(name: str, series: Mapping[str, Any]) -> list[tuple[float, float, float]]:
    """Return the expected steps of a line: begin, end and value of each."""
    steps, place = {
        "rain": ("forecast", 2), "flow": ("plan", 2), "roof": ("plan", 3),
    }.get(name, ("", 0))
    return [(row[0], row[1], row[place]) for row in series.get(steps, ())]


def _columns(
    steps: Iterable[tuple[float, float, float]], first: float, last: float, columns: int
) -> list[float | None]:
    """Return the greatest value in each of some equal periods; None if there is none."""
    greatest: list[float | None] = [None] * columns
    width = (last - first) / columns
    for begin, end, value in steps:
        column = math.floor((begin - first) / width)
        until = max(column + 1, math.ceil((end - first) / width))
        for at in range(max(0, column), min(columns, until)):
            known = greatest[at]
            greatest[at] = value if known is None else max(known, value)
    return greatest


def _bars(values: Sequence[float | None], low: float, high: float, bars: str) -> str:
    """Return a bar for each value, between the least and the greatest; a blank for none.

    If all values are the same, the bars have half the height; if all are 0, the least.
    """
    step = (high - low) / (len(bars) - 1)
    constant = bars[len(bars) // 2 if high else 0]
    return "".join(
        " " if value is None else bars[round((value - low) / step)] if step > 0 else constant
        for value in values
    )


def _account(account: Mapping[str, Any]) -> list[RenderableType]:
    entries = "; ".join(
        f"{row['label'].lower()} {row['value']}" for row in account["rows"]
        if row["number"] is not None
    )
    title = ", ".join(filter(None, (f"Water {account['since_text']}", account["sentence"])))
    return [Text(title, _HEAD), Padding(Text(entries), (0, 0, 0, 2))] if entries else []


def _events(events: Sequence[Mapping[str, Any]]) -> list[RenderableType]:
    lines = (Text(f"{event['at_text']}  {event['what']}") for event in events)
    return [Text("Events", _HEAD), Padding(Group(*lines), (0, 0, 0, 2))] if events else []


def _stop(document: Mapping[str, Any], width: int) -> Iterator[Text]:
    """Yield a warning about the pump's stop, if any, and how to stop and release the pump."""
    stop = document["stop"]
    if stop["warning"]:
        yield Text(stop["warning"], _ALARM)
    for what, call in (("stop", stop["call"]), ("release", stop["release"])):
        if call:
            # In full on one line.
            yield Text(next((
                text for text in (f"{what} the pump: {call}", f"{what}: {call}", call)
                if len(text) <= width
            ), f"{what} the pump: see the page or the documentation"), _DIM)
    keys = [name for here, name in (
        ("release_here", "r releases the pump"), ("clear_here", "c clears its fault"),
    ) if stop[here]]
    yield from (Text(said, _HEAD) for said in ("; ".join(keys), document.get("asked")) if said)


def run(store: Store, feed: Feed) -> None:
    """Show the document until q is pressed, a signal comes, or the terminal is closed.

    The space bar turns to the next page, and from the last to the first. If the pump may be
    released here, or its fault cleared, r and c do so after y has confirmed it.

    The whole terminal is used, and restored at the end. If nothing can be drawn over, in a file or
    on a dumb terminal, the document is printed again and again.

    Args:
        store: state of the graph.
        feed: asks the pump node.
    """
    signals, console = Signals(), Console(highlight=False)
    if console.no_color:  # not even bold
        console = Console(highlight=False, color_system=None)
    drawn = console.is_terminal and not console.is_dumb_terminal
    charts: dict[str, Any] = {}
    charts_at = shown_at = -math.inf
    before: object = None
    number, begun = 0, time.monotonic()
    release = _Release(feed)

    with suppress(InterruptedRun, OSError), _keys() as pressed, (
        Live(console=console, screen=True, auto_refresh=False) if drawn else nullcontext()
    ) as live:
        while (keys := pressed(_FIRST_S if before is None else _LOOK_S)) is not None:
            if b"q" in keys.lower():
                break
            turned = keys.count(b" ")
            signals.check()
            now = time.monotonic()
            document = document_of(store, now)
            unknown = document["mode"] == "none" or document["tiles"]["roof"]["number"] is None
            if unknown and now - begun < _FOUND_S:
                continue  # too early to say that it is not known
            release.press(keys, document["stop"])
            document["asked"] = release.asks
            if now - charts_at >= _CHARTS_S:
                charts, charts_at = _series(store), now
            size = console.size
            if live is None:
                if keys or now - shown_at >= _PRINT_S:
                    console.print(*pages(document, charts, console, None), "")
                    shown_at = now
            elif turned or before != (document, charts, size):
                there = pages(document, charts, console, size.height)
                # The number of pages changes: alarms come and go.
                number = (min(number, len(there) - 1) + turned) % len(there)
                live.update(there[number], refresh=True)
            before = (document, charts, size)


def _series(store: Store) -> dict[str, Any]:
    """Return the charts of the last 12 h, or of fewer hours if the run is younger."""
    series = series_of(store, _HOURS)
    begins = [rows[0][0] for rows in series["lines"].values() if rows]
    if not begins or series["now"] is None:
        return series
    known = (series["now"] - min(begins)) / 3600
    hours = next(most for most in (1.0, 3.0, 6.0, math.inf) if known <= most)
    return series if hours > 6.0 else series_of(store, hours)


class _Release:
    """Releases the pump, and clears its fault, after a confirmation.

    Attributes:
        asks: the text to show: a question, or its result; empty for nothing.
    """

    _KEYS: ClassVar = {
        b"r": ("release", "Release the pump?", "release_here", "release_then"),
        b"c": ("clear", "Clear the fault?", "clear_here", "clear_then"),
    }

    def __init__(self, feed: Feed) -> None:
        self.asks = ""
        self._feed, self._key = feed, b""

    def press(self, keys: bytes, stop: Mapping[str, Any]) -> None:
        """Take the pressed keys; ``stop`` is the entry of the document.

        Keys that come together with the key that asks are no answer: nobody has read the question.
        An answer does not count either if the question would be another one by now.
        """
        for key in (keys[i:i + 1] for i in range(len(keys))):
            if question := self._question(key, stop):
                self._key, self.asks = key, question
                return
            if self._key:
                before, asked, self._key, self.asks = self.asks, self._key, b"", ""
                if key.lower() != b"y":
                    continue
                if self._question(asked, stop) != before:
                    self.asks = "Nothing was done: the situation has changed meanwhile."
                    continue
                try:
                    self.asks = self._feed.ask(self._KEYS[asked][0])
                except StopFailedError as failure:
                    self.asks = str(failure)

    def _question(self, key: bytes, stop: Mapping[str, Any]) -> str:
        """Return the question that a key asks in this state of the pump; empty if it asks none."""
        _, title, here, then = self._KEYS.get(key, ("", "", "", ""))
        return f"{title} {stop[then]} y: yes, n: no" if stop.get(here) else ""


@contextmanager
def _keys() -> Iterator[Callable[[float], bytes | None]]:
    """Take single keys from the terminal, and restore it at the end.

    Yields:
        A function that waits for this long (s), less if a key comes, and returns the pressed keys;
        None if the terminal is gone.
    """
    keyboard = sys.stdin.fileno() if sys.stdin.isatty() else None

    def pressed(seconds: float) -> bytes | None:
        ready, _, _ = select.select([] if keyboard is None else [keyboard], [], [], seconds)
        return os.read(ready[0], 1000) or None if ready else b""

    if keyboard is None:
        yield pressed
        return
    settings = termios.tcgetattr(keyboard)
    try:
        tty.setcbreak(keyboard)
        yield pressed
    finally:
        with suppress(termios.error):  # the terminal is gone
            termios.tcsetattr(keyboard, termios.TCSADRAIN, settings)
