"""Import paths of the tools: importing this puts the checkout, its test helpers and tools first.

A tool may run with a package installed elsewhere, or with none. Files that pytest collects get the
same paths from ``pythonpath`` in ``pyproject.toml``.
"""

from __future__ import annotations

import sys
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent

sys.path[:0] = [str(CHECKOUT), str(CHECKOUT / "test"), str(CHECKOUT / "tools")]
