"""Operation of a live site: its directory, its processes and its messages."""

from __future__ import annotations

import argparse
import os
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_FAILED
from greenroof_ros.base.disk import DISK
from greenroof_ros.base.files import COPIES, add_path_to_errors, replace_text
from greenroof_ros.base.parameter import replace_infinity
from greenroof_ros.base.processes import IN_MEMORY, InterruptedRun, Signals, scratch_directory
from greenroof_ros.base.standard_error import print_line
from greenroof_ros.base.times import iso
from greenroof_ros.interface.alarm import Alarm, read_alarms, to_record
from greenroof_ros.live.devices.exchange import DriveInUseError, Endpoint, stop_drive
from greenroof_ros.live.live_site import LiveSite
from greenroof_ros.live.pumping.limits import check_command_limit
from greenroof_ros.live.supervisor import LiveSupervisor, NodeFailed, StopDrive
from greenroof_ros.results.versions import versions
from greenroof_ros.ros.domain import lock_bringup, prepare_ros, ros_arguments
from greenroof_ros.ros.errors import describe
from greenroof_ros.ros.parameter_file import find_value, node_parameter_files
from greenroof_ros.simulation import summary
from greenroof_ros.simulation.directory import write_parameters
from greenroof_ros.site.file import format_site, read_site

# Interval at which systemd is notified (s); and how long to wait at the end until the logs and the
# summary are written (s).
_NOTIFY_S, _WRITTEN_S = 1.0, 5.0
_MAY_RUN = (
    "THE PUMP MAY BE RUNNING: now only the drive's own timeout can stop it, if it is on; check the "
    "pump, and stop it at the drive's panel or at the main switch"
)


def run_live(site: LiveSite, arguments: argparse.Namespace, signals: Signals) -> int:
    """Start the nodes of a live site, and keep them running until a signal arrives.

    Returns:
        The exit code: 0 if the site was stopped on request and the pump is stopped.

    Raises:
        ConfigurationError: if a graph is already running, ROS 2 is missing, or a parameter file is
            invalid.
        OSError: if the directory cannot be created, or the configuration cannot be written.
    """
    namespace, nodes = arguments.namespace, site.nodes
    prepare_ros()
    user_files = node_parameter_files(
        arguments, {name: module for name, (module, _) in nodes.items()}, site.controller,
        site.parameters,
    )
    from greenroof_ros.live.actuator import COMMAND_LIMIT  # it imports ROS

    pump = site.processes[0].name
    limit = find_value(user_files, f"{namespace}/{pump}", COMMAND_LIMIT)
    check_command_limit(limit, site.tau, f"parameter {COMMAND_LIMIT.name} of {pump}")
    state = arguments.state.resolve()
    with lock_bringup(namespace, state), scratch_directory(IN_MEMORY) as memory:
        (state / "log").mkdir(parents=True, exist_ok=True)
        parameters = write_parameters(memory, {name: own for name, (_, own) in nodes.items()})
        files = _StartedFiles(memory, arguments.site, [parameters, *user_files, *site.files])
        files.write()
        kept = state / "configuration" / summary.SITE_FILE  # for those who read the bag later
        DISK.do(partial(_try, partial(replace_text, kept, files.site, parents=True)))
        write = _summarize(site, state)
        supervisor = LiveSupervisor(
            site.processes,
            ros_arguments(map(files.copy_of, [parameters, *user_files]), namespace),
            make_stopper(site.drive) if site.drive is not None else None, _tell, files.write,
        )
        try:
            write(summary.RUNNING, None)
            _supervise(supervisor, signals)
        except Exception as error:  # whatever the error, the summary must not state "running"
            signals.ignore()
            return _end(write, supervisor.may_run, error)


def make_stopper(drive: Endpoint) -> StopDrive:
    """Return a function that stops a drive without the pump node.

    A drive that another program controls is left alone. A drive that nobody has reached runs no
    pump: its own timeout would have stopped a pump that was left on before.
    """
    drive.connection()  # load its library now, since the disk may hang when it is needed

    def stop(pump_node: int, reached: bool) -> tuple[bool, str]:
        try:
            status = stop_drive(drive, driver=pump_node)
        except DriveInUseError as error:
            return True, (
                f"another program (process {error.holder}) controls the drive, and the pump "
                "may be running: the drive is left to that program"
            )
        except Exception as error:  # whatever the error, someone must check the pump
            warning = _MAY_RUN if reached else "the drive has not responded since the start"
            return reached, f"bringup could not stop the drive: {error}; {warning}"
        message = f"bringup commanded the drive to stop; the drive then reported: {status}"
        return not status.at_rest, message if status.at_rest else f"{message}; {_MAY_RUN}"

    return stop


def notify(line: str) -> None:
    """Send a line, such as ``READY=1``, to systemd if systemd started this process."""
    path = os.environ.get("NOTIFY_SOCKET")
    if not path:
        return
    address = f"\0{path[1:]}" if path.startswith("@") else path  # an abstract socket
    # A service manager that restarts or is slow must not stop the process that it watches.
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        sender.sendto(line.encode(), address)


