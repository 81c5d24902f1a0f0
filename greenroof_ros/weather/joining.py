"""Which weather files are meant."""

from __future__ import annotations

import glob
from collections.abc import Iterable
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError


def find_files(names: Iterable[str], key: str, directory: Path = Path()) -> list[Path]:
    """Return the files that names and patterns (``data/2021_*.csv``) stand for, each once.

    A name that is not that of a file is a pattern where it has ``*``, ``?`` or ``[``.

    Args:
        names: of files, relative to the directory.
        key: option or parameter that has them, for messages.
        directory: from which they are seen.

    Raises:
        ConfigurationError: a pattern matches no file, or there are no names.
    """
    found: list[Path] = []
    for name in names:
        path = directory / name
        matches = [path]
        if not path.exists() and glob.has_magic(name):
            matches = [Path(match) for match in sorted(glob.glob(str(path)))]  # noqa: PTH207
            if not matches:
                raise ConfigurationError("matches no file", key=key, value=name)
        found += [match for match in matches if match not in found]
    if not found:
        raise ConfigurationError("must name at least one file", key=key)
    return found
