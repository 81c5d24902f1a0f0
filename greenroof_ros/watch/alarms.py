"""Alarms and events of a graph: what is wrong, since when, what to do, and what follows from what.

An alarm is a status that is not OK, a node that failed, or one that is not heard. It is known by
the name of its status, so that a number that changes in its sentence makes no new one; a second
fault under that name does. What it means and what to do stands with its code, in the table of
conditions: no sentence is read.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from greenroof_ros.common.interface import read_conditions, read_topics
from greenroof_ros.graph.supervision import PUMP
from greenroof_ros.pumping.interlocks import INTERLOCKS, LATCHED
from greenroof_ros.watch.registry import ERROR, STALE, WARN, Registry, Trouble
from greenroof_ros.watch.wire import Status
from greenroof_ros.watch.words import plain

# An alarm that comes back within this time (s) was not over for an operator.
_AGAIN_S = 10.0
_TEXT, _ROWS, _OVER, _EVENTS = 500, 100, 20, 50
_LEVELS = {WARN: "warn", ERROR: "error", STALE: "stale"}
_SEVERITY = {ERROR: 0, STALE: 1, WARN: 2}

# Where the code is not known, and of other devices: nothing is known of them here.
OTHER = "Nothing is known about this here; read the log of the node that says so."
FOREIGN = "Another device or program says so, not the green roof: see its own instructions."

# A state of the pump with such a code asks for a hand at the pump, whatever caused it.
_NEEDS_A_HAND = {
    *(code for code, interlock in INTERLOCKS.items() if interlock.kind == LATCHED),
    "operator_stop", "page_stop", "record_unknown", "stands_unknown", "stop_not_followed",
}
# Of each reason why the pump stands, the parts of its node that say more of it.
_PARTS_OF_REASON = {
    **dict.fromkeys(("cistern_level_unknown", "roof_level_unknown"), ("levels",)),
    **dict.fromkeys(("frost", "frost_unknown"), ("frost",)),
    **dict.fromkeys(
        ("no_command", "command_unknown", "command_refused", "two_controllers"), ("command",)
    ),
    "no_permit": ("supervisor",),
    **dict.fromkeys(
        ("not_active", "drive_lost", "drive_local", "second_master", "start_failed",
         "drive_not_ready", "drive_speed_unknown", "drive_timeout", "drive_guards_later", "no_run"),
        ("drive timeout", "drive"),
    ),
}
# Of other parts, those of the same node that say more.
_SAYS_MORE = {
    "delivery": ("levels",), "frost": ("forecast",),
    "refused": ("command", "levels", "frost", "inputs"),
}
# What each part of a node takes in, and from which roles: it says that nothing good comes.
_SENSORS = ("cistern_sensor", "roof_sensor", "plant")
_TAKES_IN = {
    "levels": _SENSORS, "command": ("controller",), "frost": ("weather",),
    "forecast": ("weather",), "rain gauge": ("rain_gauge",), "thermometer": ("thermometer",),
    "inputs": (*_SENSORS, "weather", "controller"), "refused": (),
}
_ABSENT = {
    "input_waiting", "input_silent", "input_refused", "no_command", "no_forecast",
    "temperature_unknown", "gauge_bad", "values_refused", "not_heard",
}


def advise(code: str, role: str, node: str) -> tuple[str, bool]:
    """Return what an alarm means and what to do about it, and whether anything is known of it.

    Args:
        code: of the condition.
        role: of the node, as the interface calls it; empty for another device.
        node: its fully qualified name, for the services that the advice names.
    """
    if not role:
        return FOREIGN, False
    known = read_conditions().get(code)
    return (OTHER, False) if known is None else (known.advise(node, role), True)


@dataclass
class Alarm:
    """A trouble with its history; an incident of a recording is one, too.

    Attributes:
        trouble: what is wrong, as it was said last.
        since: when it began (s since 1970, of the graph).
        at_least: whether it may have begun before.
        over: when it ended; None where it did not.
        wall: when it began, by a clock that is never set (s).
        over_wall: when it ended, by that clock.
        acknowledged: the gist of what somebody has seen.
    """

    trouble: Trouble
    since: float
    at_least: bool = False
    over: float | None = None
    wall: float = 0.0
    over_wall: float = 0.0
    acknowledged: str = ""

    @property
    def gist(self) -> str:
        """What is wrong, without the numbers that change."""
        trouble = self.trouble
        what = trouble.gist or re.sub(r"[0-9.]+", "", trouble.what)
        return f"{trouble.level} {trouble.code} {what}"

    @property
    def is_serious(self) -> bool:
        """Whether it counts as an alarm, and not as a warning: other devices warn at most."""
        return bool(self.trouble.role) and self.trouble.level in (ERROR, STALE)

    @property
    def is_acknowledged(self) -> bool:
        """Whether somebody has seen it as it is now, but for its numbers."""
        return self.gist == self.acknowledged

    def row(
        self, name: str, follows: str | None = None, *, recorded: bool = False
    ) -> dict[str, Any]:
        """Return it as the document has it, but for its times in words.

        ``plain`` is whether ``do`` is about that alarm, so that an operator reads it instead of the
        node's own words in ``what``.

        Args:
            name: of its status.
            follows: the name of the alarm that it only follows from; None for none.
            recorded: whether it is an incident of a recording.
        """
        trouble, node = self.trouble, name.partition(": ")[0]
        do, known = advise(trouble.code, trouble.role, f"/{node}" if recorded else node)
        return {
            "id": name, "level": _LEVELS[trouble.level], "what": trouble.what,
            "code": trouble.code, "do": do, "plain": known, "since": self.since,
            "since_at_least": self.at_least, "acknowledged": self.is_acknowledged,
            "over": self.over, "follows": follows, "recorded": recorded,
        }


class Alarms:
    """The alarms and events of one graph; see the module.

    Times called ``wall`` are of a clock that is never set (s); ``now`` is the graph's time, epoch
    seconds.

    Attributes:
        registry: of who says what.
        shown: whether what it says is shown; otherwise it makes no alarms and no events.
    """

    def __init__(self, namespace: str = "") -> None:
        """Begin without any.

        Args:
            namespace: of the graph; the statuses of other ones are those of other devices.
        """
        self.registry = Registry(namespace, self._note)
        self.shown = True
        self._now = 0.0
        self.start_over()

    def start_over(self) -> None:
        """Forget all alarms and events; who is there is known."""
        self._alarms: dict[str, Alarm] = {}
        self._events: deque[tuple[float, str]] = deque(maxlen=_EVENTS)

    def hear(self, wall: float, now: float, statuses: Sequence[Status], **more: Any) -> None:
        """Take what came, from one message or several; ``more`` goes to the registry."""
        self._now = now
        self.registry.hear(wall, statuses, **more)
        self.look(wall, now)

    def look(self, wall: float, now: float) -> None:
        """Bring the alarms up to date: called with each message, and about twice a second."""
        troubles = self.registry.troubles(wall) if self.shown else {}
        for name, trouble in troubles.items():
            alarm = self._alarms.get(name)
            if alarm is None or (alarm.over is not None and wall - alarm.over_wall > _AGAIN_S):
                self._alarms[name] = Alarm(trouble, now, trouble.at_least, wall=wall)
                continue
            before = alarm.trouble
            if before.gist and trouble.gist and before.gist != trouble.gist:
                self._note(f"{name}: {trouble.what}; before: {before.what}")
                self._alarms[name] = Alarm(trouble, now, trouble.at_least, wall=wall)
            else:
                alarm.trouble, alarm.over = trouble, None
        for name, alarm in self._alarms.items():
            if name not in troubles and alarm.over is None:
                alarm.over, alarm.over_wall = now, wall
        for name in self._past()[_OVER:]:
            del self._alarms[name]

    # --- telling --------------------------------------------------------------------------------

    def rows(self) -> list[dict[str, Any]]:
        """Return the alarms: causes, then what follows from them, and what is over last.

        Of both kinds the pump's state comes first, then the worst. The newest of a severity comes
        first: what has stood for long is known. So is what was acknowledged, which comes later.
        """
        present, causes = self._present(), self._causes()

        def order(name: str) -> tuple[bool, bool, int, bool, int, float]:
            alarm = present[name]
            trouble = alarm.trouble
            # Whether it runs is not known; how it is.
            rank = {(PUMP, ""): 0, (PUMP, PUMP): 1}.get((trouble.role, trouble.part), 2)
            return (
                not trouble.role, name in causes, rank, alarm.is_acknowledged,
                _SEVERITY[trouble.level], -alarm.wall,
            )

        names = [*sorted(present, key=order), *self._past()]
        return [self._alarms[name].row(name, causes.get(name)) for name in names[:_ROWS]]

    def _present(self) -> dict[str, Alarm]:
        """Return the alarms of now, by their names."""
        return {name: alarm for name, alarm in self._alarms.items() if alarm.over is None}

    def _past(self) -> list[str]:
        """Return the names of the alarms that are over, the newest first."""
        over = [name for name, alarm in self._alarms.items() if alarm.over is not None]
        return sorted(over, key=lambda name: -self._alarms[name].over_wall)

    def _causes(self) -> dict[str, str]:
        """Return of the alarms of now that follow from another one which that is."""
        own = [item for item in self._present().items() if item[1].trouble.role]
        own.sort(key=lambda item: item[1].wall)
        return find_causes({name: alarm.trouble for name, alarm in own})

    def events(self) -> list[dict[str, Any]]:
        """Return the events, the newest first."""
        return [{"at": at, "what": what} for at, what in reversed(self._events)]

    def _note(self, text: str) -> None:
        if self.shown:
            self.add_event(self._now, text)

    def add_event(self, now: float, text: str) -> None:
        """Note an event."""
        self._events.append((now, plain(text, _TEXT)))

    def acknowledge(self, alarm_id: str) -> bool:
        """Note that somebody saw an alarm, until it is another one; False if there is none such."""
        alarm = self._alarms.get(alarm_id)
        if alarm is not None:
            alarm.acknowledged = alarm.gist
        return alarm is not None

    def counts(self) -> tuple[int, int, int]:
        """Return how many causes are alarms and how many warnings, and how many follow from these.

        A cause counts by the worst of itself and of what follows from it.
        """
        causes, present = self._causes(), self._present()
        serious = {causes.get(name, name) for name in present if present[name].is_serious}
        return len(serious), len(present) - len(causes) - len(serious), len(causes)

    def advice(self) -> Any:
        """Return what to do now: about the cause of what is first and was not acknowledged."""
        present = {row["id"]: row for row in self.rows() if row["over"] is None}
        rows = sorted(present.values(), key=lambda row: row["acknowledged"])
        return present.get(rows[0]["follows"], rows[0])["do"] if rows else "Nothing to do."


# --- what follows from what -----------------------------------------------------------------------


def find_causes(troubles: Mapping[str, Trouble]) -> dict[str, str]:
    """Return of each alarm that follows from another one the name of the first of all.

    The pump's state follows from the part that says more of its reason, and what a node lacks from
    what is wrong with who publishes that. No error follows from a warning. Nor does a state of the
    pump that asks for a hand at it: what is to be done about its cause would hide that.

    Args:
        troubles: of the graph's own nodes, the older ones first.
    """
    causes: dict[str, str] = {}
    for name, trouble in troubles.items():
        for other in _candidates(name, trouble, troubles):
            first = causes.get(other, other)
            group = [name, *(follower for follower, cause in causes.items() if cause == name)]
            worse = troubles[first].level == WARN and any(
                troubles[follower].level == ERROR for follower in group
            )
            if first != name and not worse:
                causes.update(dict.fromkeys(group, first))
                break
    return causes


def _candidates(
    name: str, trouble: Trouble, troubles: Mapping[str, Trouble]
) -> Iterator[str]:
    """Yield the alarms from which this one may follow, the likeliest first."""
    node, part, code = name.partition(": ")[0], trouble.part, trouble.code
    state = (trouble.role, part) == (PUMP, PUMP)
    if code in _NEEDS_A_HAND and part == PUMP:
        return
    if part and node in troubles:  # of a node that is not heard, what it said last
        yield node
    if part == "supervisor" or not part:
        yield from _other_nodes(node, trouble, troubles)
    if part in _TAKES_IN and code in _ABSENT:
        yield from _publishers(trouble, troubles)
    more = _PARTS_OF_REASON.get(code, ()) if state else _SAYS_MORE.get(part, ())
    yield from (name for name in (f"{node}: {part}" for part in more) if name in troubles)
    if part == "inputs":
        # What the pump has against that input, which stops it, says more.
        yield from (
            name for name, other in troubles.items()
            if other.role == PUMP and other.part in ("levels", "command", "frost")
            and (other.code == code or trouble.role == PUMP)
        )


def _other_nodes(node: str, trouble: Trouble, troubles: Mapping[str, Trouble]) -> Iterator[str]:
    """Yield the other nodes that are wrong as a whole: those that are waited for."""
    for name, other in troubles.items():
        waited_for = {name.rpartition("/")[2], other.role} & set(trouble.names)
        if name != node and ": " not in name and (
            waited_for or (trouble.part == "supervisor" and other.role != PUMP)
        ):
            yield name


def _publishers(trouble: Trouble, troubles: Mapping[str, Trouble]) -> Iterator[str]:
    """Yield the alarms of those who publish what an alarm lacks."""
    interface, roles = read_topics(), {*_TAKES_IN[trouble.part]}
    for name in interface.keys() & set(trouble.names):
        roles.update(interface[name].publishers, interface[name].live_publishers)
    roles.discard(trouble.role)
    for whole in (True, False):  # a node that is not there, before what it says
        for name, other in troubles.items():
            if (
                other.role in roles and (not other.part) == whole
                and other.part not in ("inputs", "refused")
            ):
                yield name
