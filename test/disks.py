"""Small disks, which fill up."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def disk_if_allowed(place: Path, size: str) -> Iterator[bool]:
    """Mount a disk of a size such as ``64k`` where that is allowed; say whether it was."""
    place.mkdir(parents=True, exist_ok=True)
    mounted = shutil.which("mount") is not None and not subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "greenroof_ros", str(place)],
        capture_output=True, check=False,
    ).returncode
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(place)], check=True)


@contextmanager
def small_disk(place: Path, size: str) -> Iterator[None]:
    """Mount a disk of a size such as ``64k``, or skip the test."""
    with disk_if_allowed(place, size) as mounted:
        if not mounted:
            pytest.skip("only root can mount a small disk")
        yield
