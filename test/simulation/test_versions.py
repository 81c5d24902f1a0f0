"""What a run records about the code that computed it."""

from __future__ import annotations

import hashlib
from pathlib import Path

import greenroof_ros
from greenroof_ros.simulation.summary import format_versions, versions


def test_the_source_is_a_hash_and_the_version_reports_it() -> None:
    """A hash of the names and contents of all Python files, in order; not a commit."""
    package = Path(greenroof_ros.__file__).resolve().parent
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        digest.update(file.relative_to(package).as_posix().encode() + file.read_bytes())
    by_name = versions()
    assert by_name["source"] == digest.hexdigest()[:12]
    assert format_versions(by_name).startswith(
        f"greenroof_ros {greenroof_ros.__version__}, hash of its source files {by_name['source']}, "
    )
