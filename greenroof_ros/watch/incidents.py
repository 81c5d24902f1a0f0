"""Reads the files beside a recorded bag: the controller's name, and the incidents of the run."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text
from greenroof_ros.experiment.incidents import INCIDENTS, PROCESS, Incident, read_incidents
from greenroof_ros.experiment.summary import SUMMARY
from greenroof_ros.watch.alarms import Alarm
from greenroof_ros.watch.registry import ERROR, Trouble
from greenroof_ros.watch.words import plain


def read_beside(bag: Path) -> tuple[str, list[Alarm], str]:
    """Return a recorded run's controller, its incidents in the order of begin, and what is wrong.

    Incidents are in a file of their own, or in the summary if that file could not be written.
    They are dated by ticks if the site is simulated, otherwise by wall time.
    """
    directory, controller = bag.parent, ""
    try:
        path = directory / SUMMARY
        summary = json.loads(read_text(path)) if path.exists() else {}
        controller = plain(str(summary.get("controller", "")))
        incidents = read_incidents(directory)
        incidents = incidents or [Incident(**entry) for entry in summary.get("incidents", ())]
        start, tau = 0.0, 0.0
        if any(incident.began_tick is not None for incident in incidents):
            start = datetime.fromisoformat(summary["start"]).timestamp()
            tau = float(summary["tau_s"])
        alarms = [_alarm_of(incident, start, tau) for incident in incidents]
        return controller, sorted(alarms, key=lambda alarm: alarm.since), ""
    except (OSError, ConfigurationError, ValueError, KeyError, TypeError, AttributeError) as error:
        why = getattr(error, "strerror", None) or error
        return controller, [], f"{directory / INCIDENTS} cannot be shown ({why})."


def _alarm_of(incident: Incident, start: float, tau: float) -> Alarm:
    """Return an incident as an alarm, by the run's start (s since 1970) and its tick (s)."""
    def at(tick: int | None, wall: str) -> float:
        return datetime.fromisoformat(wall).timestamp() if tick is None else start + tick * tau

    whole, ended = incident.part == PROCESS, incident.ended
    # A node that stays away ends the run; an incident that has ended is a node started again.
    code = "started_again" if whole and ended else incident.code
    return Alarm(
        Trouble(
            ERROR, plain(incident.cause), code, incident.node,
            "" if whole else incident.part,
        ),
        at(incident.began_tick, incident.began),
        over=at(incident.ended_tick, ended) if ended else None,
    )
