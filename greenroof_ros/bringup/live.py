"""A live site kept up: its directory, its nodes, and what is said of it until it is stopped."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import yaml

from greenroof_ros.bringup.live_options import EXTERNAL, LiveSite
from greenroof_ros.bringup.status import Expected, Status, values_of
from greenroof_ros.common.command_line import EXIT_DONE, EXIT_FAILED
from greenroof_ros.common.disk import DISK
from greenroof_ros.common.errors import ConfigurationError, OccupiedError
from greenroof_ros.common.signals import InterruptedRun, Signals
from greenroof_ros.common.systemd import notify
from greenroof_ros.common.versions import versions
from greenroof_ros.controllers.registry import controller_names
from greenroof_ros.drives.sensor_file import read_sensors
from greenroof_ros.experiment import summary
from greenroof_ros.experiment.incidents import INCIDENTS, PROCESS, IncidentLog, with_incidents
from greenroof_ros.graph.domain import only_bringup, refuse_other_nodes
from greenroof_ros.graph.live_supervisor import Failure, LiveSupervisor
from greenroof_ros.graph.node_processes import NodeFailed
from greenroof_ros.graph.states import PUMP, RECORDER

_NODES = "greenroof_ros.nodes"
_TANKS = ("cistern", "roof")
_BRINGUP = "bringup"  # among the nodes that something was lost of
# How often systemd is told (s), and how long the start may then still take (microseconds).
_NOTIFY_S = 1.0
_STILL_STARTING = "EXTEND_TIMEOUT_USEC=30000000"
# Size of one file of the bag (MB), where the whole may be ten times that.
_BAG_FILE_MB = 100.0
# How long the end of a site waits for its summary to be written (s).
_WRITTEN_S = 5.0
# Files that are in memory (Linux).
_IN_MEMORY = "/dev/shm"


def run_live(site: LiveSite, signals: Signals) -> int:
    """Start the nodes of a live site and keep them up until a signal comes.

    Returns:
        The exit code: 0 where it was asked to stop, the pump stands, and there was no incident.

    Raises:
        ConfigurationError: there is a graph already, no ROS 2, or the directory cannot be made.
    """
    names = {name for name, *_ in nodes_of(site)} | {"plant", *controller_names()}
    with (
        only_bringup(site.namespace),
        _state_directory(site.state) as state,
        Status(_expected(site)) as status,
        tempfile.TemporaryDirectory(dir=_IN_MEMORY) as memory,
    ):
        record = _Record(site, state, status)
        record.say_last_end()
        status.update({}, "starting", record.log)
        refuse_other_nodes(site.namespace, names, signals.check)
        supervisor = LiveSupervisor(
            state / "log", _configuration(site, state, Path(memory), status), site.namespace,
            silence_s=site.silence_s,
            restarts=site.restarts,
            stop_drive=site.drive.stopper() if site.drive is not None else None,
            on_failure=record.add,
        )
        try:
            record.write(summary.RUNNING)
            with supervisor:
                for node in nodes_of(site):
                    supervisor.add(*node)
                _keep_up(supervisor, record, status, signals, pump=site.drive is not None)
        except InterruptedRun as error:
            signals.ignore()
            if not supervisor.may_run:
                record.write_last(summary.DONE, str(error))
                status.say(f"{error}: the pump and the nodes are stopped")
                status.say(with_incidents("done", record.log.count))
                return EXIT_FAILED if record.log.count else EXIT_DONE
            _fail(record, status, f"{error}; {supervisor.may_run}")
            return EXIT_FAILED
        except NodeFailed as error:
            signals.ignore()
            reason = "; ".join(filter(None, (error.reason, supervisor.may_run)))
            _fail(record, status, reason, error.last_lines)
            return EXIT_FAILED if supervisor.may_run else error.code
        except Exception as error:  # whatever it is, the summary must not say that the site runs
            reason = f"{type(error).__name__}: {error}"
            _fail(record, status, "; ".join(filter(None, (reason, supervisor.may_run))))
            raise
    raise AssertionError("a live site ends by a signal or a failure")


def _fail(record: _Record, status: Status, reason: str, *last_lines: str) -> None:
    """Keep and say why the site ended, so that somebody looks at it."""
    record.write_last(summary.FAILED, reason)
    notify(f"STATUS={reason}")
    status.say("\n".join([f"error: {reason}", *last_lines]))


class _Record:
    """What is kept of a site since its start, ``summary.json``.

    The disk's thread writes it: a disk that is full, or hangs, stops nobody.

    Attributes:
        log: of the incidents.
    """

    def __init__(self, site: LiveSite, state: Path, status: Status) -> None:
        self.log = IncidentLog(status.say, state / INCIDENTS)
        try:
            self.log.go_on()
        except (OSError, ValueError) as error:
            status.say(f"warning: {error}; the incidents of earlier starts are not shown")
        self._state = state
        self._status = status
        self._began = _now()
        self._written = 0
        self._content: dict[str, Any] = {}
        self._problem = self._said = ""
        self._disk_is_late = False
        self._what = summary.RUNNING
        self._reason: str | None = None
        self._last_time = _last_time(state)
        self._setting = {
            "controller": site.controller.name,
            "parameters": summary.finite(site.parameters),
            "site": str(site.site_file),
            "sensors": str(site.sensors or EXTERNAL),
            "forecast": str(site.forecast) if site.forecast else None if site.weather else EXTERNAL,
            "drive": str(site.drive.file if site.drive else EXTERNAL),
            "drive_at": site.drive.at if site.drive else None,
            "versions": versions(),
        }

    def say_last_end(self) -> None:
        """Say how the site ended the last time, unless it was asked to."""
        before = self._last_time
        if before is None or before["status"] == summary.DONE:
            return
        if before["status"] == summary.RUNNING:
            how = "bringup was killed, or the power failed"
        else:
            how = f"bringup ended at {before['ended']}: {before['reason']}"
        self._status.say(f"the last time, since {before['began']}, {how}")

    def add(self, failure: Failure) -> None:
        """Say and keep that a node failed."""
        self.log.begin(failure.node, PROCESS, str(failure))
        self._write()

    def look(self, supervisor: LiveSupervisor, *, starting: bool) -> None:
        """Find what was lost, or has come back, since the last call; keep it."""
        for node in supervisor.ready:
            self.log.end(node, PROCESS)
        self.log.look(supervisor.last, starting=starting)
        self._look_at_disk()
        if self.log.changes != self._written:
            self._write()
        self._say_problem()

    def _look_at_disk(self) -> None:
        """Find that the disk hangs, and that it does no more."""
        before, self._disk_is_late = self._disk_is_late, DISK.late
        if self._disk_is_late and not before:
            self.log.begin(
                _BRINGUP, "disk",
                f"{self._state}: the disk takes nothing; logs and summary wait in memory",
            )
        elif before and not self._disk_is_late:
            self.log.end(_BRINGUP, "disk")
            if DISK.refused:
                self._status.say(
                    f"warning: {self._state}: {DISK.refused} pieces of logs found no room in "
                    "memory since the start, and are lost"
                )

    def _say_problem(self) -> None:
        problem, before = self._problem, self._said
        if problem != before:
            self._said = problem
            if problem:
                self._status.say(f"warning: {problem}")

    def write_last(self, what: str, reason: str | None = None) -> None:
        """Keep how the site ended, and say where that is not on the disk within 5 s."""
        self.write(what, reason)
        if not DISK.wait(_WRITTEN_S):
            self._problem = f"{self._state}: the disk takes nothing; {summary.SUMMARY} is not kept"
        self._say_problem()

    def write(self, what: str, reason: str | None = None) -> None:
        """Keep how the site is: one of those of :mod:`greenroof_ros.experiment.summary`."""
        self._what, self._reason = what, reason
        self._write()

    def _write(self) -> None:
        self._content = {
            "status": self._what,
            "reason": self._reason,
            "began": self._began,
            "ended": None if self._what == summary.RUNNING else _now(),
            "last_time": self._last_time,
            "incident_count": self.log.count,
            "incidents": self.log.as_dicts(),
            **self._setting,
        }
        self._written = self.log.changes
        DISK.do(self._write_newest)

    def _write_newest(self) -> None:
        """Write it, on the disk's thread."""
        try:
            summary.write(self._content, self._state)
            self._problem = ""
        except OSError as error:
            self._problem = f"{error.filename or self._state}: {error.strerror}"


