"""The console that prints tables and progress."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.text import Text

from greenroof_ros.base.text import escape


class PlainConsole(Console):
    """A console that shows every text as it is, since texts can come from files.

    Nothing in a text is markup, an emoji or a value to highlight, and control characters and
    direction marks are escaped in each of its lines.
    """

    def __init__(self, **settings: Any) -> None:
        """Create the console with the settings of rich, by default on standard output."""
        super().__init__(markup=False, emoji=False, highlight=False, **settings)

    def render_str(self, text: str, **settings: Any) -> Text:
        """Return a text, or a cell of a table, as it is printed."""
        return super().render_str("\n".join(map(escape, text.split("\n"))), **settings)
