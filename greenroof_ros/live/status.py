"""How a live site is: one line on a terminal, and lines of what changed elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Collection, Mapping
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

# Often enough for an eye, seldom enough to cost nothing.
_INTERVAL_S = 0.25
# How long a text must stand before it is a line of a log (s): on the way to being well, or not, a
# node says one thing after the other.
_SETTLED_S = 3.0
# How long what is not well is what is waited for (s): after the start, and after all nodes are
# there, since inputs count after 10 s by default. How long such a text must stand (s).
_START_S, _INPUTS_S, _WAITED_S = 60.0, 30.0, 1.0
# What the pump node says of the hold that bringup tells it.
_OF_BRINGUP = "supervisor"


class Status:
    """Says on standard error how the site is.

    On a terminal levels, command, pump and what is not well stand in one line, which is redrawn;
    elsewhere, as in systemd's journal, what is not well is a line when it begins and when it ends.
    At the start much is not well that will be in a moment; then a line says what is waited for.
    """

    def __init__(self) -> None:
        """Know nothing yet."""
        self._console = Console(stderr=True, soft_wrap=True)
        self._live: Live | None = None
        self._shown = 0.0
        self._starts_until = time.monotonic() + _START_S
        self._starting, self._all_here = True, False
        self._waits, self._waits_since, self._said_waits = "", 0.0, ""
        # By node and part: what stands; and what was seen, since when, and not said yet.
        self._troubles: dict[tuple[str, str], str] = {}
        self._changes: dict[tuple[str, str], tuple[str, float]] = {}

    def __enter__(self) -> Status:
        """Show the line, where there is a terminal."""
        if sys.stderr.isatty():
            self._live = Live(console=self._console, auto_refresh=False)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the line as it stands."""
        if self._live is not None:
            self._live.stop()

    def say(self, text: str) -> None:
        """Print a line, above the status line where there is one."""
        self._console.print(text, markup=False, highlight=False)

    def update(self, reports: Mapping[str, Mapping[str, Any]], hold: str) -> None:
        """Show how the nodes are.

        Args:
            reports: the last of each node.
            hold: why the pump may not run; empty where it may.
        """
        now = time.monotonic()
        if now - self._shown < _INTERVAL_S:
            return
        self._shown = now
        troubles = troubles_of(reports, hold)
        if self._starting:
            self._say_start(reports, hold, troubles, now)
        else:
            self._say_changes(troubles, reports.keys(), now)
        if self._live is not None:
            line = "; ".join([values_of(reports), *troubles.values()])
            self._live.update(Text(line, no_wrap=True, overflow="ellipsis"), refresh=True)

    def all_are_here(self) -> None:
        """Say that all nodes are there; what they wait for then comes soon."""
        self.say("all nodes are here")
        self._all_here = True
        self._starts_until = time.monotonic() + _INPUTS_S

    def _say_start(
        self, reports: Mapping[str, Mapping[str, Any]], hold: str,
        troubles: Mapping[tuple[str, str], str], now: float,
    ) -> None:
        """Print what is waited for; that the start is over, when all is well or it took long."""
        if (self._all_here and not troubles) or now > self._starts_until:
            self._starting = False
            if not hold:
                self.say(f"running: {values_of(reports)}")
            return
        if not troubles:
            return
        nodes = sorted({node for node, _ in troubles if node})
        waits = hold or f"what {', '.join(nodes)} read must be good for a while (recovery_time)"
        if waits != self._waits:
            self._waits, self._waits_since = waits, now
        elif waits != self._said_waits and now - self._waits_since > _WAITED_S:
            self._said_waits = waits
            self.say(f"waiting: {waits}")

    def _say_changes(
        self, troubles: Mapping[tuple[str, str], str], nodes: Collection[str], now: float
    ) -> None:
        """Print what is not well when it begins, and when it ends."""
        for about in troubles.keys() | self._troubles.keys() | self._changes.keys():
            text = troubles.get(about, "")
            # What a node said that is just started again may still be so.
            silent = not text and about[0] and about[0] not in nodes
            if silent or text == self._troubles.get(about, ""):
                self._changes.pop(about, None)
                continue
            seen, since = self._changes.get(about, (None, now))
            if seen != text:
                since = now
            self._changes[about] = (text, since)
            if now - since < _SETTLED_S:
                continue
            del self._changes[about]
            if text:
                self._troubles[about] = text
                self.say(f"warning: {text}")
            else:
                self.say(f"over: {self._troubles.pop(about)}")


def troubles_of(
    reports: Mapping[str, Mapping[str, Any]], hold: str
) -> dict[tuple[str, str], str]:
    """Return what is not well, by the node that says so, none for bringup, and the part."""
    troubles = {("", "hold"): f"the pump is held: {hold}"} if hold else {}
    for node, report in reports.items():
        for part, (level, message) in report.get("diagnoses", {}).items():
            if level != "OK" and part != _OF_BRINGUP:
                troubles[node, part] = f"{node}: {message}"
        for text in report.get("warnings", ()):
            troubles[node, text] = f"{node}: {text}"
    return troubles


def values_of(reports: Mapping[str, Mapping[str, Any]]) -> str:
    """Return levels, command and pump in a line, as far as the nodes have said them."""
    values: dict[str, Any] = {}
    for report in reports.values():
        values.update(report)
    parts = []
    for name, key, places in (("cistern", "cistern_level", 3), ("roof", "roof_level", 4)):
        level = values.get(key)
        parts.append(f"{name} {level:.{places}f} m" if level is not None else f"{name} unknown")
    if values.get("command") is not None:
        parts.append(f"command {values['command']:.3f}")
    if "pump" in values:
        parts.append(f"pump {values['pump']}")
    return ", ".join(parts)
