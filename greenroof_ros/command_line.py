"""What every command has in common: its exit codes and how it reports a mistake."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import NoReturn

from greenroof_ros.errors import ConfigurationError

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130


def command(main: Callable[[], int]) -> Callable[[], NoReturn]:
    """Make a function a command: it exits with the code that the function returns.

    A :class:`ConfigurationError` becomes one line on standard error and exit code 2, a file that
    cannot be written likewise 1, and Ctrl-C exit code 130; none leaves a traceback.
    """

    @functools.wraps(main)
    def wrapper() -> NoReturn:
        try:
            code = main()
        except ConfigurationError as error:
            print(f"error: {error}", file=sys.stderr)
            code = EXIT_USAGE
        except OSError as error:
            print(f"error: {error.filename or ''}: {error.strerror}", file=sys.stderr)
            code = EXIT_FAILED
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            code = EXIT_INTERRUPTED
        sys.exit(code)

    return wrapper
