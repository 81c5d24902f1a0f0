"""Time limits of a live site: for a controller's decision, and for a silent process."""

from __future__ import annotations

# How long a controller may take to decide (s), or the tick if that is longer; and how much longer
# its process may be silent before the supervisor kills it. The pump stops by the command's age.
_DECIDING_S, _SILENT_S = 3.0, 2.0


def deciding_limit(tau: float) -> float:
    """Return how long a controller may take to decide (s), for a tick of tau (s)."""
    return max(_DECIDING_S, tau)


def silence_limit(tau: float) -> float:
    """Return how long a node may be silent before it is killed (s), for a tick of tau (s)."""
    return deciding_limit(tau) + _SILENT_S
