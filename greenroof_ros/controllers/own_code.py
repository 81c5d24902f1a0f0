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
    waiting, seen, sources = list(modules), set[str](), dict[str, bytes]()
    while waiting:
        name = waiting.pop()
        if name in seen or (name.partition(".")[0] not in packages and _is_foreign(name)):
            continue
        seen.add(name)
        file = _find_file(name)
        if file is None:
            continue
        sources[name] = file.read_bytes()
        parent = name.rpartition(".")[0]
        waiting.append(parent)
        if file.suffix == ".py":
            waiting += _imported_names(sources[name], name if file.stem == "__init__" else parent)
    digest = hashlib.sha256()
    for name in sorted(sources):
        digest.update(name.encode() + b"\0" + sources[name] + b"\0")
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


def _imported_names(source: bytes, package: str) -> Iterator[str]:
    """Yield the modules that a source imports, and the imported names, which can also be modules.

    Args:
        source: source text of a module.
        package: package from which relative imports start.
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".") if node.level else []
            parents = parents[: len(parents) - node.level + 1]
            base = ".".join([*parents, *filter(None, [node.module])])
            yield from (base, *(f"{base}.{alias.name}" for alias in node.names))
