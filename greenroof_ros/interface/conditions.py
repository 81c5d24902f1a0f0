"""Conditions of the graph (``msg_defs/conditions.yaml``): codes, sentences, advice and interlocks.

Messages contain codes and values, from which the sentence is composed only where it is displayed.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from string import Formatter
from typing import Any

from greenroof_ros.base.files import read_yaml, shared_directory
from greenroof_ros.base.times import duration
from greenroof_ros.interface.states import VALVE

LATCHED, INHIBIT, PERMISSIVE = "latched", "inhibit", "permissive"


@dataclass(frozen=True)
class Interlock:
    """Properties of a condition that keeps the pump off.

    Attributes:
        kind: type of the interlock: latched, inhibit or permissive.
        limit: parameters that determine when the interlock is active.
        follows: True if the interlock is left out while an earlier interlock of the same kind is
            active, because it may be only a consequence of the earlier interlock.
        by: the person, service or transition that clears the interlock, if it is not the usual one
            for this kind of interlock; otherwise empty.
        on_page: True if the interlock can also be cleared on the page.
        input: part of the pump node that reports the unknown input; empty if the interlock is not
            about an input.
        explained_by: other parts of the pump node that report more details.
        valve: True if the interlock is only that of the outlet valve.
    """

    kind: str
    limit: tuple[str, ...] = ()
    follows: bool = False
    by: str = ""
    on_page: bool = False
    input: str = ""
    explained_by: tuple[str, ...] = ()
    valve: bool = False

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts of the pump node that report more details."""
        return (self.input,) if self.input else tuple(self.explained_by)


@dataclass(frozen=True)
class Condition:
    """The row of the conditions table for a code; ``conditions.yaml`` explains every attribute."""

    meaning: str
    advice: str
    sentence: str | Mapping[str, str] = ""
    by_role: Mapping[str, str] = field(default_factory=dict)
    lasts: float = 0.0
    late: bool = False
    no_data: bool = False
    explained_by: tuple[str, ...] = ()
    stops_pump: bool = False
    by_hand: bool = False
    device: bool = False
    headline: str = ""
    interlock: Interlock | None = None

    @property
    def needs_operator(self) -> bool:
        """Whether a person has to go to the pump, whatever the cause."""
        return self.by_hand or (self.interlock is not None and self.interlock.kind == LATCHED)

    def advise(self, node: str, role: str = "") -> str:
        """Return the advice on the condition.

        Args:
            node: fully qualified name of the node, for the commands that the advice names.
            role: the node's role in the interface.
        """
        group = "outlet " if role == VALVE else ""
        return self.by_role.get(role, self.advice).format(
            node=node,
            reset=f"{command_for(node, f'{group}reset')}, in a terminal on the site's machine",
            release=command_for(node, f"{group}release"),
        )


def command_for(node: str, name: str) -> str:
    """Return the command line of a ``greenroof`` command for the graph of a node."""
    namespace = node.rpartition("/")[0].strip("/")
    return f"greenroof {name}" + (f" --namespace {namespace}" if namespace else "")


@functools.cache
def read_conditions() -> dict[str, Condition]:
    """Return all conditions, keyed by code, in the order of the table."""
    table = read_yaml(shared_directory() / "msg_defs" / "conditions.yaml")
    return {
        code: Condition(**row, interlock=None if interlock is None else Interlock(**interlock))
        for code, row in table.items() for interlock in (row.pop("interlock", None),)
    }


@functools.cache
def read_interlocks() -> dict[str, Interlock]:
    """Return the interlocks, keyed by code, in the order in which they are evaluated."""
    return {
        code: condition.interlock for code, condition in read_conditions().items()
        if condition.interlock is not None
    }


@dataclass(frozen=True)
class Diagnosis:
    """A condition that currently exists, with its values.

    Attributes:
        code: code of the condition.
        text: sentence from another source, such as a record; empty to use the table's sentence.
        values: values to insert in the table's sentence; programs can also use these values.
            ``case`` contains the names of the sentences if the table has more than one for the
            code. A value can be another diagnosis.
    """

    code: str
    text: str = ""
    values: Mapping[str, Value] = field(default_factory=dict)

    @classmethod
    def of(cls, code: str, *cases: str, **values: Value) -> Diagnosis:
        """Return a diagnosis with the table's sentence.

        Args:
            code: code of the condition.
            cases: names of the sentences to join, if the table has more than one for the code.
            values: values for the placeholders in the sentences.
        """
        return cls(code, values={**values, "case": " ".join(cases)} if cases else values)

    @functools.cached_property
    def sentence(self) -> str:
        """The human-readable sentence that describes the diagnosis."""
        if self.text:
            return self.text
        condition = read_conditions()[self.code]
        template = condition.sentence or condition.meaning
        if not isinstance(template, str):
            template = "".join(template[case] for case in str(self.values["case"]).split())
        return _FORMATTER.vformat(template, (), self.values)

    def __str__(self) -> str:
        return self.sentence

    def change_code(self, code: str) -> Diagnosis:
        """Return a copy of the diagnosis with another code."""
        return replace(self, code=code, text=self.sentence)

    @classmethod
    def if_any(cls, code: str, why: str) -> Diagnosis | None:
        """Return a diagnosis whose only value is a reason; None if the reason is empty."""
        return cls.of(code, why=why) if why else None


Value = float | str | Diagnosis


def identity_of(values: Mapping[str, Any]) -> tuple[str, str]:
    """Return the code in the values of a report, and the device's own fault.

    If the code or the fault changes, a new alarm of the same name begins; numbers in the sentence
    may change.
    """
    return values.get("code", ""), values.get("fault") or ""


class _Formatter(Formatter):
    """Formatter like :meth:`str.format`, with the additional format ``duration`` for times (s)."""

    def format_field(self, value: Any, spec: str) -> str:
        if spec != "duration":
            return str(super().format_field(value, spec))
        return duration(math.ceil(value))


_FORMATTER = _Formatter()