def _last_time(state: Path) -> dict[str, Any] | None:
    """Return when and how the site was started and ended before; None where that is not known."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        before = json.loads((state / summary.SUMMARY).read_text(encoding="utf-8"))
        return {key: before[key] for key in ("status", "reason", "began", "ended")}
    return None


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="milliseconds")


def _keep_up(
    supervisor: LiveSupervisor, record: _Record, status: Status, signals: Signals, *, pump: bool
) -> None:
    """Watch the nodes for ever.

    Raises:
        InterruptedRun: a signal came.
        NodeFailed: a node cannot be kept up.
    """
    ready = False
    notified = -_NOTIFY_S
    try:
        while True:
            supervisor.reports()
            signals.check()  # a service manager signals the nodes, too: their end is no failure
            supervisor.look()
            record.look(supervisor, starting=status.late)
            status.update(supervisor.last, supervisor.inhibit, record.log)
            if not ready and supervisor.all_ready:
                ready = True
                status.say("all nodes are here")
                notify("READY=1")
            now = time.monotonic()
            if now - notified >= _NOTIFY_S:
                notified = now
                held = supervisor.inhibit
                how = f"held: {held}" if held else values_of(supervisor.last)
                notify("WATCHDOG=1", f"STATUS={how}", *([] if ready else [_STILL_STARTING]))
    finally:
        notify("STOPPING=1")
        if pump:
            status.say("waiting for the pump to stand")


def _expected(site: LiveSite) -> dict[tuple[str, str], Expected]:
    """Return what a site needs before it can pump, by the node and the part that say how it is."""
    expected = {}
    if site.sensors is not None:
        sensors = read_sensors(site.sensors)
        for tank in _TANKS:
            address = getattr(sensors, tank).address
            expected[f"{tank}_sensor", "sensor"] = Expected(
                f"level of the {tank}", address,
                f"check the sensor's power and cable, and its address in {site.sensors.name}",
            )
    if site.forecast is not None:
        expected["weather", "forecast"] = Expected(
            "forecast", str(site.forecast),
            "put a newer file in its place, which is read by itself; without one on/off waters",
            needed=False,
        )
    if site.sensors is None or not site.weather:
        expected[site.controller.name, "inputs"] = Expected(
            f"inputs of {site.controller.name}", "your own nodes",
            "start the nodes that publish them",
        )
    if site.drive is not None:
        expected[PUMP, "drive"] = Expected(
            "drive", site.drive.at,
            "check its power and cable, and the address of --drive-at",
        )
    if site.weather:
        expected["weather", "frost"] = Expected(
            "frost", "/gauge/temperature" if site.forecast is None else "the forecast",
            "start the node that publishes /gauge/temperature (degC)" if site.forecast is None else
            "let the forecast have a column of temperature, or a node publish /gauge/temperature",
            well=("OK", "WARN"),
        )
    return expected


def nodes_of(site: LiveSite) -> Iterator[tuple[str, ...]]:
    """Return the nodes of a site: name, module and arguments of each."""
    if site.sensors is not None:
        for tank in _TANKS:
            yield f"{tank}_sensor", f"{_NODES}.level_sensor", "--tank", tank
    if site.weather:
        yield "weather", f"{_NODES}.weather"
    controller = site.controller
    yield controller.name, f"{_NODES}.controller", "--controller", controller.reference
    if site.drive is not None:
        yield PUMP, f"{_NODES}.pump"
    if site.record:
        yield RECORDER, f"{_NODES}.live_recorder"


@contextmanager
def _state_directory(path: Path) -> Iterator[Path]:
    """Make and hold the directory of a site.

    Raises:
        ConfigurationError: it cannot be made or written.
        OccupiedError: another bringup has it.
    """
    try:
        (path / "log").mkdir(parents=True, exist_ok=True)
        number = os.open(path, os.O_RDONLY)
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}", key="--state", value=str(path)
        ) from error
    try:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield path.resolve()
    except BlockingIOError:
        raise OccupiedError(
            "is of a bringup that runs; end it, or take another directory",
            key="--state", value=str(path),
        ) from None
    finally:
        os.close(number)


def _configuration(site: LiveSite, state: Path, memory: Path, status: Status) -> list[Path]:
    """Keep what the site was started with; in memory, and with a warning, on a full disk.

    After a power cut nobody is there to make room, and the plants need water.

    Args:
        site: as asked for.
        state: its directory.
        memory: a directory that is on no disk, for as long as the site runs.
        status: where the warning is said.

    Returns:
        The ROS 2 parameter files that all nodes read, bringup's and the user's.

    Raises:
        OSError: it cannot be written there, either.
    """
    place, part, old = (state / f"configuration{end}" for end in ("", ".part", ".old"))
    for left in (part, old):
        shutil.rmtree(left, ignore_errors=True)
    try:
        files = _write_configuration(site, state, part, place)
        if place.exists():
            place.rename(old)
        part.rename(place)
    except OSError as error:
        shutil.rmtree(part, ignore_errors=True)
        status.say(f"warning: {place}: {error.strerror}; the new configuration is in memory only")
        return _write_configuration(site, state, memory, memory)
    shutil.rmtree(old, ignore_errors=True)
    return files


def _write_configuration(
    site: LiveSite, state: Path, directory: Path, place: Path
) -> list[Path]:
    """Copy what the site was started with, and write the parameters of its nodes.

    A node that is started again reads the same files as before, whatever was edited meanwhile; but
    the forecast is read where it lies, since it is replaced there.

    Args:
        site: as asked for.
        state: its directory.
        directory: to write to; made where it is missing.
        place: where that will be.

    Returns:
        The ROS 2 parameter files that all nodes read, bringup's and the user's, in their place.

    Raises:
        OSError: it cannot be written.
    """
    directory.mkdir(exist_ok=True)
    kept: dict[str, str] = {}
    for name, file in (
        ("site", site.site_file),
        ("sensors", site.sensors),
        ("drive", site.drive.file if site.drive is not None else None),
        ("nodes", site.node_parameters),
    ):
        if file is not None:
            (directory / name).mkdir()
            shutil.copyfile(file, directory / name / file.name)
            kept[name] = str(place / name / file.name)
    parameters = {
        f"/**/{name}": {"ros__parameters": values}
        for name, values in _parameters(site, state, kept).items()
    }
    (directory / "parameters.yaml").write_text(
        yaml.safe_dump(parameters, sort_keys=False), encoding="utf-8"
    )
    return [place / "parameters.yaml", *(Path(kept[name]) for name in kept if name == "nodes")]


def _parameters(
    site: LiveSite, state: Path, kept: dict[str, str]
) -> dict[str, dict[str, Any]]:
    """Return the parameters of each node that bringup decides."""
    common = {"live": True, "site_file": kept["site"]}
    parameters: dict[str, dict[str, Any]] = {
        site.controller.name: {**common, **site.parameters},
        RECORDER: {
            "directory": str(state / "bag"),
            "file_limit": min(_BAG_FILE_MB, site.bag_limit / 10),
            "total_limit": site.bag_limit,
        },
    }
    if site.weather:
        parameters["weather"] = {
            **common,
            "forecast": str(site.forecast or ""),
            "horizon": site.parameters.get("horizon", 0.0),
            "all_members": site.controller.ensemble,
        }
    if site.sensors is not None:
        for tank in _TANKS:
            parameters[f"{tank}_sensor"] = {"sensors_file": kept["sensors"]}
    if site.drive is not None:
        kept_drive = replace(site.drive, file=Path(kept["drive"]))
        parameters[PUMP] = {**common, **kept_drive.parameters(state)}
    return parameters
