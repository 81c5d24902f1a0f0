"""Files that a command is to write: refused before the work, where they could not be written."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError


def refuse_unwritable(file: Path, endings: Sequence[str], key: str) -> None:
    """Refuse a file that has none of some endings, is there already, or cannot be written.

    Args:
        file: to be written.
        endings: such as ``.html``.
        key: the option that names it.

    Raises:
        ConfigurationError: it is so.
    """
    def error(expected: str) -> ConfigurationError:
        return ConfigurationError(expected, key=key, value=str(file))

    if file.suffix not in endings:
        raise error(f"must be the name of a file that ends in {' or '.join(endings)}")
    if not (file.parent.is_dir() and os.access(file.parent, os.W_OK)):
        raise error("must be in a directory that exists and can be written to")
    if file.exists():
        raise error("exists; name another file")
