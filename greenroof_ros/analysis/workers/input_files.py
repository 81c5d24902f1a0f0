"""The input files of tasks, which each worker receives once rather than with every task."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from greenroof_ros.base.files import add_path_to_errors


def write_inputs(files: Mapping[str, bytes], directory: Path) -> None:
    """Write the input files to a directory from which tasks read them.

    Args:
        files: contents of the files, by name.
        directory: the directory.
    """
    for name, content in files.items():
        with add_path_to_errors(directory / name):
            (directory / name).write_bytes(content)
