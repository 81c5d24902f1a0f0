"""The notebook: its cells are the script's, it runs, and its pictures are in it."""

from __future__ import annotations

import pytest
from places import CHECKOUT

NOTEBOOK = CHECKOUT / "examples" / "first_look.ipynb"


def test_notebook_runs() -> None:
    """Each cell shows again what the committed notebook has, as text; pictures are pictures."""
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
    pytest.importorskip("nbclient", reason="nbclient is not installed")
    from notebook import SCRIPT, executed, notebook_of

    committed = nbformat.read(NOTEBOOK, 4)
    made = notebook_of(SCRIPT)
    assert [cell.source for cell in committed.cells] == [cell.source for cell in made.cells]
    pictures = 0
    for ours, theirs in zip(executed(made).cells, committed.cells, strict=True):
        outputs = (cell.get("outputs", ()) for cell in (ours, theirs))
        for output, expected in zip(*outputs, strict=True):
            assert output.data.keys() == expected.data.keys()
            pictures += "image/png" in output.data
            if "image/png" not in output.data:
                assert output.data["text/plain"] == expected.data["text/plain"]
    assert pictures == 3
    assert NOTEBOOK.stat().st_size <= 400_000
