"""Operation of a live site: its directory, its processes and its messages."""

from __future__ import annotations

import argparse
import os
import shutil
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_FAILED
from greenroof_ros.base.disk import DISK
from greenroof_ros.base.errors import OccupiedError
from greenroof_ros.base.files import COPIES, add_path_to_errors
from greenroof_ros.base.parameter import replace_infinity
from greenroof_ros.base.processes import (
    IN_MEMORY,
    InterruptedRun,
    LockedError,
    Signals,
    lock_file,
    scratch_directory,
)
from greenroof_ros.base.standard_error import print_line
from greenroof_ros.base.text import number_of
from greenroof_ros.base.times import iso
from greenroof_ros.controllers.registry import BUILT_IN, EXTERNAL
from greenroof_ros.interface.alarm import Alarm, to_record
from greenroof_ros.interface.states import PUMP
from greenroof_ros.live.live_site import MIN_BAG_MB, LiveSite
from greenroof_ros.live.pumping.limits import check_command_limit
from greenroof_ros.live.service_manager import notify
from greenroof_ros.live.supervisor import LiveSupervisor, NodeFailed, ProcessStart
from greenroof_ros.live.time_limit import silence_limit
from greenroof_ros.results.alarm_file import read_alarms
from greenroof_ros.results.versions import versions
from greenroof_ros.ros.domain import (
    lock_namespace,
    refuse_other_nodes,
    require_ros,
    ros_arguments,
)
from greenroof_ros.ros.parameter_file import find_value, node_parameter_files
from greenroof_ros.simulation import summary
from greenroof_ros.simulation.directory import write_parameters
from greenroof_ros.site.file import format_site, read_site

# Interval at which systemd is notified (s), and how far each notice extends the start timeout (us).
_NOTIFY_S = 1.0
_STILL_STARTING = "EXTEND_TIMEOUT_USEC=30000000"
# How long to wait at the end for the summary to be written (s).
_WRITTEN_S = 5.0
# Number of alarms in the summary; all of them are counted.
_NEWEST = 200


def run_live(site: LiveSite, arguments: argparse.Namespace, signals: Signals) -> int:
    """Start the nodes of a live site, and keep them running until a signal arrives.

    Returns:
        The exit code: 0 if the site was stopped on request and the pump is stopped.

    Raises:
        ConfigurationError: if a graph is already running, ROS 2 is missing, or a parameter file is
            invalid.
        OSError: if the directory cannot be created, or the configuration cannot be written.
    """
    state: Path = arguments.state
    modules = {
        name: node.module for process in site.processes(state)
        for name, node in process.nodes.items()
    }
    with require_ros():
        user_files = node_parameter_files(arguments, modules, site.controller, site.parameters)
        if site.drive is not None:
            _check_pump(site.tau, user_files, f"{arguments.namespace}/{PUMP}")
    with (
        lock_namespace(arguments.namespace),
        _state_directory(state) as state,
        scratch_directory(IN_MEMORY) as memory,
    ):
        _fit_bag(site, state / "bag")
        processes = list(site.processes(state))
        configuration = _Configuration(memory, site, user_files, processes)
        configuration.write()
        names = modules.keys() | {"plant", *BUILT_IN}
        refuse_other_nodes(arguments.namespace, names, signals.check)
        DISK.do(partial(configuration.keep, state / "configuration"))
        record = _SiteRecord(site, state)
        supervisor = LiveSupervisor(
            processes, state / "log", ros_arguments(configuration.parameters, arguments.namespace),
            site.drive.stopper() if site.drive is not None else None, record.tell,
            silence_s=max(arguments.peer_limit, silence_limit(site.tau)),
            prepare=configuration.write,
        )
        try:
            record.write(summary.RUNNING)
            with supervisor:
                _supervise(site, supervisor, record, signals)
        except Exception as error:  # whatever the error, the summary must not state "running"
            signals.ignore()
            return _report_end(record, supervisor, error)


def _check_pump(tau: float, files: Sequence[Path], node: str) -> None:
    """Check before anything starts what the pump node would reject; see `check_command_limit`."""
    from greenroof_ros.live.actuator import COMMAND_LIMIT  # it imports ROS

    limit = find_value(files, node, COMMAND_LIMIT)
    check_command_limit(limit, tau, f"parameter {COMMAND_LIMIT.name} of {PUMP}")


