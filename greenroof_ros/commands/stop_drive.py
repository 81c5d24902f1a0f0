"""Command a drive or a relay to stop, and wait until its pump stands still.

The command needs no ROS, and works after the site's program has died: the systemd service calls it
whenever the site ends. A drive that another program controls is left alone.

Example:
  greenroof stop-drive --drive danfoss_fc202 --drive-at gateway://192.168.7.20:502

Exit codes: 0 the pump is stopped, 1 the pump may be running, 2 bad usage or configuration
"""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_FAILED, Parser, command
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.live.devices.exchange import read_endpoint, stop_drive
from greenroof_ros.live.live_site import add_drive, read_drive


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("stop-drive", __doc__, "--drive NAME --drive-at ADDRESS [options]")
    add_drive(parser)
    return parser


@command
def main() -> int:
    """Stop the drive named on the command line."""
    parser = make_parser()
    arguments = parser.parse_args()
    if not arguments.drive:
        parser.error("--drive and --drive-at are required")
    file, at, *broker = read_drive(arguments).values()
    try:
        status = stop_drive(read_endpoint(Path(file), at, "--drive-at", *broker))
    except ConfigurationError:
        raise
    except Exception as error:  # whatever it is, someone must look at the pump
        print(f"THE PUMP MAY BE RUNNING: {error}")
        return EXIT_FAILED
    print(f"{'' if status.at_rest else 'THE PUMP MAY BE RUNNING: '}the drive reports: {status}")
    return EXIT_DONE if status.at_rest else EXIT_FAILED
