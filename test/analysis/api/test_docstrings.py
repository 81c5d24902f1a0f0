"""The examples in the docstrings give what they show."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

from greenroof_ros.analysis import api

MODULES = [module.name for module in pkgutil.iter_modules(api.__path__) if module.name != "gym"]
# The functions and classes of the API that have an example.
WITH_EXAMPLES = {"simulate": 2, "result": 4, "environment": 1, "inputs": 1}


@pytest.mark.parametrize("name", MODULES)
def test_examples(name: str) -> None:
    module = importlib.import_module(f"{api.__name__}.{name}")
    found = [test for test in doctest.DocTestFinder().find(module) if test.examples]
    assert len(found) == WITH_EXAMPLES.get(name, 0)
    done = doctest.testmod(module)
    assert done.failed == 0
