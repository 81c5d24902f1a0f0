"""Progress where there is no terminal."""

from __future__ import annotations

import time

import pytest

from greenroof_ros.common.progress_lines import ProgressLines


def test_a_line_every_ten_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Told every second for 35 s: what was told at 10, 20 and 30 s is printed."""
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    lines = ProgressLines()
    for second in range(36):
        now = 1000.0 + second
        lines.tell(f"{second} s")
    assert capsys.readouterr().err == "10 s\n20 s\n30 s\n"
