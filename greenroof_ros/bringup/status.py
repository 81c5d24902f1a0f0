"""How a live site is: what is missing at the start, then a line on a terminal or in a journal."""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

from greenroof_ros.experiment.incidents import IncidentLog, misses_forecast

# Often enough for an eye, seldom enough to cost nothing.
_INTERVAL_S = 0.25
# How long a text must stand before it is a line of a log (s): on the way to being well, or not, a
# node says one thing after the other. The same for the list of what is missing.
_SETTLED_S, _LISTED_S = 3.0, 1.0
# How long what has not come yet is late, and not lost (s). Once nothing is missing, inputs may need
# so long until they count (s), by default 10 s.
_LATE_S, _INPUTS_S = 60.0, 30.0
_ALL_HERE = "nothing is missing; inputs must stay good for a few seconds before they count"
# What the pump node says of the hold that bringup gives it.
_OF_BRINGUP = "supervisor"
# Parts of nodes that are not well because of something else, as a rule.
_INPUTS = ("levels", "command", "inputs")
_FOLLOWERS = (*_INPUTS, "delivery", "pump")
# For these the end of the start waits a while, once nothing is missing that the pump needs.
_AWAITED = (*_INPUTS, "forecast")


@dataclass(frozen=True)
class Expected:
    """Something that is expected at the start of a site.

    Attributes:
        what: it is.
        where: it comes from.
        to_do: while it does not come.
        needed: whether the pump stands without it.
        well: levels of the diagnosis at which it is there.
    """

    what: str
    where: str
    to_do: str
    needed: bool = True
    well: tuple[str, ...] = ("OK",)


class Status:
    """Says on standard error how the site is.

    At the start it lists what is missing, a line each, and again whenever that has changed. After
    it, levels, command, pump and what is not well are redrawn on a terminal; elsewhere, as in
    systemd's journal, what is not well is a line when it begins and when it ends. A loss has its
    lines as an incident, and what follows from it has none.

    Attributes:
        starting: not all has come yet.
    """

    def __init__(self, expected: Mapping[tuple[str, str], Expected]) -> None:
        """Know nothing yet.

        Args:
            expected: what is missing until its node says that it is there, by node and part.
        """
        self.starting = True
        self._expected = expected
        self._console = Console(stderr=True, soft_wrap=True)
        self._live: Live | None = None
        self._shown = -math.inf
        self._late_until = time.monotonic() + _LATE_S
        self._complete_at = math.inf
        self._lost_at = -math.inf
        # What is missing: the list that is said, and another one since when.
        self._listed: list[str] | None = None
        self._other: tuple[list[str], float] = ([], 0.0)
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

    @property
    def late(self) -> bool:
        """Whether what has not come yet may still come, and is not lost."""
        return self.starting and time.monotonic() < self._late_until

    def say(self, text: str) -> None:
        """Print a line, above the status line where there is one."""
        self._console.print(text, markup=False, highlight=False)

    def update(
        self, reports: Mapping[str, Mapping[str, Any]], hold: str, log: IncidentLog
    ) -> None:
        """Show how the nodes are.

        Args:
            reports: the last of each node.
            hold: why the pump may not run; empty where it may.
            log: of what was lost.
        """
        now = time.monotonic()
        if now - self._shown < _INTERVAL_S:
            return
        self._shown = now
        if log.lasting:
            self._lost_at = now
        # Inputs that come back count after a while: that follows from the loss, too.
        troubles = troubles_of(reports, hold, lasting=now - self._lost_at < _INPUTS_S)
        lines = list(troubles.values())
        if self.starting:
            lines = self._say_missing(reports, hold, troubles, now)
        else:
            own = {about: text for about, text in troubles.items() if not log.keeps(*about)}
            self._say_changes(own, reports.keys(), now)
        if self._live is not None:
            text = Text("\n".join([values_of(reports), *lines]), no_wrap=True, overflow="ellipsis")
            self._live.update(text, refresh=True)

    def _say_missing(
        self, reports: Mapping[str, Mapping[str, Any]], hold: str,
        troubles: Mapping[tuple[str, str], str], now: float,
    ) -> list[str]:
        """Print what is missing where that has changed, and the end of the start; return it."""
        missing = self._missing(reports)
        lines = list(missing) or ([f"the pump is held: {hold}"] if hold else [])
        complete = not (hold or any(missing.values()))
        if not complete:
            self._complete_at = math.inf
        elif self._complete_at == math.inf:
            self._complete_at = now
        awaited = any(part in _AWAITED for _, part in troubles)
        if complete and (not awaited or now - self._complete_at > _INPUTS_S):
            self.starting = False
            self.say(f"running: {', '.join(_levels_of(_values(reports)))}")
            return []
        lines = lines or [_ALL_HERE]
        if [_without_numbers(line) for line in lines] != self._other[0]:
            self._other = ([_without_numbers(line) for line in lines], now)
        if self._listed is None or (
            self._other[0] != self._listed and now - self._other[1] > _LISTED_S
        ):
            title = "missing:" if self._listed is None else "still missing:"
            self._listed = self._other[0]
            if self._live is None:
                self.say(
                    _ALL_HERE if lines == [_ALL_HERE]
                    else "\n".join([title, *(f"  {line}" for line in lines)])
                )
        return [line if line == _ALL_HERE else f"missing: {line}" for line in lines]

    def _missing(self, reports: Mapping[str, Mapping[str, Any]]) -> dict[str, bool]:
        """Return what is expected and has not come, a line each, and whether it is needed."""
        lines = {}
        for (node, part), it in self._expected.items():
            level, message, _ = reports.get(node, {}).get("diagnoses", {}).get(part, ("", "", ""))
            if level not in it.well:
                why = message or f"nothing yet from {it.where}"
                to_do = it.to_do if message else f"if it does not come, {it.to_do}"
                lines[f"{it.what}: {why}; {to_do}"] = it.needed
        return lines

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


