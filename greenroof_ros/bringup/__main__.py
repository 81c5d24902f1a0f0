"""Run the node graph in any of three ways: ``python -m greenroof_ros.bringup``, ``greenroof run``.

Simulated: :mod:`greenroof_ros.bringup.simulated`; with a drive in the loop, also
:mod:`greenroof_ros.live.in_the_loop`; a live site: :mod:`greenroof_ros.bringup.live`.
"""

from __future__ import annotations

import sys

from greenroof_ros.bringup import simulated
from greenroof_ros.common.command_line import Parser

make_parser = simulated.make_parser


def main() -> int:
    """Start the graph, watch it, and end it; ``--plant external`` is ``greenroof live``."""
    parser = Parser(prog="greenroof run", add_help=False)
    parser.add_argument("--plant", choices=["internal", "external"])
    arguments, sys.argv[1:] = parser.parse_known_args()
    if arguments.plant == "external":
        from greenroof_ros.bringup import live  # half of the imports, not needed otherwise

        return live.main()
    return simulated.main()


if __name__ == "__main__":
    main()
