"""Which test catches a fault: put each fault of ``mutants.yaml`` into a copy, and run the tests.

    python tools/mutants.py run               all faults that have no outcome yet
    python tools/mutants.py run ID ROOM ...   these faults (again), or those of these rooms
    python tools/mutants.py table             write tools/mutants.md from the outcomes

The copy is a clone of the last commit in a temporary directory; the checkout does not change. For
each fault, the tests of its room (a folder of greenroof_ros/) run up to the first failure. At the
end, the whole suite runs with all faults that have survived, since it takes long. A test catches a
fault only if, on its own, it fails with that fault alone and passes without it, twice. Outcomes are
stored in runs/mutants.json after each fault, so an interrupted run continues. After a room has been
rewritten, find the place of each of its faults again, and change ``file``, ``old`` and ``new`` in
mutants.yaml, but not ``behaviour``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import yaml

CHECKOUT = Path(__file__).resolve().parent.parent
FAULTS, TABLE = CHECKOUT / "tools/mutants.yaml", CHECKOUT / "tools/mutants.md"
OUTCOMES = CHECKOUT / "runs/mutants.json"

SURVIVED, SURVIVED_ROOM = "survived", "survived the room's tests; whole suite not run"
# A fault can make a test wait for ever (s).
_TIMEOUT_S = 300

Outcomes = dict[str, dict[str, Any]]


class Fault(NamedTuple):
    """A fault: the text ``old``, which occurs once in ``file``, is replaced by ``new``."""

    id: str
    room: str
    behaviour: str
    file: str
    old: str
    new: str

    def insert(self, copy: Path) -> None:
        """Put the fault into a copy; exit if its place is not found."""
        path = copy / self.file
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        if (count := text.count(self.old)) != 1:
            sys.exit(f"{self.id}: {self.file} contains the old text {count} times, not once")
        path.write_text(text.replace(self.old, self.new), encoding="utf-8")


class Copy:
    """A clone of the last commit, and its tests."""

    def __init__(self, directory: Path) -> None:
        """Make the clone in a directory, and check that its own package is imported there."""
        self.root, self._cache = directory / "copy", directory / "cache"
        self._git(CHECKOUT, "clone", "--quiet", "--shared", str(CHECKOUT), str(self.root))
        self._environment = {**os.environ, "PYTHONPATH": str(self.root)}
        self.commit = self._git(self.root, "rev-parse", "--short", "HEAD").strip()
        place = self._run(sys.executable, "-c", "import greenroof_ros as g; print(g.__file__)")
        print(f"commit {self.commit}; package {place.stdout.strip()}", flush=True)
        if not Path(place.stdout.strip()).is_relative_to(self.root):
            sys.exit("the copy does not import its own package")

    @staticmethod
    def _git(root: Path, *words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=root, check=True, text=True, stdout=subprocess.PIPE
        ).stdout

    def _run(self, *words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            words, cwd=self.root, env=self._environment, text=True, errors="replace",
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )

    def restore(self) -> None:
        """Remove the fault."""
        self._git(self.root, "checkout", "--quiet", "--", ".")

    def find_failures(self, *options: str) -> list[str]:
        """Run pytest, and return the tests that failed."""
        last = self._cache / "v/cache/lastfailed"
        last.unlink(missing_ok=True)
        result = self._run(
            sys.executable, "-m", "pytest", "-q", "--assert=plain", "-o",
            f"cache_dir={self._cache}", "-o", f"timeout={_TIMEOUT_S}", *options,
        )
        if result.returncode not in (0, 1, 2):  # passed, failed, stopped by errors of collection
            sys.exit(f"pytest {' '.join(options)}: {result.stdout}")
        failed = json.loads(last.read_text(encoding="utf-8")) if last.exists() else {}
        if result.returncode and not failed:
            sys.exit(f"pytest {' '.join(options)}: {result.stdout}")
        # With several processes, a test's name ends in its group.
        return [name.rpartition("@")[0] or name for name in failed]

    def find_catchers(self, faults: list[Fault], tests: list[str], jobs: int) -> dict[str, str]:
        """Run tests with all of these faults together; return the test that catches each.

        The result has the ids of the faults that were caught.
        """
        caught: dict[str, str] = {}
        ignored: list[str] = []
        while left := [fault for fault in faults if fault.id not in caught]:
            for fault in left:
                fault.insert(self.root)
            failed = self.find_failures(
                *tests, f"--maxfail={len(left)}", "--numprocesses", str(jobs), "--dist",
                "loadgroup", "--no-loadscope-reorder", *(f"--deselect={name}" for name in ignored),
            )
            self.restore()
            if not failed:
                break
            for name in failed:
                for fault in left:
                    if self._catches(fault, name):
                        caught.setdefault(fault.id, name)
            ignored += set(failed) - set(caught.values())
        return caught

    def _catches(self, fault: Fault, test: str) -> bool:
        """Return whether a test, alone, passes without a fault and fails with it, both twice.

        A busy machine, too, makes tests of live sites fail.
        """
        for _ in range(2):
            if self.find_failures(test):
                return False
            fault.insert(self.root)
            fails = self.find_failures(test)
            self.restore()
            if not fails:
                return False
        return True


def read_faults() -> tuple[dict[str, list[str]], dict[str, Fault]]:
    """Return the tests of each room, and the faults by their id."""
    content = yaml.safe_load(FAULTS.read_text(encoding="utf-8"))
    return content["rooms"], {row["id"]: Fault(**row) for row in content["faults"]}


def read_outcomes() -> Outcomes:
    """Return the outcomes so far, by the id of the fault."""
    return json.loads(OUTCOMES.read_text(encoding="utf-8")) if OUTCOMES.exists() else {}


def store(fault: Fault, outcome: str, seconds: float, commit: str) -> None:
    """Store the outcome of a fault, and print it."""
    outcomes = read_outcomes()  # another process may have added to them
    outcomes[fault.id] = {"outcome": outcome, "seconds": round(seconds), "commit": commit}
    OUTCOMES.parent.mkdir(exist_ok=True)
    OUTCOMES.write_text(json.dumps(outcomes, indent=1) + "\n", encoding="utf-8")
    print(f"{fault.room}: {fault.id}: {outcome} ({seconds:.0f} s)", flush=True)


def run(names: list[str], jobs: int, *, rooms_only: bool) -> None:
    """Put in the faults with these ids or in these rooms; without names, those not tried yet."""
    rooms, faults = read_faults()
    if unknown := set(names) - faults.keys() - rooms.keys():
        sys.exit(f"neither a fault nor a room: {', '.join(sorted(unknown))}")
    before, places = read_outcomes(), list(rooms)
    chosen = [
        fault for fault in sorted(faults.values(), key=lambda fault: places.index(fault.room))
        if (fault.id in names or fault.room in names if names else fault.id not in before)
    ]
    with tempfile.TemporaryDirectory(prefix="mutants-") as directory:
        copy = Copy(Path(directory))
        for fault in chosen:
            began = time.monotonic()
            caught = copy.find_catchers([fault], rooms[fault.room], jobs)
            outcome = caught.get(fault.id, SURVIVED_ROOM)
            store(fault, outcome, time.monotonic() - began, copy.commit)
        outcomes = read_outcomes()
        left = [
            fault for fault in (chosen if names else faults.values())
            if outcomes[fault.id]["outcome"] == SURVIVED_ROOM
        ]
        if left and not rooms_only:
            began = time.monotonic()
            caught = copy.find_catchers(left, [], jobs)
            for fault in left:
                outcome = caught.get(fault.id, SURVIVED)
                store(fault, outcome, time.monotonic() - began, copy.commit)


def write_table() -> None:
    """Write the table of all faults and their outcomes."""
    (_, faults), outcomes = read_faults(), read_outcomes()
    found = {name: outcomes.get(name, {"outcome": "not run", "commit": ""}) for name in faults}
    caught = sum("::" in each["outcome"] for each in found.values())
    lines = [
        "# Deliberate faults, and the tests that catch them", "",
        f"`tools/mutants.py` put each fault in alone. Tests catch {caught} of {len(found)}.", "",
        "| id | room | fault | caught by | commit |", "|---|---|---|---|---|",
    ]
    for name, fault in faults.items():
        outcome = found[name]["outcome"].replace("|", "\\|")
        shown = f"`{outcome}`" if "::" in outcome else f"**{outcome}**"
        behaviour, commit = fault.behaviour.replace("|", "\\|"), found[name]["commit"]
        lines.append(f"| `{name}` | {fault.room} | {behaviour} | {shown} | {commit} |")
    TABLE.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"{TABLE}: {caught} of {len(found)} caught")


def main() -> None:
    """Run the tests with faults, or write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    runner = commands.add_parser("run", help="put faults in, and run the tests")
    runner.add_argument("names", nargs="*", metavar="ID|ROOM", help="default: all not tried yet")
    runner.add_argument(
        "--rooms-only", action="store_true", help="do not run the whole suite; a later run will"
    )
    runner.add_argument(
        "--jobs", type=int, default=4, help="processes of pytest (default: %(default)s)"
    )
    commands.add_parser("table", help="write tools/mutants.md")
    arguments = parser.parse_args()
    if arguments.command == "table":
        write_table()
    else:
        run(arguments.names, arguments.jobs, rooms_only=arguments.rooms_only)


if __name__ == "__main__":
    main()
