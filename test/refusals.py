"""The reasons why a wrong file or option is refused."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from greenroof_ros.base.errors import ConfigurationError


def refusal(read: Callable[..., object], *arguments: object, match: str | None = None) -> str:
    """Return why reading is refused; the reason must match the pattern, if there is one."""
    with pytest.raises(ConfigurationError, match=match) as caught:
        read(*arguments)
    return str(caught.value)
