"""Change the code in one place at a time, and see whether a test fails.

``python tools/mutation`` copies the checkout, draws a seeded sample of all the mutants that Cosmic
Ray can make of each folder's modules, and runs the tests of ``judges.yaml`` on each. It prints a
table, and keeps it in ``runs/`` with every mutant that survived. Ctrl-C ends it after the current
mutant: the order is random, so the mutants judged until then are a sample too.
"""

from __future__ import annotations

import argparse
import ast
import csv
import math
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from cosmic_ray.commands.init import init
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.work_db import use_db
from cosmic_ray.work_item import MutationSpec, TestOutcome, WorkItem

HERE = Path(__file__).resolve().parent
CHECKOUT = HERE.parent.parent

# Bit operations need integers, otherwise TypeError; `is` often equals `==` for numbers and text.
_POINTLESS = re.compile(
    r"core/(ReplaceBinaryOperator_(Add|Sub|Mul|Div|FloorDiv|Mod|Pow)_(RShift|LShift|Bit\w+)"
    r"|ReplaceComparisonOperator_(Eq_Is|NotEq_IsNot|Is_Eq|IsNot_NotEq))"
)
# A mutant hangs if it takes longer than this many times the unchanged code, plus this time (s).
_TIMES_AS_LONG, _MIN_LIMIT_S = 5.0, 60.0
_Z = 1.96  # for an interval of 95 %

_interrupted: list[int] = []  # signals received


# Columns of the tables: the outcome of a folder's sample, with the share of survivors and its
# interval; and a mutant that no test noticed.
Row = namedtuple("Row", "folder mutants seed sampled killed survived timeouts share low high")
Survivor = namedtuple("Survivor", "folder module line operator diff")


def mutants_of(modules: list[Path], session: Path) -> list[WorkItem]:
    """Return all mutants of some modules that could change their behaviour, in a fixed order."""
    with use_db(session) as database:
        init(modules, database, {})
        items = list(database.work_items)
    annotations = {module: list(_annotations(module)) for module in modules}

    def could_matter(mutation: MutationSpec) -> bool:
        # In an annotation that is never evaluated, `int | None` and `int - None` are equivalent.
        return not _POINTLESS.match(mutation.operator_name) and not (
            "_BitOr_" in mutation.operator_name
            and any(a <= mutation.start_pos < b for a, b in annotations[mutation.module_path])
        )

    def place(item: WorkItem) -> tuple[str, str, int]:
        (mutation,) = item.mutations
        return str(mutation.module_path), mutation.operator_name, mutation.occurrence

    return sorted((item for item in items if could_matter(item.mutations[0])), key=place)


def _annotations(module: Path) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        for kind in (getattr(node, "annotation", None), getattr(node, "returns", None)):
            if kind is not None:
                yield (kind.lineno, kind.col_offset), (kind.end_lineno, kind.end_col_offset)


def command_of(judges: list[str], without: list[str], reruns: int) -> str:
    """Return the command that runs the tests of a module, up to the first failure."""
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    # No other plugins: loading them takes as long as a mutant's tests.
    for plugin in ("xdist.plugin", "pytest_timeout", "pytest_rerunfailures"):
        words += ["-p", plugin]
    words += ["--reruns", str(reruns)]
    words += [f"test/{judge}" for judge in judges]
    words += [f"--deselect=test/{test}" for test in without]
    return shlex.join(words)


def limit_of(command: str) -> float:
    """Return the time limit of a mutant's tests (s), from their time on the unchanged code."""
    began = time.monotonic()
    done = subprocess.run(shlex.split(command), check=False, capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"{done.stdout}\nthe tests fail on the unchanged code: {command}")
    return _MIN_LIMIT_S + _TIMES_AS_LONG * (time.monotonic() - began)