def _supervise(
    site: LiveSite, supervisor: LiveSupervisor, record: _SiteRecord, signals: Signals
) -> NoReturn:
    """Monitor the processes until an error ends the site.

    Raises:
        InterruptedRun: if a signal arrived.
        NodeFailed: if the site cannot be kept running.
    """
    ready, notified = False, 0.0
    try:
        while True:
            supervisor.read()
            signals.check()  # before update(): what a service manager stops has not failed
            supervisor.update()
            unready = supervisor.unready
            if not ready and not unready:
                ready = True
                print_line("all nodes have joined the graph")
                notify("READY=1")
            now = time.monotonic()
            if now - notified >= _NOTIFY_S:
                notified = now
                record.warn()
                status = f"STATUS={unready or record.told}"
                notify("WATCHDOG=1", status, *([] if ready else [_STILL_STARTING]))
    finally:
        notify("STOPPING=1")
        if site.drive is not None:
            print_line("waiting for the pump to come to a standstill")


def _report_end(record: _SiteRecord, supervisor: LiveSupervisor, error: Exception) -> int:
    """Record and print the reason why the site ended; return the exit code."""
    if isinstance(error, InterruptedRun) and not supervisor.may_run:
        record.write(summary.DONE, str(error))
        record.wait()
        print_line(f"{error}: the pump and the nodes are being stopped")
        print_line(f"done, with {number_of(record.count, 'alarm')}" if record.count else "done")
        return EXIT_DONE
    reason, last_lines, code = str(error), "", EXIT_FAILED
    if isinstance(error, NodeFailed):
        last_lines, code = error.last_lines, error.code
    elif not isinstance(error, InterruptedRun):
        reason = f"{type(error).__name__}: {error}"
        last_lines = "".join(traceback.format_exception(error)).rstrip()
    reason = "; ".join(filter(None, (reason, supervisor.may_run)))
    record.write(summary.FAILED, reason)
    record.wait()
    notify(f"STATUS={reason}")
    print_line("\n".join(filter(None, (f"error: {reason}", last_lines))))
    return EXIT_FAILED if supervisor.may_run else code


class _SiteRecord:
    """Record of a site since its start: ``summary.json``, and what is printed.

    The disk thread reads and writes the files, so a full or hung disk stops nothing else.

    Attributes:
        told: the last line that was printed.
        count: number of alarms since the start, as last read, excluding warnings and alarms that
            follow from other alarms.
    """

    def __init__(self, site: LiveSite, state: Path) -> None:
        """Start a record, without writing anything yet."""
        self.told, self.count = "running", 0
        self._state, self._problem = state, ""
        self._warned: set[str] = set()
        self._before = max((alarm.number for alarm in self._read_alarms()), default=0)
        self._started_at = iso(time.time())
        self._setting = {
            "controller": site.controller.name,
            "parameters": replace_infinity(site.parameters),
            "site": str(site.site_file),
            "sensors": str(site.sensors or EXTERNAL),
            "forecast": str(site.forecast) if site.forecast else None if site.weather else EXTERNAL,
            "drive": site.drive.drive if site.drive else EXTERNAL,
            "drive_at": site.drive.address if site.drive else None,
            "versions": versions(),
        }

    def tell(self, text: str) -> None:
        """Print lines for human readers."""
        self.told = text.rpartition("\n")[2]
        print_line(text)

    def warn(self) -> None:
        """Print new warnings about files that are not being written."""
        warnings = {f"{self._state}: {self._problem}"} if self._problem else set()
        if DISK.late:
            warnings.add(
                f"{self._state}: the disk does not respond; the logs and the summary are held in "
                "memory"
            )
        elif DISK.refused:
            warnings.add(
                f"{self._state}: {DISK.refused} pieces of log output have been lost since the "
                "start, because they did not fit into memory"
            )
        for text in sorted(warnings - self._warned):
            print_line(f"warning: {text}")
        self._warned = warnings

    def write(self, status: str, reason: str | None = None) -> None:
        """Write the summary with a status of :mod:`greenroof_ros.simulation.summary`."""
        DISK.do(partial(self._write, {
            "status": status,
            "reason": reason,
            "began": self._started_at,
            "ended": None if status == summary.RUNNING else iso(time.time()),
        }))

    def _write(self, values: dict[str, Any]) -> None:
        alarms = [alarm for alarm in self._read_alarms() if alarm.number > self._before]
        self.count = sum(alarm.is_serious and not alarm.follows for alarm in alarms)
        records = [to_record(alarm) for alarm in alarms[-_NEWEST:]]
        try:
            summary.write(
                {**values, "alarm_count": self.count, "alarms": records, **self._setting},
                self._state,
            )
        except OSError as error:
            self._problem = f"{summary.SUMMARY}: {error.strerror}"

    def _read_alarms(self) -> list[Alarm]:
        try:
            return read_alarms(self._state)
        except (OSError, ValueError):  # the alarms node reports it
            return []

    def wait(self) -> None:
        """Wait until all data are on the disk; warn if that takes more than 5 s."""
        if not DISK.wait(_WRITTEN_S):
            self._problem = f"the disk does not respond; {summary.SUMMARY} is not saved"
        self.warn()


