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
    *(code for code, one in INTERLOCKS.items() if one.kind == LATCHED),
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


def row(
    name: str, trouble: Trouble, *, since: float, over: float | None, at_least: bool = False,
    acknowledged: bool = False, follows: str | None = None, recorded: bool = False,
) -> dict[str, Any]:
    """Return an alarm as the document has it, but for its times in words.

    ``plain`` is whether ``do`` is about that alarm, so that an operator reads it instead of the
    node's own words in ``what``. What only follows from another alarm names that in ``follows``.
    """
    node = name.partition(": ")[0]
    do, known = advise(trouble.code, trouble.role, f"/{node}" if recorded else node)
    return {
        "id": name, "level": _LEVELS[trouble.level], "what": trouble.what, "code": trouble.code,
        "do": do, "plain": known, "since": since, "since_at_least": at_least,
        "acknowledged": acknowledged, "over": over, "follows": follows, "recorded": recorded,
    }


@dataclass
class _Alarm:
    """A trouble with its history."""

    trouble: Trouble
    since: float
    since_at_least: bool
    acknowledged: str = ""  # the gist of what was seen to
    over: float | None = None
    over_wall: float = 0.0

    @property
    def gist(self) -> str:
        """What is wrong, without the numbers that change."""
        one = self.trouble
        return f"{one.level} {one.code} {one.gist or re.sub(r'[0-9.]+', '', one.what)}"

    @property
    def is_serious(self) -> bool:
        """Whether it counts as an alarm, and not as a warning: other devices warn at most."""
        return bool(self.trouble.role) and self.trouble.level in (ERROR, STALE)

    @property
    def is_acknowledged(self) -> bool:
        """Whether somebody has seen it as it is now, but for its numbers."""
        return self.gist == self.acknowledged


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
        self._alarms: dict[str, _Alarm] = {}
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
            if alarm is not None and alarm.over is not None and wall - alarm.over_wall > _AGAIN_S:
                alarm = None
            before = alarm.trouble.gist if alarm is not None else ""
            another = before and trouble.gist and before != trouble.gist
            if alarm is not None and not another:
                alarm.trouble, alarm.over = trouble, None
                continue
            if alarm is not None:
                self._note(f"{name}: {trouble.what}; before: {alarm.trouble.what}")
            self._alarms[name] = _Alarm(trouble, now, trouble.at_least)
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
        causes = self._causes()
        names = [*self._present(causes), *self._past()]
        return [
            row(
                name, (one := self._alarms[name]).trouble, since=one.since, over=one.over,
                at_least=one.since_at_least, acknowledged=one.is_acknowledged,
                follows=causes.get(name),
            )
            for name in names[:_ROWS]
        ]

    def _causes(self) -> dict[str, str]:
        """Return of the alarms of now that follow from another one which that is."""
        own = [
            name for name, one in self._alarms.items() if one.over is None and one.trouble.role
        ]
        own.sort(key=lambda name: self._alarms[name].since)
        return find_causes({name: self._alarms[name].trouble for name in own})

    def _present(self, causes: Mapping[str, str]) -> list[str]:
        """Return the names of the alarms of now, in order."""
        def order(name: str) -> tuple[bool, bool, int, bool, int, float]:
            alarm = self._alarms[name]
            trouble = alarm.trouble
            # Whether it runs is not known; how it is.
            rank = {(PUMP, ""): 0, (PUMP, PUMP): 1}.get((trouble.role, trouble.part), 2)
            return (
                not trouble.role, name in causes, rank, alarm.is_acknowledged,
                _SEVERITY[trouble.level], -alarm.since,
            )

        return sorted((one for one in self._alarms if self._alarms[one].over is None), key=order)

    def _past(self) -> list[str]:
        """Return the names of the alarms that are over, the newest first."""
        over = [one for one in self._alarms if self._alarms[one].over is not None]
        return sorted(over, key=lambda one: -self._alarms[one].over_wall)

    def events(self) -> list[dict[str, Any]]:
        """Return the events, the newest first."""
        return [{"at": at, "what": what} for at, what in reversed(self._events)]

    def _note(self, text: str) -> None:
        if self.shown:
            self.add_event(self._now, text)

    def add_event(self, now: float, text: str) -> None:
        """Note an event."""
        self._events.append((now, plain(text, _TEXT)))

    def date_again(self, first: float, last: float, begin: float) -> None:
        """Have all that is dated from one time to another one (s since 1970) be of a third time.

        It was noted before the graph's clock was known, by the system's.
        """
        for alarm in self._alarms.values():
            if first <= alarm.since <= last:
                alarm.since, alarm.since_at_least = begin, True
            if alarm.over is not None and first <= alarm.over <= last:
                alarm.over = begin
        self._events = deque(
            ((begin if first <= at <= last else at, text) for at, text in self._events),
            maxlen=_EVENTS,
        )

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
        causes = self._causes()
        present = [name for name, one in self._alarms.items() if one.over is None]
        serious = {causes.get(one, one) for one in present if self._alarms[one].is_serious}
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
            group = [name, *(one for one, cause in causes.items() if cause == name)]
            worse = troubles[first].level == WARN and any(
                troubles[one].level == ERROR for one in group
            )
            if first != name and not worse:
                causes.update(dict.fromkeys(group, first))
                break
    return causes


def _candidates(
    name: str, trouble: Trouble, troubles: Mapping[str, Trouble]
) -> Iterator[str]:
    """Return the alarms from which one may follow, the likeliest first."""
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
    yield from (found for one in more if (found := f"{node}: {one}") in troubles)
    if part == "inputs":
        # What the pump has against that input, which stops it, says more.
        yield from (
            other for other, one in troubles.items()
            if one.role == PUMP and one.part in ("levels", "command", "frost")
            and (one.code == code or trouble.role == PUMP)
        )


def _other_nodes(node: str, trouble: Trouble, troubles: Mapping[str, Trouble]) -> Iterator[str]:
    """Return the other nodes that are wrong as a whole: those that are waited for."""
    for other, one in troubles.items():
        waited_for = {other.rpartition("/")[2], one.role} & set(trouble.names)
        if other != node and ": " not in other and (
            waited_for or (trouble.part == "supervisor" and one.role != PUMP)
        ):
            yield other


def _publishers(trouble: Trouble, troubles: Mapping[str, Trouble]) -> Iterator[str]:
    """Return the alarms of those who publish what an alarm lacks."""
    interface, roles = read_topics(), {*_TAKES_IN[trouble.part]}
    for name in interface.keys() & set(trouble.names):
        roles.update(interface[name].publishers, interface[name].live_publishers)
    roles.discard(trouble.role)
    for whole in (True, False):  # a node that is not there, before what it says
        for other, one in troubles.items():
            if (
                one.role in roles and (not one.part) == whole
                and one.part not in ("inputs", "refused")
            ):
                yield other
