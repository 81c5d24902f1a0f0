"""The versions of the software that computes a run's numbers."""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

from greenroof_ros import __version__


def versions() -> dict[str, str]:
    """Return the versions of the software that computes a run's numbers.

    ``source`` is a hash of this package's source files. It is not a commit, since an installed
    package does not know its commit, and changed files have none.
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
            continue  # rclpy, if there is no ROS
    return result


def versions_text(by_name: Mapping[str, str]) -> str:
    """Write versions for people, with the hash under a name that they understand."""
    names = {"source": "hash of its source files"}
    return ", ".join(f"{names.get(name, name)} {version}" for name, version in by_name.items())


@functools.cache
def _source() -> str:
    """Return twelve digits that identify this package's code; a version has many commits."""
    digest = hashlib.sha256()
    package = Path(__file__).resolve().parent.parent
    for file in sorted(package.rglob("*.py")):
        digest.update(file.relative_to(package).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()[:12]
