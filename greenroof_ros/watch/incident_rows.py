"""Incidents of a recorded run as alarms: each stands from its start to its end."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text
from greenroof_ros.experiment.incidents import INCIDENTS, PROCESS, Incident, read_incidents
from greenroof_ros.experiment.summary import SUMMARY
from greenroof_ros.graph.supervision import PUMP
from greenroof_ros.watch.advice import FOREIGN, OTHER, advise
from greenroof_ros.watch.words import plain

_TEXT = 500


@dataclass(frozen=True)
class Dated:
    """An incident with its times as the recording has them (s since 1970).

    Attributes:
        node: that says so, or that was lost.
        part: of it; empty for the node itself.
        cause: in words.
        began: when.
        ended: when; None where it lasted to the end.
    """

    node: str
    part: str
    cause: str
    began: float
    ended: float | None

    def stands(self, now: float) -> bool:
        """Whether it has begun at a time, and is not over."""
        return self.began <= now and (self.ended is None or now < self.ended)

    @property
    def of_pump(self) -> bool:
        """Whether what the pump does is not known while it stands."""
        return self.part == "drive" or (self.node, self.part) == (PUMP, "")

    def row(self, now: float, say_time: Callable[[float], str]) -> dict[str, Any]:
        """Return it as an alarm of :meth:`greenroof_ros.watch.alarms.Alarms.rows`."""
        over = None if self.stands(now) else self.ended
        do = advise(f"/{self.node}", self.node, self.part, self.cause)
        return {
            "id": f"{self.node}: {self.part}" if self.part else self.node, "level": "error",
            "what": plain(self.cause, _TEXT), "do": do, "plain": do not in (FOREIGN, OTHER),
            "since": self.began, "since_at_least": False, "since_text": say_time(self.began),
            "acknowledged": False, "over": over,
            "over_text": "" if over is None else say_time(over),
            "follows": None, "recorded": True,
        }


def read_dated(bag: Path) -> list[Dated]:
    """Return the incidents of a run whose bag is read, in the order in which they began.

    They stand in a file of their own, and in the summary where that could not be written.

    Raises:
        ValueError: they cannot be read, or not when they were.
    """
    directory = bag.parent
    try:
        found = read_incidents(directory)
        if not (directory / SUMMARY).exists():
            return _all_dated(found, {})
        summary = json.loads(read_text(directory / SUMMARY))
        found = found or [Incident(**one) for one in summary.get("incidents", ())]
        return _all_dated(found, summary)
    except (OSError, ConfigurationError, KeyError, TypeError, AttributeError) as error:
        why = getattr(error, "strerror", None) or error
        raise ValueError(f"{directory / INCIDENTS} cannot be shown ({why})") from error


def _all_dated(incidents: Sequence[Incident], summary: Mapping[str, Any]) -> list[Dated]:
    """Return incidents with their times: by ticks where the site is simulated, else by the wall."""
    start, tau = 0.0, 0.0
    if any(one.began_tick is not None for one in incidents):
        start = datetime.fromisoformat(summary["start"]).timestamp()
        tau = float(summary["tau_s"])

    def at(tick: int | None, wall: str | None) -> float | None:
        if tick is not None:
            return start + tick * tau
        return None if wall is None else datetime.fromisoformat(wall).timestamp()

    dated = []
    for one in incidents:
        began = at(one.began_tick, one.began)
        assert began is not None
        part = "" if one.part == PROCESS else one.part
        dated.append(Dated(one.node, part, one.cause, began, at(one.ended_tick, one.ended)))
    return sorted(dated, key=lambda one: one.began)
