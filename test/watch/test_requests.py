"""The commands that make requests to the pump and the valve: what they request, and of whom."""

from __future__ import annotations

import sys
import time
from unittest.mock import MagicMock

import pytest

from greenroof_ros.__main__ import COMMANDS
from greenroof_ros.commands import requests


@pytest.mark.parametrize(("name", "options", "made"), [
    ("hold", "--for 48", [("stop", "pump", 172_800)]), ("release", "", [("release", "pump", 0)]),
    ("outlet close", "--for 2d", [("stop", "valve", 172_800)]),
    ("outlet open", "--for 30min", [("open", "valve", 1800)]), ("outlet open", "--for 3x", []),
    ("outlet reset", "--yes", [("reset", "valve", 0)]),
])
def test_a_command_makes_its_request(
    monkeypatch: pytest.MonkeyPatch, name: str, options: str, made: list[tuple[str, str, int]]
) -> None:
    now, graph = time.time(), MagicMock()
    monkeypatch.setattr(requests, "GraphClient", graph)
    monkeypatch.setattr(sys, "argv", [name, *options.split()])
    with pytest.raises(SystemExit) as end:
        COMMANDS[name].load().main()
    calls = graph.return_value.request.call_args_list
    assert end.value.code == (0 if made else 2)
    assert [(action, role) for (action, _, role), _ in calls] == [each[:2] for each in made]
    for (_, given), (*_, seconds) in zip(calls, made, strict=True):
        assert given.get("until", now) == pytest.approx(now + seconds, abs=60)
