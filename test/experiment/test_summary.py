"""The summary that a person reads at the end of a run."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from commands import run_command


@pytest.mark.parametrize(
    ("controller", "warned"),
    [(("onoff", "--fraction", "0.01"), True), (("lookahead", "--horizon", "12"), False)],
)
def test_too_many_starts(controller: tuple[str, ...], warned: bool, tmp_path: Path) -> None:
    """A dry afternoon: with a hundredth of the flow plain on/off starts the pumps every minute."""
    done = run_command(
        "simulate", "--controller", *controller, "--start", "2021-07-07T14:00", "--hours", "1",
        "--cistern", "57", "--roof", "3.144",
        cwd=tmp_path, env=dict(os.environ),
    )
    assert done.returncode == 0, done.stderr
    assert ("TOO MANY STARTS" in done.stdout) is warned
