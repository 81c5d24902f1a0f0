"""Give the campaigns' processes the same environment as the tests' processes."""

from __future__ import annotations

from inherited import no_state_of_the_user, pytest_configure

__all__ = ["no_state_of_the_user", "pytest_configure"]
