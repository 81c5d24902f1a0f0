"""The command ``greenroof live``, which keeps a live site running."""

from __future__ import annotations

import atexit
import logging
from functools import partial

from greenroof_ros.base.command_line import EXIT_DONE, command
from greenroof_ros.bringup.start import bring_up
from greenroof_ros.live.live_site import LiveSite, make_parser, run_live


@command
def main() -> int:
    """Start the site, and keep it running until a signal stops it."""
    # A full disk does not count as a logging error: lines that do not fit are lost. There is no
    # flush at exit, which would block on a hung disk, and every line is flushed when it is written.
    logging.raiseExceptions = False
    atexit.unregister(logging.shutdown)
    arguments = make_parser().parse_args()
    site = LiveSite(arguments)
    return bring_up(arguments, partial(run_live, site, arguments), EXIT_DONE)