def _without_numbers(text: str) -> str:
    return re.sub(r"[\d.]+", "", text)


def troubles_of(
    reports: Mapping[str, Mapping[str, Any]], hold: str, *, lasting: bool = False
) -> dict[tuple[str, str], str]:
    """Return what is not well, by the node that says so, none for bringup, and the part.

    What follows from something else is left out: while something is lost or held; and what another
    node or part says in the same words, or the pump of itself beside the reason.

    Args:
        reports: the last of each node.
        hold: why the pump may not run; empty where it may.
        lasting: something is lost.
    """
    troubles = {("", "hold"): f"the pump is held: {hold}"} if hold else {}
    said = set()
    for node, report in reports.items():
        bad = {
            part: message for part, (level, message, _) in report.get("diagnoses", {}).items()
            if level != "OK" and part != _OF_BRINGUP
        }
        for part, message in sorted(bad.items(), key=lambda one: one[0] == "pump"):
            follows = (part in _FOLLOWERS or misses_forecast(node, part)) and (
                lasting or bool(hold) or message in said
            )
            if follows or (part == "pump" and bad.keys() - {"pump", "drive file"}):
                continue
            said.add(message)
            troubles[node, part] = f"{node}: {message}"
        for text in report.get("warnings", ()):
            troubles[node, text] = f"{node}: {text}"
    return troubles


def values_of(reports: Mapping[str, Mapping[str, Any]]) -> str:
    """Return levels, command and pump in a line, as far as the nodes have said them."""
    values = _values(reports)
    parts = _levels_of(values)
    if values.get("command") is not None:
        parts.append(f"command {values['command']:.3f}")
    if "pump" in values:
        parts.append(f"pump {values['pump']}")
    return ", ".join(parts)


def _values(reports: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return what the nodes said last, by its name."""
    return {name: value for report in reports.values() for name, value in report.items()}


def _levels_of(values: Mapping[str, Any]) -> list[str]:
    levels = []
    for name, key, places in (("cistern", "cistern_level", 3), ("roof", "roof_level", 4)):
        level = values.get(key)
        levels.append(f"{name} unknown" if level is None else f"{name} {level:.{places}f} m")
    return levels
