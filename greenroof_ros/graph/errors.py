"""What ends a run."""

from __future__ import annotations


class LockstepError(Exception):
    """The graph cannot go on; the message names the topic and the node."""