def _tell(text: str) -> None:
    """Print lines for human readers; the last one is the status in systemd."""
    print_line(text)
    notify("STATUS=" + text.rpartition("\n")[2])


def _supervise(supervisor: LiveSupervisor, signals: Signals) -> NoReturn:
    """Start and monitor the processes until an error ends the site, and end them.

    Raises:
        InterruptedRun: if a signal arrived.
        NodeFailed: if the site cannot be kept running.
    """
    notify("READY=1")
    notified = 0.0
    try:
        while True:
            supervisor.read()
            signals.check()  # before update(): what a service manager stops has not failed
            supervisor.update()
            now = time.monotonic()
            if now - notified >= _NOTIFY_S:
                notified = now
                notify("WATCHDOG=1")
    finally:
        notify("STOPPING=1")
        _tell("stopping the pump, and then the nodes")
        supervisor.end()


def _end(write: Callable[[str, str], None], may_run: str, error: Exception) -> int:
    """Record and print the reason why the site ended; return the exit code."""
    is_done = isinstance(error, InterruptedRun) and not may_run
    reason = str(error) if isinstance(error, (InterruptedRun, NodeFailed)) else describe(error)
    reason = "; ".join(filter(None, (reason, may_run)))
    write(summary.DONE if is_done else summary.FAILED, reason)
    DISK.wait(_WRITTEN_S)
    _tell(f"done: {reason}" if is_done else f"error: {reason}")
    if is_done:
        return EXIT_DONE
    return error.code if isinstance(error, NodeFailed) and not may_run else EXIT_FAILED


def _summarize(site: LiveSite, directory: Path) -> Callable[[str, str | None], None]:
    """Return a function that writes the site's summary with a status and a reason, and its alarms.

    The disk thread writes it, so that no disk stops the site.
    """
    setting: dict[str, Any] = {
        "began": iso(time.time()),
        "controller": site.controller.name,
        "parameters": replace_infinity(site.parameters),
        "forecast": site.forecast,
        "drive_at": site.drive_at,
        "versions": versions(),
    }

    before = max((alarm.number for alarm in _list_alarms(directory)), default=0)

    def write(values: dict[str, Any]) -> None:
        new = [to_record(each) for each in _list_alarms(directory) if each.number > before]
        summary.write({**values, **setting, "alarms": new}, directory)

    def queue(status: str, reason: str | None) -> None:
        ended = None if status == summary.RUNNING else iso(time.time())
        values = {"status": status, "reason": reason, "ended": ended}
        DISK.do(partial(_try, partial(write, values)))

    return queue


def _list_alarms(directory: Path) -> list[Alarm]:
    try:
        return read_alarms(directory)
    except (OSError, ValueError):  # the alarms node reports it
        return []


def _try(write: Callable[[], object]) -> None:
    """Write a file for those who look at the site later; warn if this fails."""
    try:
        write()
    except OSError as error:
        print_line(f"warning: {error.filename}: {error.strerror}; the file is not written")


class _StartedFiles:
    """The files with which a site is started, whose content its nodes read even after a restart.

    Nodes read copies, since the originals may be edited. Only the forecast, which is replaced in
    place, and the controller's code are read from their original paths. The copies are stored in
    memory, since the disk may be full after a power cut, with no one there to free space. A
    clean-up program may remove the copies, as may systemd when their user logs out, so missing or
    damaged copies are written again before every start of a node.

    Attributes:
        site: the content of the site file, without references to other files.
    """

    def __init__(self, directory: Path, site_file: Path, files: Sequence[Path]) -> None:
        """Read the files.

        Args:
            directory: directory of the copies.
            site_file: the site file.
            files: the other files.

        Raises:
            OSError: if a file cannot be read.
        """
        self._directory, self.site = directory, format_site(read_site(site_file))
        # The content and the mode of each copy: logins must stay private.
        self._copies = {self.copy_of(site_file): (self.site.encode(), 0o644)} | {
            self.copy_of(file): (file.read_bytes(), file.stat().st_mode & 0o777) for file in files
        }

    def copy_of(self, file: Path) -> Path:
        """Return the path of a file's copy."""
        return Path(f"{self._directory}{file.absolute()}")

    def write(self) -> dict[str, str]:
        """Write the copies that are missing or damaged; return the environment that names them.

        Raises:
            OSError: if the copies cannot be written.
        """
        for copy, (content, mode) in self._copies.items():
            with suppress(OSError):
                if copy.read_bytes() == content:
                    continue
            with add_path_to_errors(self._directory):
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.unlink(missing_ok=True)
                with open(copy, "wb", opener=partial(os.open, mode=mode)) as stream:
                    stream.write(content)
        self._directory.chmod(0o755)  # the page may run as another user
        return {COPIES: str(self._directory)}
