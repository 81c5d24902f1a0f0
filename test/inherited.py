"""What the processes of tests and campaigns inherit: signals, environment, and no user's state."""

from __future__ import annotations

import os
import signal

import pytest

# A thousand processes that import the package need not compile it each, whatever the user has set.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# What a shell starts in its background ignores Ctrl-C, and so would the commands of the tests.
signal.signal(signal.SIGINT, signal.default_int_handler)
# Under nohup they would ignore the end of the terminal.
if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda *_: None)


def pytest_configure(config: pytest.Config) -> None:
    """Let Ctrl-C be for the first process alone: it ends the workers, which print nothing of it."""
    if hasattr(config, "workerinput"):
        signal.signal(signal.SIGINT, lambda *_: None)  # what they start has its own again


@pytest.fixture(autouse=True)
def no_state_of_the_user(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No test may find or leave anything in the home directory, nor of a drive of another test."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
