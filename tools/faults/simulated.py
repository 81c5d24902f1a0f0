"""A case of the simulated way: the run ends with a reason, or every byte of its bag is the same."""

from __future__ import annotations

import contextlib
import hashlib
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from disks import small_disk
from faults.bounds import SIMULATION_END_S
from faults.cases import CHANGES, Case
from faults.inject import change_parameter, intrude, refuse_second_graph, signal_process
from faults.live import Outcome
from faults.watcher import Watcher
from graphs import Process, bag_file, environment, summary_of

from greenroof_ros.common.command_line import EXIT_DONE, EXIT_FAILED
from greenroof_ros.recording.bag_reader import count_ticks
from greenroof_ros.recording.bag_writer import recovered_bag

# A run that is over before a fault shows would prove nothing; the short one is compared in full.
_LONG_H, _SHORT_H = "12", "1"
# Simulated per wall time in the short run: slow enough that it lasts until the fault is over.
_SHORT_SPEED = "400"
# Ticks that a restored bag may lack: as many as the plant can run ahead of the recorder, and the
# current one.
_LOST_TICKS = 33


def run_case(case: Case, directory: Path, domain: int, rng: random.Random) -> Outcome:
    """Bring up a simulation, do the case to it, and check what it leaves."""
    directory.mkdir(parents=True, exist_ok=True)
    same = case.expected.recovery == "same"
    options = ["--hours", _SHORT_H, "--speed", _SHORT_SPEED] if same else ["--hours", _LONG_H]
    outcome = Outcome(bound=None if same else SIMULATION_END_S)
    if case.fault == "full disk":
        with small_disk(directory / "run", "300k"):
            _fills_up(case, directory, domain, outcome)
        return outcome
    run = Process(
        domain, "bringup", "--controller", "onoff", *options, "--output", "run", cwd=directory,
    )
    watcher = None
    try:
        if case.fault in ("intruder", "10000 hostile", CHANGES):
            watcher = Watcher(domain, "intruder")
        run.wait_for_ticks()
        time.sleep(rng.uniform(0.0, 1.0))
        began = time.monotonic()
        _begin(case, run, domain, watcher, rng)
        if same:
            _same(run, directory, domain, outcome)
        else:
            _ends(case, run, directory, began, outcome)
    except (AssertionError, OSError, KeyError, subprocess.TimeoutExpired) as error:
        outcome.fail(f"{type(error).__name__}: {error}"[:600])
    finally:
        if watcher is not None:
            watcher.close()
        _clean_up(run, outcome)
    return outcome


def _begin(
    case: Case, run: Process, domain: int, watcher: Watcher | None, rng: random.Random
) -> None:
    if watcher is not None and case.fault == CHANGES:
        change_parameter(watcher, "onoff", "level")
    elif watcher is not None:
        intrude(watcher, case.target, case.fault, rng)
    elif case.fault == "second graph":
        refuse_second_graph(domain, run.cwd)
    else:
        with ExitStack() as undo:
            signal_process(run.process.pid, case.fault, rng, undo)
            if case.fault == "stop long":
                time.sleep(8.0)


def _fills_up(case: Case, directory: Path, domain: int, outcome: Outcome) -> None:
    """Check that a run whose disk fills up ends with a reason, and that its bag can be restored."""
    run = Process(
        domain, "bringup", "--controller", "onoff", "--hours", _LONG_H, "--output", "run/on",
        cwd=directory,
    )
    try:
        code = run.wait(60)
    except AssertionError as error:
        outcome.fail(str(error))
        return
    _note_end(case, code, 1, directory / "run" / "on", outcome)
    if "Traceback" in run.stderr():
        outcome.fail("a traceback")
    _restore(outcome, directory / "run" / "on", "--output", str(directory / "rescued"))


