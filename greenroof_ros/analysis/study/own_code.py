"""The code of a user's controller, of which a change makes the results of a study old."""

from __future__ import annotations

import functools
import hashlib
import sys
from contextlib import suppress
from importlib.metadata import packages_distributions
from modulefinder import ModuleFinder
from pathlib import Path

from greenroof_ros.controllers.registry import BUILT_IN, ControllerChoice


@functools.cache
def identify_code(controller: ControllerChoice) -> str:
    """Return twelve digits that identify the code of a user's controller; empty if built in.

    They change with the source of its module and of all the modules that it imports, except those
    of the standard library, of this package and of other installed packages. Data files that the
    code reads, and modules that it imports by a computed name, are not covered.
    """
    if controller.reference in BUILT_IN:
        return ""
    modules = {controller.path.partition(":")[0], controller.kind.__module__}
    installed = {*sys.stdlib_module_names, *packages_distributions(), "greenroof_ros"}
    own = {name.partition(".")[0] for name in modules}
    finder = ModuleFinder(excludes=[*installed - own])
    for name in sorted(modules):
        with suppress(ImportError):  # the class of a script or a notebook
            finder.import_hook(name)
    digest = hashlib.sha256()
    for name, module in sorted(finder.modules.items()):
        file: str | None = getattr(module, "__file__", None)  # None: a plain folder
        if file is not None:
            digest.update(name.encode() + b"\0" + Path(file).read_bytes() + b"\0")
    return digest.hexdigest()[:12]
