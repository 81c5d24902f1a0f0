"""The code of a user-defined controller in a study's identity."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from places import CHECKOUT
from studies import GRID, cases_of

from greenroof_ros.analysis.case import identify_code
from greenroof_ros.controllers.registry import find_controller

# What changes, and whether it is code of the controller: its module, and what it imports.
CHANGED = {
    "my_own/__init__.py": True, "my_own/controller.py": True, "my_own/near.py": True,
    "my_own/lazy.py": True, "my_helper.py": True, "my_deep.py": True, "my_own/unused.py": False,
}


@pytest.mark.parametrize("changed", CHANGED)
def test_another_state_of_its_code_is_another_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str
) -> None:
    """A study that was begun with other code of the controller is not continued."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "my_own").mkdir()
    code = (CHECKOUT / "examples" / "proportional.py").read_text().replace(
        "from __future__ import annotations\n",
        "from __future__ import annotations\nimport math, numpy, my_helper\nfrom . import near\n",
    )
    lazy = "\n\ndef late():\n    from my_own.lazy import a\n    import not_installed\n"
    for file, text in {
        **dict.fromkeys(CHANGED, "a = 1\n"), "my_own/controller.py": code + lazy,
        "my_helper.py": "from my_deep import a\n",
    }.items():
        (tmp_path / file).write_text(text)
    grid = GRID[: GRID.index("  mpc:\n")] + "  my_own.controller:Proportional:\n"
    (tmp_path / "grid.yaml").write_text(grid)
    identify_code.cache_clear()
    try:
        identities = [cases_of(tmp_path / "grid.yaml")[0].identity for _ in range(2)]
        with (tmp_path / changed).open("a") as stream:
            stream.write("# changed\n")
        identify_code.cache_clear()  # as in another process
        after = cases_of(tmp_path / "grid.yaml")[0].identity
    finally:
        for name in [name for name in sys.modules if name.startswith("my_")]:
            del sys.modules[name]
    assert identities[0] == identities[1]
    assert (identities[0] != after) == CHANGED[changed]


def test_code_in_a_folder_without_init(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it imports from there counts, too."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "plain_folder").mkdir()
    gain, controller = (tmp_path / "plain_folder" / f"{name}.py" for name in ("gain", "own"))
    code = (CHECKOUT / "examples" / "proportional.py").read_text()
    controller.write_text(code + "\nfrom plain_folder import gain\n")
    found = set[str]()
    for text in ("A = 1\n", "A = 2\n"):
        gain.write_text(text)
        identify_code.cache_clear()
        found.add(identify_code(find_controller("plain_folder.own:Proportional")))
    assert len(found) == 2
