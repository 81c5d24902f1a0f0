"""The input files of tasks; each worker gets them once, and not with each task."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from greenroof_ros.common.files import add_path_to_errors


def write_inputs(files: Mapping[str, bytes], directory: Path) -> None:
    """Write the contents of input files, by name, to a directory, where tasks read them."""
    for name, content in files.items():
        with add_path_to_errors(directory / name):
            (directory / name).write_bytes(content)
