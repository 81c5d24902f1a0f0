"""The lock that keeps two bringups out of one namespace, where everybody may write."""

from __future__ import annotations

from pathlib import Path

import pytest

from greenroof_ros.common.errors import ConfigurationError, OccupiedError
from greenroof_ros.graph import domain
from greenroof_ros.graph.domain import only_bringup


def test_a_lock_that_is_a_link_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another user could lay it there, and have a file of this user's emptied."""
    monkeypatch.setattr(domain, "_LOCKS", tmp_path)
    monkeypatch.setenv("ROS_DOMAIN_ID", "84")
    with only_bringup("/site1"):
        (lock,) = tmp_path.iterdir()
        with pytest.raises(OccupiedError), only_bringup("/site1"):
            pass
    lock.unlink()
    file = tmp_path / "file"
    file.write_text("of this user")
    lock.symlink_to(file)
    with pytest.raises(ConfigurationError, match="cannot be opened"), only_bringup("/site1"):
        pass
    assert file.read_text() == "of this user"
