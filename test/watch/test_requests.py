"""The commands that make requests to the pump and the valve: what they request, and of whom."""

from __future__ import annotations

import sys
import time
from typing import Any

import pytest

from greenroof_ros.__main__ import COMMANDS
from greenroof_ros.commands import requests


@pytest.mark.parametrize(("line", "request_", "seconds"), [
    ("hold --for 48", ("stop", "pump"), 172_800), ("release", ("release", "pump"), None),
    ("outlet close --for 2d", ("stop", "valve"), 172_800),
    ("outlet open --for 30min", ("open", "valve"), 1800),
    ("outlet open --for 45s", ("open", "valve"), 45),
    ("outlet release", ("release", "valve"), None), ("outlet reset --yes", ("reset", "valve"), None),
    ("outlet open --for 30m", None, None), ("outlet open", None, None),
])
def test_a_command_makes_its_request(
    monkeypatch: pytest.MonkeyPatch, line: str, request_: tuple[str, str] | None,
    seconds: float | None,
) -> None:
    made: list[tuple[str, str]] = []

    class Client:
        def __init__(self, *_: Any) -> None:
            """Join no graph."""

        def request(self, action: str, _: float, role: str, **given: Any) -> str:
            made.append((action, role))
            assert ("until" in given) == (seconds is not None)
            assert abs(given.get("until", 0.0) - time.time() - (seconds or 0.0)) < 60 or not seconds
            return "done"

        def close(self) -> None:
            """Leave none."""

    monkeypatch.setattr(requests, "GraphClient", Client)
    name = next(name for name in COMMANDS if f"{line} ".startswith(f"{name} "))
    monkeypatch.setattr(sys, "argv", [name, *line.removeprefix(name).split()])
    with pytest.raises(SystemExit) as end:
        COMMANDS[name].load().main()
    assert (end.value.code, made) == ((0, [request_]) if request_ else (2, []))
