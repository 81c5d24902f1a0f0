"""Parts of a document, each of which is generated separately; see :class:`Parts`."""

from __future__ import annotations

import json
import traceback
from collections.abc import Callable
from typing import Any, TypeVar

from greenroof_ros.base.text import clean_text

_Part = TypeVar("_Part")
# Failures that were printed, once for each place in the code, since it fails again twice a second.
_PRINTED: set[str] = set()


class Parts:
    """Generator of a document's parts, which replaces a part that fails and keeps the others.

    Attributes:
        failed: reason for each failure, by the name of the part.
    """

    def __init__(self) -> None:
        """Start without any failures."""
        self.failed: dict[str, str] = {}

    def make(self, name: str, make: Callable[[], _Part], instead: Any) -> _Part:
        """Return a part, or its replacement if the part cannot be made or cannot be sent as JSON.

        The traceback of a failure is printed once for each location in the code.

        Args:
            name: name of the part, worded as the subject at the start of a sentence.
            make: function that makes the part.
            instead: replacement for a part that cannot be made.
        """
        try:
            part = make()
            json.dumps(part, allow_nan=False)
        except Exception as error:  # whatever the error, the stop and the other parts are shown
            self.failed[name] = clean_text(f"{type(error).__name__}: {error}", 200)
            text = traceback.format_exc()
            if text not in _PRINTED and len(_PRINTED) < 100:
                _PRINTED.add(text)
                traceback.print_exc()
            replacement: _Part = instead
            return replacement
        return part

    @property
    def notes(self) -> list[str]:
        """One sentence for each part that failed."""
        return [f"{name} cannot be shown ({why})." for name, why in self.failed.items()]
