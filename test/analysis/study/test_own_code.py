"""Results of a study are old once the code of a user's controller has changed."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from greenroof_ros.analysis.case import identify_code
from greenroof_ros.controllers.registry import find_controller

OWN = """
import numpy
from . import law
from greenroof_ros.base.parameter import Parameter
class Mine:
    parameters = ()
    def __init__(self, site): pass
    def command(self, *inputs):
        import further
        return law.GAIN
    def skip(self): pass
    def statistics(self): pass
"""


def test_an_edit_of_code_that_a_controller_imports_makes_it_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From its package, from a function or from elsewhere; other files make no difference."""
    files = {"own/__init__.py": "", "own/law.py": "GAIN = 1.0", "own/mine.py": OWN,
             "further.py": "import last", "last.py": "LAST = 1", "unused.py": "UNUSED = 1"}
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    sources = [identify_code(find_controller("own.mine:Mine"))]
    for name in files:
        with (tmp_path / name).open("a") as file:
            file.write("\n# edited")
        identify_code.cache_clear()
        sources.append(identify_code(find_controller("own.mine:Mine")))
    changes = [before != after for before, after in pairwise(sources)]
    assert changes == [name != "unused.py" for name in files]
    assert all(len(source) == 12 for source in sources)
    assert identify_code(find_controller("lookahead")) == ""
