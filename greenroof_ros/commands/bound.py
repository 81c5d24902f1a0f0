"""Compute a lower bound that no controller can beat, even one that knows all weather in advance.

By default, the bound is on the total deviation. With --of discharge, for a site with an outlet
valve, it is on the discharge in wet weather, whatever the commands to the valve, for some amounts
of mains water and for the irrigation under on/off control.

Examples:
  greenroof bound --start 2021-07-08T05:00
  greenroof bound --of discharge --site my_site.yaml

Exit codes: 0 done, 1 no bound found, 2 bad usage or configuration
"""

from __future__ import annotations

from typing import Any

from greenroof_ros.base.command_line import Parser, command
from greenroof_ros.simulation.bound import BLOCK_S, bound_discharge, clairvoyant_bound
from greenroof_ros.simulation.loop import simulate
from greenroof_ros.simulation.options import add_site_arguments, build_run
from greenroof_ros.simulation.output import describe_setting
from greenroof_ros.simulation.run import Run
from greenroof_ros.simulation.screen import setting_rows, show

Bound = tuple[dict[str, Any], list[tuple[str, str, str]]]
"""a result, and its rows: a label, a number and a description"""


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("bound", __doc__)
    add_site_arguments(parser.add_argument_group("the run"))
    group = parser.add_argument_group("the bound")
    group.add_argument(
        "--of", choices=("deviation", "discharge"), default="deviation",
        help="quantity to bound (default: %(default)s)",
    )
    group.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser


@command
def main() -> None:
    """Compute the bound for the run that the command line describes."""
    arguments = make_parser().parse_args()
    run = build_run(arguments)
    find = _bound_discharge if arguments.of == "discharge" else _bound_deviation
    found, rows = find(run)
    result = {**found, **describe_setting(run)}
    title = f"Lower bound on the {arguments.of}"
    show(title, (*setting_rows(result), *rows), result, as_json=arguments.json)


def _bound_discharge(run: Run) -> Bound:
    """Find the minimum discharge in wet weather for every amount of mains water."""
    summary, trajectory = simulate(run, every=1)
    assert trajectory is not None
    own, mains = summary["wet_discharge_m3"], summary.get("mains_m3", 0.0)
    points = bound_discharge(run, trajectory)
    result = {
        "wet_discharge_m3": own, "mains_m3": mains,
        "frontier": [point._asdict() for point in points],
    }
    about = "m3 in wet weather, with {:.2f} m3 of mains water".format
    if run.site.mains_level is None:  # so its cost makes no difference
        about, points = "m3 in wet weather".format, points[:1]
    return result, [
        *(("bound", f"{point.wet_discharge_m3:.2f}", about(point.mains_m3)) for point in points),
        ("on/off", f"{own:.2f}", f"{about(mains)}; the bound uses the same irrigation"),
    ]


def _bound_deviation(run: Run) -> Bound:
    """Find the minimum total deviation."""
    bound = clairvoyant_bound(run, BLOCK_S)
    about = "m3, total deviation that no controller can beat"
    return {"bound_m3": bound}, [("bound", f"{bound:.2f}", about)]
