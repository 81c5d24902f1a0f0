"""The file that a command writes."""

from __future__ import annotations

import os
from pathlib import Path

from greenroof_ros.base.command_line import refuse


def refuse_unwritable(file: Path, *endings: str) -> None:
    """Reject a file for ``--output`` that has the wrong extension, exists, or cannot be written.

    Args:
        file: the file to write.
        endings: the allowed file extensions, such as ``.html``.

    Raises:
        ConfigurationError: if the file has the wrong extension, already exists, or cannot be
            written.
    """
    writable = file.parent.is_dir() and os.access(file.parent, os.W_OK)
    wrong = {
        f"must be a file name that ends in {' or '.join(endings)}": file.suffix not in endings,
        "must be in an existing, writable directory": not writable,
        "exists; choose another file name": file.exists(),
    }
    refuse(*((broken, "--output", str(file), text) for text, broken in wrong.items()))
