"""Where tools import from: importing this puts the checkout, its tests' helpers and tools first.

A tool may be run with a package installed from elsewhere, or with none. What pytest collects has
the same from ``pythonpath`` in ``pyproject.toml``.
"""

from __future__ import annotations

import sys
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent

sys.path[:0] = [str(CHECKOUT), str(CHECKOUT / "test"), str(CHECKOUT / "tools")]
