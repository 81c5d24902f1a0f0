"""The file that a command writes."""

from __future__ import annotations

import os
from pathlib import Path

from greenroof_ros.base.errors import ConfigurationError


def refuse_unwritable(file: Path, *endings: str) -> None:
    """Reject a file for ``--output`` that has the wrong extension, exists, or cannot be written.

    Args:
        file: the file to write.
        endings: the allowed file extensions, such as ``.html``.

    Raises:
        ConfigurationError: if the file has the wrong extension, already exists, or cannot be
            written.
    """
    def error(expected: str) -> ConfigurationError:
        return ConfigurationError(expected, key="--output", value=str(file))

    if file.suffix not in endings:
        raise error(f"must be a file name that ends in {' or '.join(endings)}")
    if not (file.parent.is_dir() and os.access(file.parent, os.W_OK)):
        raise error("must be in an existing, writable directory")
    if file.exists():
        raise error("exists; choose another file name")
