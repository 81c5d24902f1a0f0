"""Registration of the Gymnasium environments, regardless of the order of imports."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

ID, VECTOR_ID = "GreenRoof-v1", "GreenRoofVector-v1"


class _Registration:
    """Import hook that registers the environments as soon as a package imports Gymnasium."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the module's specification, with the registration as the last step of loading."""
        if name != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def register_after(module: ModuleType) -> None:
            execute(module)
            _register(module)

        spec.loader.exec_module = register_after  # type: ignore[method-assign]
        return spec


def _register(gymnasium: ModuleType) -> None:
    api = "greenroof_ros.analysis.api"
    gymnasium.register(ID, f"{api}.gym:GreenRoofEnv")
    gymnasium.register(VECTOR_ID, vector_entry_point=f"{api}.vector:GreenRoofVectorEnv")


def register() -> None:
    """Register the environments now or, if Gymnasium is not imported yet, as soon as it is."""
    known = sys.modules.get("gymnasium")
    if known is None:
        sys.meta_path.insert(0, _Registration())
    else:
        _register(known)
