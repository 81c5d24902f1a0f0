"""Where the tests find the checkout and their data."""

from __future__ import annotations

from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
CONFIG = CHECKOUT / "config"
DATA = CHECKOUT / "test" / "data"
