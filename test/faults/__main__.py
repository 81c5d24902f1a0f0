"""The campaign of seeded faults: ``make faults``, or ``python test/faults``.

More than a thousand cases: each node and program killed, ended and stopped; every topic and every
Modbus exchange off, stuck, garbage, wrong, slow, delayed and intermittent; sensors, drives,
weather, intruders. A rig (a live site, a pump node alone, hardware in the loop, a simulation)
serves for many. Results are lines of JSON; what is there is not done again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent.parent)]

import pytest  # noqa: E402
from cases import all_cases, sample  # noqa: E402
from graphs import environment  # noqa: E402
from table import put_table, table  # noqa: E402

SEED = 1
# A worker that takes longer for a case, or for the readers, hangs (s).
_CASE_LIMIT_S = 1200


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python test/faults", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--only", metavar="ID", nargs="+", default=[],
        help="only these cases; the beginning of an id, up to a /, stands for all that have it",
    )
    parser.add_argument(
        "--seed", type=int, default=SEED, help="of all that is random (default: %(default)s)"
    )
    parser.add_argument(
        "--lanes", type=int, default=4,
        help="workers of pytest side by side, which mostly wait (default: %(default)s)",
    )
    parser.add_argument(
        "--results", type=Path, default=Path("runs/faults"), metavar="DIR",
        help="where the results are, and what the rigs leave (default: %(default)s)",
    )
    parser.add_argument("--list", action="store_true", help="list the cases, and do none")
    parser.add_argument(
        "--every", type=int, default=1, metavar="N",
        help="only one in N cases, of each kind of fault in each way at least one",
    )
    parser.add_argument(
        "--table", type=Path, nargs="?", const=Path("-"), metavar="FILE",
        help="print the table of the results that are there, or put it between its markers in FILE",
    )
    return parser


def read_results(file: Path) -> dict[str, dict[str, object]]:
    """Return the last result of each case."""
    lines = file.read_text().splitlines() if file.exists() else []
    return {result["id"]: result for result in map(json.loads, lines)}


def _is_wanted(case: str, only: list[str]) -> bool:
    """Whether a case is one of those asked for, or in a family of them."""
    return not only or any(f"{case}/".startswith(f"{one.rstrip('/')}/") for one in only)


def do(ids: list[str], arguments: argparse.Namespace) -> None:
    """Have pytest do the cases that are named."""
    plan = arguments.results / "plan.json"
    plan.write_text(json.dumps(
        {"cases": ids, "seed": arguments.seed, "results": str(arguments.results)}
    ))
    for name in [name for name in os.environ if name.startswith("PYTEST_")]:
        del os.environ[name]  # of tests that do a sample
    os.environ |= environment(0) | {"GREENROOF_ROS_FAULTS": str(plan)}
    pytest.main([
        str(HERE / "campaign.py"), "--rootdir", str(HERE.parent.parent), "-q", "-rN",
        "-p", "no:cacheprovider", "-n", str(min(arguments.lanes, len(ids))), "--dist", "loadgroup",
        "-o", f"faulthandler_timeout={_CASE_LIMIT_S}", "-o", "faulthandler_exit_on_timeout=true",
    ])


def main() -> int:
    """Do what the command line asks for."""
    arguments = _parser().parse_args()
    arguments.results = arguments.results.resolve()
    file = arguments.results / "results.jsonl"
    results = read_results(file)
    if arguments.table:
        if str(arguments.table) == "-":
            print(table(results.values()))
        else:
            put_table(table(results.values()), arguments.table)
        return 0
    cases = [case for case in all_cases() if _is_wanted(case.id, arguments.only)]
    names = [case.id for case in sample(cases, arguments.every, arguments.seed)]
    if arguments.list:
        print(*names, sep="\n")
        return 0
    again = len(names) == 1  # a failure is replayed
    todo = [name for name in names if again or name not in results]
    print(f"{len(todo)} of {len(names)} cases to do", flush=True)
    if todo:
        arguments.results.mkdir(parents=True, exist_ok=True)
        do(todo, arguments)
    results = read_results(file)
    missing = [name for name in names if name not in results]
    failed = [name for name in names if name in results and results[name]["wrong"]]
    print(f"{len(names) - len(failed) - len(missing)} held, {len(failed)} failed, "
          f"{len(missing)} not done; to replay one: python test/faults --only ID "
          f"--seed {arguments.seed}")
    for name in failed:
        print(f"  {name}: {results[name]['wrong']}")
    return 1 if failed or missing else 0


if __name__ == "__main__":
    sys.exit(main())
