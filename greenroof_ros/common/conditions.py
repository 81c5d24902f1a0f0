"""What can be wrong (``msg_defs/conditions.yaml``): codes, sentences, advice and interlocks.

Codes and values travel; the sentence is made from them only where people read it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from string import Formatter
from typing import Any

from greenroof_ros.common.files import read_yaml, shared_directory
from greenroof_ros.common.times import duration

LATCHED, INHIBIT, PERMISSIVE = "latched", "inhibit", "permissive"


@dataclass(frozen=True)
class Interlock:
    """Why a condition keeps the pump off, and how that is cleared.

    Attributes:
        kind: latched, inhibit or permissive.
        source: the module that detects it.
        limit: the parameters that decide when it is active.
        follows: whether it is left out if an earlier interlock of its kind is active, because it
            may be a mere consequence of that one.
        by: what clears it, if this differs from its kind: a person, a service or a transition.
        on_page: whether it can also be cleared on the page.
        input: the part of the pump node that reports the unknown input; empty if the interlock is
            about something else.
        explained_by: other parts of the pump node that give more detail.
    """

    kind: str
    source: str
    limit: tuple[str, ...] = ()
    follows: bool = False
    by: str = ""
    on_page: bool = False
    input: str = ""
    explained_by: tuple[str, ...] = ()

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts of the pump node that give more detail."""
        return (self.input,) if self.input else tuple(self.explained_by)


@dataclass(frozen=True)
class Condition:
    """What the table states about one code; the file explains every attribute."""

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
    interlock: Interlock | None = None

    @property
    def needs_operator(self) -> bool:
        """Whether a person has to go to the pump, regardless of the cause."""
        return self.by_hand or (self.interlock is not None and self.interlock.kind == LATCHED)

    def advise(self, node: str, role: str = "", reset: str = "") -> str:
        """Return what to do.

        Args:
            node: fully qualified name of the node, for the services that the advice names.
            role: role of that node in the interface.
            reset: how to clear a fault, in words; empty for the command.
        """
        return self.by_role.get(role, self.advice).format(
            node=node,
            reset=reset or command_for(node, "reset"),
            release=command_for(node, "release"),
        )


def command_for(node: str, name: str) -> str:
    """Return how to call a command of ``greenroof`` for the graph of a node."""
    namespace = node.rpartition("/")[0].strip("/")
    return f"greenroof {name}" + (f" --namespace {namespace}" if namespace else "")


@functools.cache
def read_conditions() -> dict[str, Condition]:
    """Return every condition, by its code, in the order of the table."""
    table: dict[str, dict[str, Any]] = read_yaml(
        shared_directory() / "msg_defs" / "conditions.yaml"
    )
    return {
        code: Condition(**row, interlock=None if interlock is None else Interlock(**interlock))
        for code, row in table.items() for interlock in (row.pop("interlock", None),)
    }


@functools.cache
def read_interlocks() -> dict[str, Interlock]:
    """Return the interlocks by code, in the order in which they are evaluated."""
    return {
        code: condition.interlock for code, condition in read_conditions().items()
        if condition.interlock is not None
    }


@dataclass(frozen=True)
class Diagnosis:
    """A condition that is present.

    Attributes:
        code: code of the condition.
        text: a sentence from elsewhere, such as a record; empty to use the table's sentence.
        values: what the table's sentence is made of, for programs: ``case`` holds the names of its
            sentences, if there are several; a value can be another diagnosis.
    """

    code: str
    text: str = ""
    values: Mapping[str, Value] = field(default_factory=dict)

    @classmethod
    def of(cls, code: str, *cases: str, **values: Value) -> Diagnosis:
        """Return a condition.

        Args:
            code: code of the condition.
            cases: which of its sentences to use, one after another, if the table has several.
            values: values for the placeholders.
        """
        return cls(code, values={**values, "case": " ".join(cases)} if cases else values)

    @functools.cached_property
    def sentence(self) -> str:
        """The diagnosis as a sentence for people."""
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
        """Return the diagnosis under another code, with the same sentence and values."""
        return replace(self, code=code, text=self.sentence)

    def add_case(self, case: str, **values: Value) -> Diagnosis:
        """Return the diagnosis with one more of its sentences."""
        return Diagnosis.of(self.code, str(self.values["case"]), case, **{**self.values, **values})

    @classmethod
    def if_any(cls, code: str, why: str) -> Diagnosis | None:
        """Return a condition whose only value is a reason; None if there is no reason."""
        return cls.of(code, why=why) if why else None


Value = float | str | Diagnosis


def identity_of(values: Mapping[str, Any]) -> tuple[str, str]:
    """Return the code in a report's values, and the device's own fault or warning.

    If they differ, it is another alarm of the same name; numbers in the sentence may change.
    """
    return values.get("code", ""), values.get("fault") or values.get("warning") or ""


def join_diagnoses(
    diagnoses: Sequence[Diagnosis], worst: Diagnosis | None = None
) -> Diagnosis | None:
    """Join diagnoses into one, with the code and values of the worst; None if there are none.

    Args:
        diagnoses: in the order of their sentences.
        worst: the worst of them; by default the first.
    """
    if not diagnoses:
        return None
    topics = {str(topic): None for each in diagnoses if (topic := each.values.get("topic"))}
    worst = worst or diagnoses[0]
    return replace(
        worst, text="; ".join(each.sentence for each in diagnoses),
        values={**worst.values, **({"topics": " ".join(topics)} if topics else {})},
    )


class _Formatter(Formatter):
    """Formats as :meth:`str.format` does; ``duration`` writes a time (s) in words."""

    def format_field(self, value: Any, spec: str) -> str:
        if spec != "duration":
            return str(super().format_field(value, spec))
        return duration(math.ceil(value))


_FORMATTER = _Formatter()
