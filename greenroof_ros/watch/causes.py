"""Which alarm follows from which: one cause must not stand as five alarms of equal weight."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache

from greenroof_ros.common.interface import read_live_topics, read_topics
from greenroof_ros.graph.supervision import PUMP
from greenroof_ros.pumping.pump_control import OPERATOR_STOPPED, STANDS_UNKNOWN, STILL_TURNS

# Levels of a status.
_WARN, _ERROR = 1, 2
# A state of the pump with such words asks for a hand at the pump, whatever caused it; one that was
# cut may have had them.
_NEEDS_A_HAND = re.compile(f"^fault: |{OPERATOR_STOPPED}|{STILL_TURNS}|{STANDS_UNKNOWN}|…$")
# Words of a reason of the pump's state, and the part that says more of it.
_PART_OF_REASON = (
    ("speed of the drive", "drive"), ("level of the", "levels"), ("frost", "frost"),
    ("no command", "command"),
)
# Parts of a node that say what comes in from others.
_TAKES_IN = ("inputs", "forecast", "levels", "command", "frost", "refused")


@dataclass(frozen=True)
class Trouble:
    """What is wrong at present under the name of a status.

    Attributes:
        level: of :class:`~greenroof_ros.watch.alarms.Status`.
        what: a sentence.
        role: of the node, as the interface calls it; empty for another device.
        part: of the node; empty for the node itself.
        at_least: whether it may have been so before anybody listened here.
    """

    level: int
    what: str
    role: str = ""
    part: str = ""
    at_least: bool = False


def find_causes(troubles: Mapping[str, Trouble]) -> dict[str, str]:
    """Return of each alarm that follows from another one the name of the first of all.

    It follows where its own words say so: the pump's state repeats what speaks against running, and
    an input is named by its topic, which the interface says who publishes. No error follows from a
    warning. Nor does a state of the pump that asks for a hand at it: what is to be done about its
    cause would hide that.

    Args:
        troubles: of the graph's own nodes, the older ones first.
    """
    causes: dict[str, str] = {}
    for name, trouble in troubles.items():
        for other in _candidates(name, trouble, troubles):
            first = causes.get(other, other)
            group = [name, *(one for one, cause in causes.items() if cause == name)]
            worse = troubles[first].level == _WARN and any(
                troubles[one].level == _ERROR for one in group
            )
            if first != name and not worse:
                causes.update(dict.fromkeys(group, first))
                break
    return causes


def _candidates(
    name: str, trouble: Trouble, troubles: Mapping[str, Trouble]
) -> Iterator[str]:
    """Return the alarms from which one may follow, the likeliest first."""
    node = name.partition(": ")[0]
    what, part = trouble.what, trouble.part
    is_state = (trouble.role, part) == (PUMP, PUMP)
    if is_state and _NEEDS_A_HAND.search(what):
        return
    if part and node in troubles:  # of a node that is not heard, what it said last
        yield node
    if is_state:
        yield from _of_each_reason(name, what, troubles)
    elif part == "delivery":
        yield from _part(node, "levels", troubles)
    elif part == "supervisor" or not part:
        yield from _named(node, what, troubles)
    elif part in _TAKES_IN:
        yield from _published(trouble, troubles)
        if part in ("inputs", "refused"):
            yield from _alike(node, part, what, troubles)
    elif (trouble.role, part) == ("weather", "frost"):
        yield from _part(node, "forecast", troubles)


def _part(node: str, part: str, troubles: Mapping[str, Trouble]) -> list[str]:
    """Return the alarm of a part of a node, if there is one."""
    name = f"{node}: {part}"
    return [name] if name in troubles else []


def _of_each_reason(name: str, what: str, troubles: Mapping[str, Trouble]) -> list[str]:
    """Return the parts of the pump from which its state follows; none unless all of it does.

    A part's words are one reason or several; what they leave of the state is told by its words.
    """
    node = name.partition(": ")[0]
    rest, found = what.partition(": ")[2], []
    for other, one in troubles.items():
        if other != name and other.startswith(f"{node}: "):
            words = re.escape(_core(one.what))
            rest, count = re.subn(rf"(^|; )(not activated: )?{words}(?=; |$)", r"\1", rest)
            found += [other] if count else []
    for reason in filter(None, rest.split("; ")):
        parts = [
            other for words, part in _PART_OF_REASON if words in reason
            for other in _part(node, part, troubles)
        ]
        if not parts:
            return []
        found += parts
    return found


def _core(what: str) -> str:
    """Return a sentence without what is added to it for people alone."""
    return what.partition("; beware: ")[0]


def _named(node: str, what: str, troubles: Mapping[str, Trouble]) -> Iterator[str]:
    """Return the alarms of other nodes that are named in a sentence, by name or role."""
    for other, one in troubles.items():
        other_node = other.partition(": ")[0]
        called = other_node.rpartition("/")[2]
        if other_node != node and not one.part and re.search(
            rf"(?<![\w/])({re.escape(called)}|{re.escape(one.role)})\b", what
        ):
            yield other


def _published(trouble: Trouble, troubles: Mapping[str, Trouble]) -> Iterator[str]:
    """Return the alarms of those who publish the topics that are named in a sentence."""
    what = trouble.what
    if "publisher" in what:  # one too many, which is none of theirs
        return
    if what.startswith("no command"):
        what += " /pump/command"
    roles = {role for topic in _topics(what) for role in _publishers()[topic]} - {trouble.role}
    for whole in (True, False):  # a node that is not there, before what it says
        for other, one in troubles.items():
            if (
                one.role in roles and (not one.part) == whole
                and one.part not in ("inputs", "refused")
            ):
                yield other


def _topics(what: str) -> set[str]:
    """Return the topics that are named in a sentence, in whatever namespace."""
    return {topic for topic in _publishers() if re.search(rf"{re.escape(topic)}\b", what)}


def _alike(
    node: str, part: str, what: str, troubles: Mapping[str, Trouble]
) -> Iterator[str]:
    """Return the alarms that speak of the same topics, and say more of them.

    Those are of the pump's parts, which stop it, and of the inputs where values are refused.
    """
    topics = _topics(what)
    for other, one in troubles.items():
        says_more = one.role == PUMP and one.part in ("levels", "command", "frost")
        says_more |= part == "refused" and other == f"{node}: inputs"
        if says_more and _topics(one.what) & topics:
            yield other


@cache
def _publishers() -> dict[str, set[str]]:
    """Return the roles that publish each topic, in a simulation or live."""
    simulated, live = read_topics(), read_live_topics()  # each reads a file: once
    return {
        name: {
            role for topics in (simulated, live) if name in topics
            for role in topics[name].publishers
        }
        for name in simulated
    }
