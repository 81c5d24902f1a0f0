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
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent.parent)]

from cases import Case, all_cases, sample  # noqa: E402
from graphs import Process, environment  # noqa: E402

from greenroof_ros.common.processes import asked_to_end_with_this, end_with_parent  # noqa: E402

SEED = 1
# So many cases a worker does: what a rig gathers ends with it.
_BATCH = {"simulated": 10, "readers": 3}
_USUAL_BATCH = 40
# What keeps the processors busy, or lasts: of each only one lane does it at a time.
_ALONE = {"simulated": "simulated", "readers": "readers"}
# A worker that takes longer for a case hangs (s).
_CASE_LIMIT_S = 300.0


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
        help="rigs side by side, which mostly wait (default: %(default)s)",
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
    parser.add_argument("--worker", nargs=2, help=argparse.SUPPRESS)
    return parser


def read_results(file: Path) -> dict[str, dict[str, object]]:
    """Return the last result of each case."""
    results = {}
    if file.exists():
        for line in file.read_text().splitlines():
            result = json.loads(line)
            results[result["id"]] = result
    return results


def batches(cases: list[Case], seed: int) -> list[list[Case]]:
    """Return cases of one rig together, few enough for one worker."""
    by_rig: dict[str, list[Case]] = {}
    for case in cases:
        by_rig.setdefault(case.rig, []).append(case)
    found = []
    for rig, those in by_rig.items():
        size = _BATCH.get(rig, _USUAL_BATCH)
        if rig == "readers":
            those.sort(key=lambda case: case.number)
        else:  # a node that is killed again soon waits longer for its next start
            random.Random(seed).shuffle(those)
        # What stops nothing begins when the pump has run for a while, so the next can follow at
        # once; what ends a rig comes last, so that the others share one.
        parts = [those[at:at + size] for at in range(0, len(those), size)]
        for part in parts if rig != "readers" else ():
            part.sort(key=lambda case: (
                case.expected.recovery == "ends", case.expected.stops is not False
            ))
        found += parts
    # What is done one at a time, then long ones first, so that the lanes end together.
    return sorted(
        found, key=lambda part: (part[0].rig in _ALONE, _expected_s(part)), reverse=True
    )


def _expected_s(batch: list[Case]) -> float:
    """Return about how long a batch takes (s)."""
    if batch[0].rig == "readers":
        return 400.0
    alone = batch[0].rig in _ALONE
    return sum(
        25.0 if not alone and case.expected.recovery == "ends"
        else {"cistern frozen": 40.0, "roof frozen": 100.0, "drift": 110.0, "undelivered": 100.0,
              "frost": 65.0, "gauge": 65.0}.get(case.expected.bound, 9.0)
        for case in batch
    )


def take(queue: list[list[Case]], running: list[str]) -> list[Case] | None:
    """Return the next batch that may run beside those that do; None where there is none now."""
    for number, batch in enumerate(queue):
        kind = _ALONE.get(batch[0].rig, "")
        if not kind or kind not in running:
            running.append(kind)
            return queue.pop(number)
    return None


def _work(arguments: argparse.Namespace) -> None:
    """Be a worker: do one batch, and end."""
    end_with_parent()
    from worker import work

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: sys.exit(143))
    ids, place = map(Path, arguments.worker)
    try:
        work(ids, place, arguments.results / "results.jsonl", arguments.seed)
    except Exception:
        traceback.print_exc()
    finally:
        Process.end_all()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)  # the middleware may hang in taking itself down


def lane(
    queue: list[list[Case]], running: list[str], lock: threading.Lock,
    arguments: argparse.Namespace,
) -> None:
    """Give batches to workers, one after the other."""
    while queue:
        with lock:
            batch = take(queue, running)
        if batch is None:
            time.sleep(0.5)
            continue
        with lock:
            place = Path(tempfile.mkdtemp(prefix="batch-", dir=arguments.results))
        names = place / "cases.json"
        names.write_text(json.dumps([case.id for case in batch]))
        environ = {**asked_to_end_with_this(), **environment(0)}
        worker = subprocess.Popen(
            [sys.executable, str(HERE), "--seed", str(arguments.seed), "--results",
             str(arguments.results), "--worker", str(names), str(place)],
            env=environ, stderr=(place / "worker.err").open("w"),
        )
        try:
            worker.wait(_CASE_LIMIT_S * (len(batch) + 2))
        except subprocess.TimeoutExpired:
            print(f"FAILED a worker hangs: {place}", flush=True)
            worker.kill()
        with lock:
            running.remove(_ALONE.get(batch[0].rig, ""))
        results = read_results(arguments.results / "results.jsonl")
        if all(not results.get(case.id, {"wrong": "x"})["wrong"] for case in batch):
            shutil.rmtree(place, ignore_errors=True)


def _is_wanted(case: str, only: list[str]) -> bool:
    """Whether a case is one of those asked for, or in a family of them."""
    return not only or any(f"{case}/".startswith(f"{one.rstrip('/')}/") for one in only)


def main() -> int:
    """Do what the command line asks for."""
    arguments = _parser().parse_args()
    arguments.results = arguments.results.resolve()
    if arguments.worker:
        _work(arguments)
    results = read_results(arguments.results / "results.jsonl")
    if arguments.table:
        from table import put_table, table

        if str(arguments.table) == "-":
            print(table(results.values()))
        else:
            put_table(table(results.values()), arguments.table)
        return 0
    cases = [case for case in all_cases() if _is_wanted(case.id, arguments.only)]
    cases = sample(cases, arguments.every, arguments.seed)
    if arguments.list:
        print(*(case.id for case in cases), sep="\n")
        return 0
    again = len(cases) == 1  # a failure is replayed
    todo = [case for case in cases if again or case.id not in results]
    print(f"{len(todo)} of {len(cases)} cases to do", flush=True)
    arguments.results.mkdir(parents=True, exist_ok=True)
    queue, lock = batches(todo, arguments.seed), threading.Lock()
    running: list[str] = []
    lanes = [
        threading.Thread(target=lane, args=(queue, running, lock, arguments))
        for _ in range(min(arguments.lanes, len(queue)))
    ]
    for thread in lanes:
        thread.start()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    try:
        for thread in lanes:
            thread.join()
    except KeyboardInterrupt:  # the workers end with this process
        print("interrupted: what is done is kept, and not done again")
        sys.stdout.flush()
        os._exit(130)
    results = read_results(arguments.results / "results.jsonl")
    missing = [case for case in cases if case.id not in results]
    failed = [case for case in cases if case.id in results and results[case.id]["wrong"]]
    print(f"{len(cases) - len(failed) - len(missing)} held, {len(failed)} failed, "
          f"{len(missing)} not done; to replay one: python test/faults --only ID "
          f"--seed {arguments.seed}")
    for case in failed:
        print(f"  {case.id}: {results[case.id]['wrong']}")
    return 1 if failed or missing else 0


if __name__ == "__main__":
    sys.exit(main())
