"""The names of controllers and of their settings, for people."""

from __future__ import annotations

import math
from collections.abc import Sequence

from greenroof_ros.recording.results_table import differing
from greenroof_ros.report.entries import RunEntry, parameter_text

PAPERS_CONTROLLERS = {"mpc": "MPC", "onoff": "on/off"}


def controller_name(name: str) -> str:
    """Return a controller's name for people."""
    return " ".join(PAPERS_CONTROLLERS.get(word, word) for word in name.split("_"))


class Settings:
    """The names of one controller's runs: the parameters that differ, or were changed in a run.

    Attributes:
        title: what a label gives, the parameter's name where there is just one.
        labels: all labels, in the order of their values.
        axis: the one numeric parameter that differs; empty if there is none, or more than one, or
            one was changed in a run.
        log: whether it spans so much that its axis is logarithmic.
    """

    def __init__(self, entries: Sequence[RunEntry]) -> None:
        changed = {change.parameter for entry in entries for change in entry.changes}
        apart = differing([entry.parameters for entry in entries])
        apart += sorted(changed.difference(apart))
        self._shown = apart or list(entries[0].parameters)[:1]
        self.title = self._shown[0] if len(self._shown) == 1 else "setting"
        numbers = [entry.parameters.get(self.title) for entry in entries]
        floats = [number for number in numbers if isinstance(number, float)]
        fixed = len(floats) == len(numbers) and not changed
        self.axis = self.title if len(apart) == 1 and fixed else ""
        self.log = bool(self.axis) and min(floats) > 0 and max(floats) / min(floats) > 20
        keys = sorted({self._key(entry) for entry in entries})
        self.labels = list(dict.fromkeys(label for _, label in keys))

    def _key(self, entry: RunEntry) -> tuple[tuple[tuple[float, str], ...], str]:
        order = []
        for name in self._shown:
            value = entry.parameters.get(name)
            if isinstance(value, float):
                order.append((value, ""))
            else:
                order.append((math.inf, str(value)))
        return tuple(order), self.label(entry)

    def label(self, entry: RunEntry) -> str:
        """Return the setting of a run, as it differs from the controller's others."""
        if not self._shown:
            return entry.name
        if len(self._shown) == 1:
            return _text(entry, self.title)
        return ", ".join(f"{name} {_text(entry, name)}" for name in self._shown)

    def full_label(self, entry: RunEntry) -> str:
        """Return the label with the parameter's name."""
        label = self.label(entry)
        return f"{self.title} {label}" if len(self._shown) == 1 else label


def _text(entry: RunEntry, name: str) -> str:
    """Return a parameter of a run, with what it became in the run."""
    changes = "".join(str(change) for change in entry.changes if change.parameter == name)
    return parameter_text(entry.parameters.get(name)) + changes
