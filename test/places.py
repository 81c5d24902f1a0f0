"""Where the tests find the checkout and their data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
CONFIG = CHECKOUT / "config"
DATA = CHECKOUT / "test" / "data"

Once = Callable[[str, Callable[[Path], object]], Path]
"""Fills the directory of a name, unless another worker has, and returns it: see ``once``."""
