"""Put the checkout, its test helpers and its tools first on the import path.

A tool may run while the package is installed elsewhere, or not at all. For files that pytest
collects, ``pythonpath`` in ``pyproject.toml`` sets the same paths.
"""

from __future__ import annotations

import sys
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent

sys.path[:0] = [str(CHECKOUT / place) for place in ("", "test", "test/rigs", "tools")]
