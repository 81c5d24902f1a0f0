"""Long runs with a simulated drive: ``python tools/endurance loop`` and ``... live``.

loop: hardware in the loop beside the pure simulation, the volume pumped and the deviation.
live: a live site; nodes are killed, controllers changed, a disk is full for a while. What it pumped
beside the simulation, its incidents, and what each process took of the machine.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

from endurance.live import LiveRun, Plan
from endurance.loop import HEAD, in_the_loop
from graphs import own_domain

CONTROLLERS = ("mpc", "lookahead", "anticipating_onoff", "onoff")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python tools/endurance", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("way", choices=("loop", "live"))
    parser.add_argument("--controller", nargs="+", help="loop: mpc and lookahead; live: four")
    parser.add_argument("--minutes", type=float, default=60.0, help="default: %(default)s")
    parser.add_argument("--speed", type=float, default=1.0, help="loop: simulated per real time")
    parser.add_argument("--drive", default="danfoss_fc202", help="default: %(default)s")
    parser.add_argument("--line", choices=("tcp", "pty"), default="tcp", help="loop")
    parser.add_argument(
        "--kill-every", type=float, default=120.0, metavar="S",
        help="live: 0 for never (default: %(default)s)",
    )
    parser.add_argument("--full-disk", action="store_true", help="live: needs root")
    parser.add_argument("--output", type=Path, metavar="DIR", help="what it leaves (a new one)")
    return parser


def main() -> int:
    """Do a long run and print what came of it."""
    arguments = _parser().parse_args()
    directory = arguments.output or Path(tempfile.mkdtemp(prefix="endurance-"))
    directory.mkdir(parents=True, exist_ok=True)
    print(f"in {directory}", flush=True)
    with own_domain() as domain, ExitStack() as stack:
        if arguments.way == "loop":
            print(HEAD, flush=True)
            for controller in arguments.controller or ("mpc", "lookahead"):
                place = directory / controller
                place.mkdir()
                print(in_the_loop(
                    place, domain, controller, arguments.minutes / 60, arguments.speed,
                    arguments.drive, arguments.line,
                ), flush=True)
            return 0
        plan = Plan(
            arguments.minutes, tuple(arguments.controller or CONTROLLERS), arguments.kill_every,
            arguments.full_disk, arguments.drive,
        )
        run = LiveRun(directory.resolve(), domain, plan, stack)
        run.run()
        report = run.report()
        (directory / "report.md").write_text(report + "\n")
        print(report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
