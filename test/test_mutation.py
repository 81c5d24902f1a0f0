"""The modules and tests listed for mutation testing, which is run by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from places import CHECKOUT

FOLDERS: dict[str, Any] = yaml.safe_load(
    (CHECKOUT / "tools" / "mutation" / "judges.yaml").read_text(encoding="utf-8")
)


@pytest.mark.parametrize("folder", FOLDERS)
def test_modules_and_their_judges_are_there(folder: str) -> None:
    """Moved or renamed files must be updated in the list, or no test would judge their mutants."""
    modules, without = FOLDERS[folder]["modules"], FOLDERS[folder]["without"]
    for module in modules:
        assert (CHECKOUT / "greenroof_ros" / module).is_file(), module
    judges = {judge for of_module in modules.values() for judge in of_module}
    for test in (*judges, *without):
        path, _, name = test.partition("::")
        function = f"def {name.partition('[')[0]}(" if name else ""
        assert function in (CHECKOUT / "test" / path).read_text(encoding="utf-8"), test
    assert {test.partition("::")[0] for test in without} <= judges


@pytest.mark.parametrize("folder", sorted(FOLDERS.keys() - {"lockstep", "data"}))
def test_no_module_of_a_folder_is_forgotten(folder: str) -> None:
    """For lockstep and data only parts of folders are listed."""
    modules = FOLDERS[folder]["modules"]
    directory = Path(next(iter(modules))).parent
    written = {
        str(directory / path.name) for path in (CHECKOUT / "greenroof_ros" / directory).glob("*.py")
    }
    assert {*modules, str(directory / "__init__.py")} == written
