"""The versions of what computes a run's numbers."""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

from greenroof_ros import __version__


def versions() -> dict[str, str]:
    """Return the versions of what computes a run's numbers.

    ``source`` is a hash of this package's source files: no commit, since an installed package knows
    none, and a file that was changed has none.
    """
    result = {
        "greenroof_ros": __version__,
        "source": _source(),
        "python": platform.python_version(),
    }
    for package in ("numpy", "scipy", "osqp", "eto", "mcap", "rclpy"):
        try:
            result[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue  # rclpy, where there is no ROS
    return result


def versions_text(by_name: Mapping[str, str]) -> str:
    """Write versions for people, who know no hash of ours by its name."""
    names = {"source": "hash of its source files"}
    return ", ".join(f"{names.get(name, name)} {version}" for name, version in by_name.items())


@functools.cache
def _source() -> str:
    """Twelve digits that identify this package's code; a version has many commits."""
    digest = hashlib.sha256()
    package = Path(__file__).resolve().parent.parent
    for file in sorted(package.rglob("*.py")):
        digest.update(file.relative_to(package).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()[:12]
