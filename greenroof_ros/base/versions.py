"""The version of this package, and of the other software that determines the results of a run."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from pathlib import Path

__version__ = "1.0.0"


@functools.cache
def versions() -> Mapping[str, str]:
    """Return the versions of the software that determines the results of a run.

    ``source`` is twelve digits of a hash of this package's source files rather than a commit,
    because an installed package does not know its commit, and edited files do not belong to any.
    """
    import platform  # these take long, and the help of commands needs neither
    from importlib import metadata

    digest, root = hashlib.sha256(), Path(__file__).resolve().parent.parent
    for file in sorted(root.rglob("*.py")):
        digest.update(file.relative_to(root).as_posix().encode() + file.read_bytes())
    result = {
        "greenroof_ros": __version__,
        "source": digest.hexdigest()[:12],
        "python": platform.python_version(),
    }
    for package in ("numpy", "scipy", "osqp", "eto", "mcap", "rclpy"):
        try:
            result[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue  # rclpy, if there is no ROS
    return result


def format_versions(by_name: Mapping[str, str]) -> str:
    """Return versions as human-readable text, with an intelligible name for the hash."""
    names = {"source": "hash of its source files"}
    return ", ".join(f"{names.get(name, name)} {version}" for name, version in by_name.items())
