"""How live bringup ends by a mistake in itself."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from greenroof_ros.bringup import live
from greenroof_ros.common.standard_error import LINES


def test_a_mistake_is_said_with_its_traceback(capfd: pytest.CaptureFixture[str]) -> None:
    """As all else, by the thread: the interpreter would wait for who reads standard error."""
    kept: list[tuple[str, ...]] = []
    record: Any = SimpleNamespace(write=lambda *what: kept.append(what), wait=lambda: None)
    supervisor: Any = SimpleNamespace(may_run="")
    with pytest.raises(ValueError, match="a mistake") as caught:
        raise ValueError("a mistake")
    assert live._end(record, supervisor, caught.value) == 1
    assert LINES.wait(60)
    assert kept == [("failed", "ValueError: a mistake")]
    first, second, *_, last = capfd.readouterr().err.splitlines()
    assert (first, last) == ("error: ValueError: a mistake", "ValueError: a mistake")
    assert second.startswith("Traceback")
