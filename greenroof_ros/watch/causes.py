"""Which alarm follows from which: one cause must not stand as five alarms of equal weight."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache

from greenroof_ros.common.interface import read_live_topics, read_topics
from greenroof_ros.graph.states import PUMP

# Parts of a node that say what comes in from others.
_TAKES_IN = ("inputs", "levels", "command", "frost", "refused")


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
    an input is named by its topic, which the interface says who publishes.

    Args:
        troubles: of the graph's own nodes, the older ones first.
    """
    causes: dict[str, str] = {}
    for name, trouble in troubles.items():
        for other in _candidates(name, trouble, troubles):
            root = other
            while root in causes:
                root = causes[root]
            if root != name:
                causes[name] = root
                break
    for name in causes:
        while causes[name] in causes:
            causes[name] = causes[causes[name]]
    return causes


def _candidates(
    name: str, trouble: Trouble, troubles: Mapping[str, Trouble]
) -> Iterator[str]:
    """Return the alarms from which one may follow, the likeliest first."""
    node = name.partition(": ")[0]
    what, part = trouble.what, trouble.part

    def of(*parts: str) -> list[str]:
        return [f"{node}: {one}" for one in parts if f"{node}: {one}" in troubles]

    if part and node in troubles:  # of a node that is not heard, what it said last
        yield node
    if (trouble.role, part) == (PUMP, PUMP):
        yield from _repeated(name, what, troubles)
        if "the drive reports" in what or "speed of the drive" in what:
            yield from of("drive")
        if "level of the" in what:
            yield from of("levels")
        if "frost" in what:
            yield from of("frost")
    elif part == "delivery":
        yield from of("levels")
    elif part == "supervisor" or not part:
        yield from _named(node, what, troubles)
    elif part in _TAKES_IN:
        yield from _published(trouble, troubles)
        if part in ("inputs", "refused"):
            yield from _alike(node, part, what, troubles)
    elif (trouble.role, part) == ("weather", "frost"):
        yield from of("forecast")


def _repeated(name: str, what: str, troubles: Mapping[str, Trouble]) -> Iterator[str]:
    """Return the parts of the pump whose words its state repeats."""
    node = name.partition(": ")[0]
    for other, one in troubles.items():
        if other != name and other.startswith(f"{node}: ") and _core(one.what) in what:
            yield other


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