def judge(folder: str, entry: dict[str, Any], size: int, seed: int) -> tuple[Row, list[Survivor]]:
    """Judge a sample of a folder's mutants; the working directory must be the checkout's copy."""
    commands = {
        Path("greenroof_ros", module): command_of(judges, entry["without"], entry["reruns"])
        for module, judges in entry["modules"].items()
    }
    limits: dict[str, float] = {}
    mutants = mutants_of(list(commands), Path("mutants.sqlite"))
    sample = random.Random(seed).sample(mutants, min(size, len(mutants)))
    killed = timeouts = 0
    survivors = []
    for number, item in enumerate(sample, start=1):
        if _interrupted:
            break
        (mutation,) = item.mutations
        command = commands[mutation.module_path]
        if command not in limits:
            limits[command] = limit_of(command)
        result = mutate_and_test(item.mutations, command, limits[command])
        outcome = "killed"
        if result.test_outcome == TestOutcome.SURVIVED:
            outcome = "survived"
            survivors.append(Survivor(
                folder, str(mutation.module_path), mutation.start_pos[0],
                mutation.operator_name.removeprefix("core/"), _changed(result.diff),
            ))
        elif result.output == "timeout":
            outcome = "timeout"
            timeouts += 1
        else:
            killed += 1
        print(
            f"{number}/{len(sample)} {outcome}: {mutation.module_path}:"
            f"{mutation.start_pos[0]} {mutation.operator_name}", flush=True,
        )
    sampled = killed + timeouts + len(survivors)
    share, low, high = interval(len(survivors), sampled)
    return Row(
        folder, len(mutants), seed, sampled, killed, len(survivors), timeouts, share, low, high
    ), survivors


def _changed(diff: str) -> str:
    """Return the lines of a diff that differ."""
    return "\n".join(line for line in diff.splitlines()[3:] if line[:1] in ("-", "+"))


def interval(count: int, of: int) -> tuple[float, float, float]:
    """Return a share and its 95 % interval (Wilson's)."""
    if not of:
        return 0.0, 0.0, 1.0
    share, z2 = count / of, _Z**2
    middle = (share + z2 / (2 * of)) / (1 + z2 / of)
    half = _Z * math.sqrt(share * (1 - share) / of + z2 / (4 * of**2)) / (1 + z2 / of)
    return round(share, 3), round(middle - half, 3), round(middle + half, 3)


def _not_copied(directory: str, names: list[str]) -> set[str]:
    """Return what a copy of the checkout does not need; ``config/studies`` is needed."""
    made = {"runs", "studies", "build", "install", "log"} if Path(directory) == CHECKOUT else set()
    return {name for name in names if name.startswith(".") or name in made}


def write(path: Path, kind: type[Row] | type[Survivor], folder: str, rows: list[Any]) -> None:
    """Replace a folder's rows in a table."""
    kept = []
    if path.exists():
        with path.open(newline="", encoding="utf-8") as stream:
            kept = [row for row in csv.reader(stream) if row[0] not in ("folder", folder)]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream, lineterminator="\n").writerows([kind._fields, *kept, *rows])


def main() -> int:
    """Judge the folders that the command line asks for."""
    folders = yaml.safe_load((HERE / "judges.yaml").read_text(encoding="utf-8"))
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folders", nargs="*", metavar="FOLDER", help=f"some of {', '.join(folders)} (default: all)"
    )
    parser.add_argument("--sample", type=int, default=100, help="mutants a folder (default: 100)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the sample (default: 1)")
    parser.add_argument(
        "--output", type=Path, default=Path("runs/mutation.csv"),
        help="the table; survivors are in a file next to it (default: runs/mutation.csv)",
    )
    arguments = parser.parse_args()
    unknown = [folder for folder in arguments.folders if folder not in folders]
    if unknown:
        parser.error(f"there is no folder {unknown[0]}; they are {', '.join(folders)}")
    # A mutant's tests run in a session of their own, which Ctrl-C does not reach.
    signal.signal(signal.SIGINT, lambda number, _: _interrupted.append(number))
    table = arguments.output.resolve()
    survivors_file = table.with_name(f"{table.stem}_survivors.csv")
    with tempfile.TemporaryDirectory(prefix="mutation-") as directory:
        copy = Path(directory, "checkout")
        shutil.copytree(CHECKOUT, copy, ignore=_not_copied)
        os.chdir(copy)
        os.environ["PYTHONPATH"] = str(copy)
        os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
        for folder in arguments.folders or folders:
            if _interrupted:
                return 130
            row, survivors = judge(folder, folders[folder], arguments.sample, arguments.seed)
            write(table, Row, folder, [row])
            write(survivors_file, Survivor, folder, survivors)
            print(", ".join(f"{key} {value}" for key, value in row._asdict().items()), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
