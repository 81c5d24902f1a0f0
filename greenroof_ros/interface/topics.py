"""The interface of the graph, ``msg_defs/topics.yaml``, with all topics."""

from __future__ import annotations

import functools
import math
import sys
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_yaml, shared_directory
from greenroof_ros.base.ranges import Range


@dataclass(frozen=True)
class Qos:
    """A quality-of-service profile with keep-last history and automatic liveliness.

    Attributes:
        reliability: ``reliable`` or ``best_effort``.
        durability: ``transient_local`` or ``volatile``.
        depth: history depth (number of messages).
        lease_s: liveliness lease duration (s); infinite by default.
    """

    reliability: str
    durability: str
    depth: int
    lease_s: float = math.inf


@dataclass(frozen=True)
class Display:
    """The form in which every tool shows a topic's values to an operator.

    Attributes:
        label: name of the value, as shown to the operator.
        unit: unit of the shown value, such as ``mm``; empty for a plain number.
        factor: conversion factor from the topic's unit to the shown unit, such as 1000 from m to
            mm.
        decimals: number of decimal places of the shown value.
    """

    label: str
    unit: str
    factor: float
    decimals: int


@dataclass(frozen=True)
class Age:
    """The maximum age of a topic's values in a live graph, a parameter of nodes reading the topic.

    Attributes:
        parameter: name of the parameter.
        quantity: human-readable name of the quantity.
        default: default value of the parameter (s).
        max: maximum value of the parameter (s).
    """

    parameter: str
    quantity: str
    default: float
    max: float


@dataclass(frozen=True)
class Topic:
    """A topic of the graph; ``msg_defs/topics.yaml`` explains every attribute."""

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
    needs: str = ""
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
        """The range of valid values."""
        return Range(self.low, self.high, self.unit)

    @property
    def senders(self) -> frozenset[str]:
        """The nodes that may publish the topic, in a simulated or in a live graph."""
        return frozenset((*self.publishers, *self.live_publishers))

    @property
    def graph_name(self) -> str:
        """The relative name used in the code of nodes, so that a graph can have a namespace."""
        return self.name if self.absolute else self.name.removeprefix("/")


@functools.cache  # sites, nodes and pages all use it
def read_topics() -> Mapping[str, Topic]:
    """Return the topics in the order of the file, which is also their order in a bag's ticks."""
    interface: dict[str, Any] = read_yaml(shared_directory() / "msg_defs" / "topics.yaml")
    profiles = {name: Qos(**profile) for name, profile in interface["qos"].items()}
    ages = {name: Age(parameter=name, **age) for name, age in interface["max_ages"].items()}
    return {
        name: _make_topic(
            name, profiles[entry.pop("qos")],
            max_age=ages.get(entry.pop("max_age", "")), **entry,
        )
        for name, entry in interface["topics"].items()
    }


def _make_topic(name: str, qos: Qos, **entry: Any) -> Topic:
    fields: dict[str, Any] = {
        key: tuple(item) if isinstance(item, list) else item for key, item in entry.items()
    }
    low, high = fields.pop("range", (-math.inf, math.inf))
    if isinstance(fields.get("undecided"), tuple):
        fields["undecided"] = array("d", fields["undecided"])
    if "display" in fields:
        fields["display"] = Display(**fields["display"])
    return Topic(
        name=name, qos=qos,
        # Even without limits, a value must be finite.
        low=max(low, -sys.float_info.max), high=min(high, sys.float_info.max), **fields,
    )


@functools.cache
def node_names() -> frozenset[str]:
    """Return the names of all nodes and of a live site's processes, except for a controller's."""
    roles = {
        role for topic in read_topics().values()
        for role in (*topic.senders, *topic.subscribers, *topic.live_subscribers)
    }
    return frozenset(roles - {"controller"} | {"bringup", "station"})


def optional_topics(outputs: Mapping[str, str]) -> list[tuple[Topic, str]]:
    """Return the topics of a controller's outputs, with the corresponding controller attributes.

    Raises:
        ConfigurationError: if the name of an output is not an optional topic of the interface.
    """
    topics = {name: topic for name, topic in read_topics().items() if topic.optional}
    for name in outputs:
        if name not in topics:
            raise ConfigurationError(
                "is not an output of a controller; the outputs in msg_defs/topics.yaml are "
                f"{', '.join(topics)}",
                key="outputs", value=name,
            )
    return [(topic, outputs[name]) for name, topic in topics.items() if name in outputs]


def recorded_topics(outputs: Mapping[str, str], site: object) -> list[Topic]:
    """Return the topics that a graph publishes in every tick, in the order of a bag.

    Args:
        outputs: the optional topics that the graph's controller publishes.
        site: the site of the graph.

    Raises:
        ConfigurationError: if an output is not an optional topic of the interface.
    """
    optional_topics(outputs)  # rejects others
    return [
        topic for topic in read_topics().values()
        if topic.per_tick and (not topic.optional or topic.name in outputs)
        and (not topic.needs or getattr(site, topic.needs))
    ]


def read_live_topics() -> dict[str, Topic]:
    """Return the topics of a live graph, with the roles that replace the plant."""
    return {
        name: replace(
            topic,
            publishers=topic.live_publishers or topic.publishers,
            subscribers=topic.subscribers + topic.live_subscribers,
        )
        for name, topic in read_topics().items()
        if topic.live
    }
