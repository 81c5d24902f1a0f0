"""The codes that nodes report are those of the table, and each of the table is reported."""

from __future__ import annotations

import ast
from pathlib import Path

from places import CHECKOUT

from greenroof_ros.pumping.conditions import CONDITIONS
from greenroof_ros.pumping.input_rules import (
    FROZEN,
    JUMP,
    PAUSED,
    PUBLISHERS,
    RECOVERING,
    REFUSED,
    SILENT,
    WAITING,
    Verdict,
)
from greenroof_ros.pumping.interlocks import CODES

RULES = (WAITING, SILENT, REFUSED, PUBLISHERS, PAUSED, FROZEN, JUMP, RECOVERING)


def said_in(file: Path) -> set[str]:
    """Return the texts in a module that have the form of a code and are no docstring."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    return {
        node.value for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }


def codes_in(file: Path) -> set[str]:
    """Return what a module hands to ``diagnose`` as code or cause."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    return {
        constant.value
        for call in ast.walk(tree)
        if isinstance(call, ast.Call)
        and getattr(call.func, "attr", getattr(call.func, "id", "")) in ("diagnose", "say")
        for argument in call.args[3:]
        for constant in ast.walk(argument)
        if isinstance(constant, ast.Constant) and isinstance(constant.value, str)
    } - {""}


def test_what_is_reported_is_in_the_table() -> None:
    package = CHECKOUT / "greenroof_ros"
    reported = {
        code for room in ("graph", "nodes") for file in (package / room).glob("*.py")
        for code in codes_in(file)
    }
    assert len(reported) > 10
    assert reported <= CONDITIONS.keys()


def test_each_rule_of_an_input_has_a_code() -> None:
    assert {Verdict(rule, "why").code for rule in RULES} <= CONDITIONS.keys()
    assert Verdict().code == ""


def test_nothing_is_in_the_table_that_nothing_reports() -> None:
    package = CHECKOUT / "greenroof_ros"
    said = {
        text for room in ("graph", "nodes") for file in (package / room).glob("*.py")
        for text in said_in(file)
    }
    of_inputs = {Verdict(rule, "why").code for rule in RULES}
    assert CONDITIONS.keys() - of_inputs - set(CODES) <= said
