"""Where the tests find the checkout and their data, and what they read there."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from greenroof_ros.__main__ import COMMANDS
from greenroof_ros.base.errors import ConfigurationError

CHECKOUT = Path(__file__).resolve().parent.parent
CONFIG = CHECKOUT / "config"
DATA = CHECKOUT / "test" / "data"


def guarding(make: str, directory: Path) -> str:
    """Copy a maker's drive file, but with this time after power-up during which it does not guard.

    For tests of other things: with an ABB drive all of them would take 30 s longer. Returns the
    copy's path, which has the drive's name.
    """
    text = (CONFIG / "drives" / f"{make}.yaml").read_text(encoding="utf-8")
    directory.mkdir(parents=True, exist_ok=True)
    copy = directory / f"{make}.yaml"
    copy.write_text(
        re.sub(r"unguarded_after_power_up_s: \d+", "unguarded_after_power_up_s: 0", text),
        encoding="utf-8",
    )
    return str(copy)


_COMMANDS = {
    word: name.split() for name, entry in COMMANDS.items() for word in (entry.module, name)
}
_RIGS = ("drive_simulator", "site_simulator")


def words_of(module: str) -> list[str]:
    """Return what starts a module with ``python -m``: a command, a rig, or a node: nodes.plant."""
    if module in _RIGS:
        return ["rig_simulators", module]
    if module.startswith("other_limits."):
        return ["other_limits", *_COMMANDS[module.removeprefix("other_limits.")]]
    command = _COMMANDS.get(module)
    return [f"greenroof_ros.{module}"] if command is None else ["greenroof_ros.__main__", *command]


Once = Callable[[str, Callable[[Path], object]], Path]
"""Fills a named directory, unless another worker has, and returns it: see the ``once`` fixture."""


def refusal(read: Callable[..., object], *arguments: object, match: str | None = None) -> str:
    """Return why reading is refused; the reason must match the pattern, if there is one."""
    with pytest.raises(ConfigurationError, match=match) as caught:
        read(*arguments)
    return str(caught.value)
