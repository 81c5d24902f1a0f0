"""A digest of the code of a user's controller, from which a study detects changes to the code.

The digest does not cover data files that the code reads, or modules that the code imports by a
computed name.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

_PACKAGES = {"site-packages", "dist-packages"}
_NO_USERS = {*sys.stdlib_module_names, __name__.partition(".")[0]}


def digest_own_code(modules: Sequence[str]) -> str:
    """Return twelve digits that identify the source of modules and of all modules they import.

    The standard library, this package and installed packages are left out, unless a module belongs
    to one of the packages of ``modules``.

    Args:
        modules: names of modules that can be imported.
    """
    packages = {name.partition(".")[0] for name in modules}
    waiting, files = list(modules), dict[str, Path | None]()
    while waiting:
        name = waiting.pop()
        if name in files or (name.partition(".")[0] not in packages and _is_foreign(name)):
            continue
        file = files[name] = _find_file(name)
        if file is not None:
            waiting += [name.rpartition(".")[0], *_imported_names(name, file)]
    digest = hashlib.sha256()
    for name, file in sorted(files.items()):
        if file is not None:
            digest.update(name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def _find_file(name: str) -> Path | None:
    """Return the file of a module; None if the module has no file, as with built-in modules."""
    try:
        spec = sys.modules[name].__spec__ if name in sys.modules else importlib.util.find_spec(name)
    except (ImportError, AttributeError, ValueError):  # for instance because it is a function
        return None
    return Path(spec.origin) if spec is not None and spec.has_location and spec.origin else None


def _is_foreign(name: str) -> bool:
    """Return whether a module belongs to someone other than the user.

    The first package is checked first, because looking up a module imports its package.
    """
    first = name.partition(".")[0]
    files = filter(None, map(_find_file, (first, name)))
    return first in _NO_USERS or any(not _PACKAGES.isdisjoint(file.parts) for file in files)


def _imported_names(name: str, file: Path) -> Iterator[str]:
    """Yield the modules that a module imports, and the imported names, which can also be modules.

    Args:
        name: name of the module.
        file: file of the module; only Python's source is read.
    """
    package = name if file.stem == "__init__" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(file.read_bytes() if file.suffix == ".py" else b"")):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".") if node.level else []
            parents = parents[: len(parents) - node.level + 1]
            base = ".".join([*parents, *filter(None, [node.module])])
            yield from (base, *(f"{base}.{alias.name}" for alias in node.names))
