"""Long runs with a simulated drive: ``python tools/endurance loop`` and ``... live``.

loop: compares hardware in the loop with the pure simulation, by volume pumped and deviation.
live: a live site; nodes are killed, controllers changed, and a disk is full for a while. Compares
the pumped volume with the simulation, and lists incidents and the resources of each process.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

from endurance.live import LiveRun
from endurance.loop import HEAD, in_the_loop
from graphs import reserved_domain


def main() -> None:
    """Do a long run and print the results."""
    parser = argparse.ArgumentParser(
        prog="python tools/endurance", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("way", choices=("loop", "live"))
    parser.add_argument("--controller", nargs="+", help="loop: mpc and lookahead; live: four")
    parser.add_argument("--minutes", type=float, default=60.0, help="default: %(default)s")
    parser.add_argument("--speed", type=float, default=1.0, help="loop: times real time")
    parser.add_argument("--drive", default="danfoss_fc202", help="default: %(default)s")
    parser.add_argument("--line", choices=("tcp", "pty"), default="tcp", help="loop")
    parser.add_argument(
        "--kill-every", type=float, default=120.0, metavar="S",
        help="live: interval of kills; 0: none (default: %(default)s)",
    )
    parser.add_argument("--full-disk", action="store_true", help="live: needs root")
    parser.add_argument("--output", type=Path, metavar="DIR", help="new directory for the results")
    options = parser.parse_args()
    directory = (options.output or Path(tempfile.mkdtemp(prefix="endurance-"))).resolve()
    directory.mkdir(parents=True, exist_ok=True)
    print(f"in {directory}", flush=True)
    with reserved_domain() as domain:
        if options.way == "loop":
            print(HEAD, flush=True)
            for controller in options.controller or ("mpc", "lookahead"):
                (directory / controller).mkdir()
                print(in_the_loop(
                    directory / controller, domain, controller, options.minutes / 60, options.speed,
                    options.drive, options.line,
                ), flush=True)
        else:
            with LiveRun(directory, domain, options.drive, full_disk=options.full_disk) as run:
                run.run(
                    options.minutes,
                    options.controller or ("mpc", "lookahead", "anticipating_onoff", "onoff"),
                    options.kill_every or float("inf"),
                )
                report = run.report()
            (directory / "report.md").write_text(f"{report}\n")
            print(report)


if __name__ == "__main__":
    main()
