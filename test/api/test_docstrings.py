"""The examples in the docstrings give what they show."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

import greenroof_ros as gr
from greenroof_ros import api

MODULES = [module.name for module in pkgutil.iter_modules(api.__path__)]


@pytest.mark.parametrize("name", MODULES)
def test_examples(name: str) -> None:
    if name == "gym":
        pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    module = importlib.import_module(f"{api.__name__}.{name}")
    assert doctest.testmod(module).failed == 0


NO_CALLS = {"scenarios", "ConfigurationError", "ControllerError", "Parameter"}


@pytest.mark.parametrize("name", sorted({*gr.__all__} - NO_CALLS))
def test_each_has_an_example(name: str) -> None:
    """Each name of the API, and each of its methods and properties."""
    public = [
        test for test in doctest.DocTestFinder(exclude_empty=False).find(getattr(gr, name), name)
        if not any(part.startswith("_") for part in test.name.split("."))
    ]
    assert public
    assert [test.name for test in public if not test.examples] == []
