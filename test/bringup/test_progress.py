"""The progress of a run."""

from __future__ import annotations

import io
import time

import pytest

from greenroof_ros.bringup.progress import RunProgress


def test_a_line_every_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """With progress every second for 35 s, there are lines at 10, 20 and 30 s, and no bar."""
    now, printed = 1000.0, io.StringIO()
    monkeypatch.setattr(time, "monotonic", lambda: now)
    progress = RunProgress(100, 60.0, printed)
    for second in range(36):
        now = 1000.0 + second
        progress.show_tick(second, 3.0, 0.04, 0.5)
    assert [line.split(", command 0.500")[0] for line in printed.getvalue().splitlines()] == [
        f"00:{second}:00, cistern 3.000 m, roof 0.0400 m" for second in (10, 20, 30)
    ]