@contextmanager
def _state_directory(path: Path) -> Iterator[Path]:
    """Create the directory of a site, and lock it.

    Raises:
        OccupiedError: if another bringup has locked it.
        OSError: if it cannot be created or written to.
    """
    with ExitStack() as held:
        try:
            (path / "log").mkdir(parents=True, exist_ok=True)
            held.enter_context(lock_file(path / "bringup.lock"))
        except LockedError:
            raise OccupiedError(
                "belongs to a running bringup; end it, or use another directory",
                key="--state", value=str(path),
            ) from None
        yield path.resolve()


def _fit_bag(site: LiveSite, bag: Path) -> None:
    """If the bag's limit exceeds nine tenths of the space on its disk, reduce it, and warn."""
    disk = bag if bag.is_dir() else bag.parent  # the bag may be a mount of its own
    fits = shutil.disk_usage(disk).free + sum(
        file.stat().st_size for file in bag.glob("*.mcap")
    )
    reduced = max(MIN_BAG_MB, 0.9 * fits / 1e6)
    if site.bag_limit > reduced:
        print_line(
            f"warning: {bag}: there is only enough disk space for {fits / 1e6:.0f} MB of the bag, "
            f"which is less than --bag-limit {site.bag_limit:g}; the bag's oldest files are "
            f"removed once it exceeds {reduced:.0f} MB"
        )
        site.bag_limit = reduced


class _Configuration:
    """Copies of the files with which a site is started, which its nodes read even after a restart.

    Nodes read neither the originals, which may have been edited, nor the copies from an earlier
    start. Only the forecast, which is replaced in place, and the controller's code are read from
    their original paths. The copies are stored in memory, since the disk may be full after a power
    cut, with no one there to free space. A clean-up program may remove the copies, as may systemd
    when their user logs out, so missing copies are written again before every start of a node.

    Attributes:
        parameters: the ROS 2 parameter files that all nodes read: bringup's and the user's.
    """

    def __init__(
        self, directory: Path, site: LiveSite, user_files: Sequence[Path],
        processes: Sequence[ProcessStart],
    ) -> None:
        """Read the files.

        Args:
            directory: directory of the copies.
            site: the site as described on the command line.
            user_files: the user's parameter files.
            processes: the processes of the site.

        Raises:
            OSError: if a file cannot be read or written.
        """
        self._directory = directory
        self._files: dict[Path, tuple[bytes, int]] = {}  # content and mode of each copy
        self._kept: dict[Path, bytes] = {}  # what people may read later, without passwords
        with add_path_to_errors(directory):
            own = write_parameters(directory, {
                name: node.parameters for process in processes
                for name, node in process.nodes.items() if node.parameters
            })
        self._files[own], self._kept[Path(own.name)] = (own.read_bytes(), 0o644), own.read_bytes()
        self.parameters = [own, *map(self._add, user_files)]
        for name, file in [*site.files().items(), *(("nodes", file) for file in user_files)]:
            text = format_site(read_site(file)).encode() if name == "site" else None
            copy = self._add(file, text)
            self._kept[Path(name, file.name)] = self._files[copy][0]
        for file in site.broker_files():
            self._add(file)

    def _add(self, file: Path, content: bytes | None = None) -> Path:
        """Add a copy of a file, by default with the file's content; return the copy's path."""
        copy = Path(f"{self._directory}{file.absolute()}")
        mode = file.stat().st_mode & 0o777
        self._files[copy] = file.read_bytes() if content is None else content, mode
        return copy

    def write(self) -> dict[str, str]:
        """Write the copies that are missing or damaged, and return the environment that names them.

        Raises:
            OSError: if the copies cannot be written.
        """
        for copy, (content, mode) in self._files.items():
            with suppress(OSError):
                if copy.read_bytes() == content:
                    continue
            with add_path_to_errors(self._directory):
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.unlink(missing_ok=True)
                opener = partial(os.open, mode=mode)
                with open(copy, "wb", opener=opener) as stream:
                    stream.write(content)
        self._directory.chmod(0o755)  # the page may run as another user
        return {COPIES: str(self._directory)}

    def keep(self, kept: Path) -> None:
        """Write copies for human readers, replacing those of the last start; warn if this fails."""
        part = kept.with_suffix(".part")
        shutil.rmtree(part, ignore_errors=True)
        try:
            for name, content in self._kept.items():
                copy = part / name
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(content)
            shutil.rmtree(kept, ignore_errors=True)
            part.rename(kept)
        except OSError as error:
            shutil.rmtree(part, ignore_errors=True)
            why = f"{error.strerror}; the configuration used for this start is not saved"
            print_line(f"warning: {kept}: {why}")
