"""The interface, ``msg_defs/topics.yaml``: all topics of the graph."""

from __future__ import annotations

import functools
import math
import sys
from array import array
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_yaml, shared_directory
from greenroof_ros.common.ranges import Range


@dataclass(frozen=True)
class Qos:
    """A quality-of-service profile; history is always keep-last, liveliness always automatic.

    Attributes:
        name: the profile's name in the interface.
        reliability: ``reliable`` or ``best_effort``.
        durability: ``transient_local`` or ``volatile``.
        depth: number of messages that are kept.
        lease_s: liveliness lease (s), infinite by default.
    """

    name: str
    reliability: str
    durability: str
    depth: int
    lease_s: float = math.inf


@dataclass(frozen=True)
class Display:
    """How a topic's values are shown to an operator, in every tool.

    label: what the value is, in the operator's words.
        unit: unit of the shown value, such as ``mm``; empty for a plain number.
        unit: unit of the shown value, such as ``mm``; empty for a plain number.
        factor: factor from the topic's unit to the shown unit: 1000 from m to mm.
        decimals: number of decimals of the shown value.
    """

    label: str
    unit: str
    factor: float
    decimals: int


@dataclass(frozen=True)
class Age:
    """The maximum age of a topic's values in a live graph, as a parameter of the nodes reading it.

    Attributes:
        parameter: name of the parameter.
        quantity: what the values are, in words.
        default: default of the parameter (s).
        max: maximum value of the parameter (s).
    """

    parameter: str
    quantity: str
    default: float
    max: float


@dataclass(frozen=True)
class Topic:
    """One topic of the graph; ``msg_defs/topics.yaml`` explains every attribute."""

    name: str
    type: str
    unit: str
    low: float
    high: float
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    per_tick: bool
    qos: Qos
    meaning: str
    optional: bool = False
    of_valve: bool = False
    display: Display | None = None
    dimensions: tuple[str, ...] = ()
    undecided: float | array[float] = math.nan
    may_be_unknown: bool = False
    absolute: bool = False
    live: bool = True
    live_publishers: tuple[str, ...] = ()
    live_subscribers: tuple[str, ...] = ()
    max_age: Age | None = None

    @property
    def range(self) -> Range:
        """The numbers that its values may be."""
        return Range(self.low, self.high, self.unit)

    @property
    def graph_name(self) -> str:
        """Its name in a node's code: relative, so that a whole graph can be put in a namespace."""
        return self.name if self.absolute else self.name.removeprefix("/")


@functools.cache
def _topics() -> dict[str, Topic]:
    """Read the interface once per process, because every site, node and page needs it."""
    interface: dict[str, Any] = read_yaml(shared_directory() / "msg_defs" / "topics.yaml")
    profiles = {name: Qos(name=name, **profile) for name, profile in interface["qos"].items()}
    ages = {name: Age(parameter=name, **age) for name, age in interface["max_ages"].items()}
    return {
        name: _make_topic(
            name, profiles[entry.pop("qos")],
            max_age=ages.get(entry.pop("max_age", "")), **entry,
        )
        for name, entry in interface["topics"].items()
    }


def _make_topic(
    name: str, qos: Qos, *, range: Sequence[float] = (-math.inf, math.inf),
    undecided: float | list[float] = math.nan, display: Mapping[str, Any] | None = None,
    **entry: Any,
) -> Topic:
    low, high = range
    fields: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()
    }
    return Topic(
        name=name, qos=qos,
        # Even without limits, a value must be finite.
        low=max(low, -sys.float_info.max), high=min(high, sys.float_info.max),
        undecided=array("d", undecided) if isinstance(undecided, list) else undecided,
        display=None if display is None else Display(**display), **fields,
    )


def read_topics() -> dict[str, Topic]:
    """Return the interface in the order of the file, in which a bag stores every tick, too."""
    return dict(_topics())


def read_live_topics() -> dict[str, Topic]:
    """Return the interface of a live graph, which has no plant."""
    return {
        name: replace(
            topic,
            publishers=topic.live_publishers or _drop_plant(topic.publishers),
            subscribers=_drop_plant(topic.subscribers) + topic.live_subscribers,
        )
        for name, topic in read_topics().items()
        if topic.live
    }


def _drop_plant(roles: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(role for role in roles if role != "plant")


def optional_topics(outputs: Mapping[str, str]) -> list[tuple[Topic, str]]:
    """Return the topics of a controller's outputs, each with the controller's attribute.

    Raises:
        ConfigurationError: if a name is not an optional topic of the interface.
    """
    topics = {name: topic for name, topic in read_topics().items() if topic.optional}
    for name in outputs:
        if name not in topics:
            raise ConfigurationError(
                f"is not an output of a controller; msg_defs/topics.yaml lists {', '.join(topics)}",
                key="outputs", value=name,
            )
    return [(topic, outputs[name]) for name, topic in topics.items() if name in outputs]


def recorded_topics(outputs: Mapping[str, str], valve: bool) -> list[Topic]:
    """Return the topics that a graph publishes each tick, in bag order.

    Args:
        outputs: the optional topics that its controller publishes.
        valve: whether the cistern's low outlet has a valve.

    Raises:
        ConfigurationError: if one of them is not an optional topic of the interface.
    """
    optional_topics(outputs)  # rejects others
    return [
        topic for topic in read_topics().values()
        if topic.per_tick and (not topic.optional or topic.name in outputs)
        and (valve or not topic.of_valve)
    ]


def find_namespace(names: Collection[str], needed: Sequence[str], bag: Path) -> str:
    """Return the namespace of a graph, from the names of its topics on the wire.

    Args:
        names: topic names, such as ``/site1/roof/level``.
        needed: topics of the interface, such as ``/roof/level``, that the graph must have.
        bag: the bag with these topics, for messages.

    Returns:
        The prefix of the names, such as ``/site1``; empty if there is none, or if no namespace has
        all the needed topics.

    Raises:
        ConfigurationError: if more than one namespace has them.
    """
    first = needed[0]
    namespaces = [
        name.removesuffix(first)
        for name in names
        if name.endswith(first)
        and all(name.removesuffix(first) + topic in names for topic in needed)
    ]
    if len(namespaces) > 1:
        raise ConfigurationError(
            "must be from one graph, but contains topics from the namespaces "
            + ", ".join(namespace or "/" for namespace in sorted(namespaces)),
            file=bag,
        )
    return namespaces[0] if namespaces else ""
