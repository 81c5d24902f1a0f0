"""What the processes of tests and campaigns inherit: signals, environment, no user state."""

from __future__ import annotations

import os
import signal

import pytest

# Compile the package once, not in each of a thousand processes, regardless of what the user has
# set.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A shell's background jobs ignore Ctrl-C, and the tests' commands would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
# With nohup they would also ignore the terminal's end.
if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda *_: None)


def pytest_configure(config: pytest.Config) -> None:
    """Leave Ctrl-C to the first process: it ends the workers, which print nothing about it."""
    if hasattr(config, "workerinput"):
        signal.signal(signal.SIGINT, lambda *_: None)  # children reset it


@pytest.fixture(autouse=True)
def no_state_of_the_user(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Keep tests out of the home directory and away from the drive state of other tests."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
