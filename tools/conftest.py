"""The campaigns' processes inherit what the tests' processes do."""

from __future__ import annotations

from inherited import no_state_of_the_user, pytest_configure

__all__ = ["no_state_of_the_user", "pytest_configure"]