def _same(run: Process, directory: Path, domain: int, outcome: Outcome) -> None:
    code = run.wait(120)
    if code != 0:
        outcome.fail(f"the run ended with exit code {code}: {run.stderr()[-400:]}")
        return
    undisturbed = reference(directory.parent.parent, domain)
    if digest(bag_file(directory / "run")) != digest(bag_file(undisturbed)):
        outcome.fail("the bag differs from an undisturbed run's")
    outcome.lost = 0
    outcome.recovery = "ran to its end, every byte as undisturbed"


def _note_end(case: Case, code: int, expected: int, run: Path, outcome: Outcome) -> None:
    """Note how bringup ended, and check the reason that it gives."""
    outcome.recovery = "ended"
    if code != expected:
        outcome.fail(f"ended with exit code {code}, not {expected}")
    if code != -signal.SIGKILL:
        outcome.reason = summary_of(run)["reason"] or ""
        if case.expected.names not in outcome.reason:
            outcome.fail(f"the reason of the end does not name {case.expected.names}")


def _ends(case: Case, run: Process, directory: Path, began: float, outcome: Outcome) -> None:
    bringup = case.fault if case.target == "bringup" else ""
    expected = {"kill": -signal.SIGKILL, "term": 130}.get(bringup, 1)
    if case.expected.recovery == "either":
        run.wait(120)
        outcome.recovery = "ended"
        return
    code = run.wait(60)
    outcome.to_safe = time.monotonic() - began
    if outcome.to_safe > SIMULATION_END_S:
        outcome.fail(f"ended after {outcome.to_safe:.1f} s, bound {SIMULATION_END_S:.1f} s")
    _note_end(case, code, expected, directory / "run", outcome)
    if "Traceback" in run.stderr():
        outcome.fail("a traceback")
    _count_lost(directory, domain_free=code != -signal.SIGKILL, outcome=outcome)


def _restore(outcome: Outcome, run: Path, *options: str) -> bool:
    """Restore the bag of a run with the command ``recover``; return whether that worked."""
    done = subprocess.run(
        [sys.executable, "-m", "greenroof_ros", "recover", str(run), *options], capture_output=True,
        text=True, env=environment(0), timeout=60,
    )
    if done.returncode not in (EXIT_DONE, EXIT_FAILED):  # a kill can cut the last chunk
        outcome.fail(f"the bag could not be restored: {done.stderr[-300:]}")
    return done.returncode == 0


def _count_lost(directory: Path, *, domain_free: bool, outcome: Outcome) -> None:
    """Count the ticks that the plant has made and the restored bag lacks."""
    run = directory / "run"
    bag = run / "bag"
    ticks = count_ticks(bag)
    if ticks is None:
        if not _restore(outcome, run):
            return
        ticks = count_ticks(recovered_bag(bag)) or 0
    last = summary_of(run).get("last_tick")
    if domain_free and last is not None:
        outcome.lost = max(0, last + 1 - ticks)
        if outcome.lost > _LOST_TICKS:
            outcome.fail(f"{outcome.lost} ticks are lost, of {last + 1}")


def _clean_up(run: Process, outcome: Outcome) -> None:
    popen = run.process
    if popen.poll() is None:
        popen.send_signal(signal.SIGCONT)
        popen.terminate()
        try:
            popen.wait(20)
        except subprocess.TimeoutExpired:
            outcome.fail("bringup did not end within 20 s of SIGTERM")
            popen.kill()


def digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def reference(directory: Path, domain: int, hours: str = _SHORT_H) -> Path:
    """Return an undisturbed run, made once in a directory."""
    output_of_undisturbed = directory / "undisturbed"
    if not (output_of_undisturbed / "run").is_dir():
        place = Path(tempfile.mkdtemp(prefix="undisturbed-", dir=directory))
        run = Process(
            domain, "bringup", "--controller", "onoff", "--hours", hours, "--output", "run",
            cwd=place,
        )
        code = run.wait(300)
        assert code == 0, run.stderr()
        with contextlib.suppress(OSError):  # another process was faster
            place.rename(output_of_undisturbed)
    return output_of_undisturbed / "run"
