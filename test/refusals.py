"""What is said of a file or an option that is wrong."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from greenroof_ros.common.errors import ConfigurationError


def refusal(read: Callable[..., object], *arguments: object, match: str | None = None) -> str:
    """Return why reading does not go on; by the pattern, where there is one."""
    with pytest.raises(ConfigurationError, match=match) as caught:
        read(*arguments)
    return str(caught.value)
