"""Access to the ROS domain: options, joining it, excluding a second graph, and starting a graph.

ROS is imported only when a function needs it.

The nodes communicate over UDP on the loopback interface, never through shared memory, although Fast
DDS (the default middleware of ROS 2) uses shared memory by default between processes of one
machine. A process, such as a ``ros2 topic echo`` after Ctrl-Z, that is stopped while it holds a
lock in shared memory freezes unrelated nodes, and ``kill -9`` leaves the memory behind. UDP has
neither problem, but makes each tick a little longer.

A watcher that an option requests is a separate process; a run neither waits for a watcher nor fails
because of one.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_INTERRUPTED, make_number_type
from greenroof_ros.base.errors import (
    ConfigurationError,
    OccupiedError,
    describe_choices,
    describe_extra,
)
from greenroof_ros.base.files import shared_directory
from greenroof_ros.base.processes import (
    InterruptedRun,
    LockedError,
    Signals,
    acquire_name_lock,
    child_environment,
)
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.standard_error import print_line
from greenroof_ros.interface.states import EXTERNAL

_DOMAIN, _DISCOVERY = "ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"
_RANGES = ("LOCALHOST", "SUBNET", "SYSTEM_DEFAULT", "OFF")
# From this number on, a domain's ports overlap the system's ephemeral ports.
_LAST_DOMAIN = 101
# Used in all profiles files: how long the others consider a killed process to be there (s). In
# lockstep, a node stopped for longer than this is discovered a second time, and its recent messages
# come twice.
LEASE, _LEASE_S = "GREENROOF_ROS_LEASE_S", "20"
# The variables that name a profiles file; Fast DDS 3 (ROS 2 Kilted) reads the second, and warns
# about the first.
_PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
# How long the middleware may take to shut down (s): a fraction of a second, unless the machine is
# busy. Fast DDS can lock up and spin while it shuts down at the same time as a peer, in a call or
# when Python frees its last objects at exit. No Python code runs then, so the kernel must end the
# process (SIGALRM).
SHUTDOWN_S = 10


def read_domain() -> int:
    """Return the number of the ROS domain.

    Raises:
        ConfigurationError: if the variable is not the number of a domain that has ports.
    """
    text = os.environ.get(_DOMAIN) or "0"
    try:
        return int(Range(0, _LAST_DOMAIN, whole=True).parse(text))
    except ValueError as error:
        raise ConfigurationError(str(error), key=_DOMAIN, value=text) from None


def parse_namespace(text: str) -> str:
    """Return a namespace in ROS notation, such as ``/site1``; empty for no namespace."""
    name = text.strip("/")
    if name and not re.fullmatch(r"([A-Za-z_]\w*/)*[A-Za-z_]\w*", name, re.ASCII):
        raise ValueError
    return f"/{name}" if name else ""


# argparse shows this in its error message
parse_namespace.__name__ = "name of letters, digits and _, such as site1"


def add_namespace(
    parser: argparse._ActionsContainer,
    about: str = "namespace of the graph, as passed to greenroof run or live",
) -> None:
    """Add the option for the namespace of a graph."""
    parser.add_argument(
        "--namespace", type=parse_namespace, default="", metavar="NAME",
        help=f"{about} (default: none)",
    )


def prepare_ros() -> None:
    """Prepare this process for ROS, and select UDP; call this function before ``rclpy.init``.

    If the user allows the graph to leave the machine (``ROS_AUTOMATIC_DISCOVERY_RANGE`` other than
    ``LOCALHOST``), UDP uses all network interfaces. Nothing is changed if the user names a profiles
    file or uses another middleware.

    With ``LOCALHOST``, the middleware would use shared memory regardless of the profiles file.
    Therefore this function sets ``SYSTEM_DEFAULT`` instead, and a profiles file that binds all
    sockets to the loopback interface.

    Raises:
        ConfigurationError: if ROS 2 cannot be imported, or if it would silently use another domain
            or range than the environment states, so that messages might leave the machine.
    """
    try:
        import rclpy
    except ImportError as error:
        raise ConfigurationError(
            f"ROS 2 is not available ({error}): source your ROS 2, or {describe_extra('ros')}; "
            "greenroof simulate does not need ROS 2"
        ) from error
    read_domain()
    # To ROS, empty means SUBNET.
    discovery = os.environ[_DISCOVERY] = os.environ.get(_DISCOVERY) or "LOCALHOST"
    if discovery not in _RANGES:
        raise ConfigurationError(
            describe_choices(_RANGES, discovery), key=_DISCOVERY, value=discovery
        )
    fast_dds = rclpy.get_rmw_implementation_identifier().startswith("rmw_fastrtps")
    if not fast_dds or any(map(os.environ.get, _PROFILES)):
        return
    os.environ.setdefault(LEASE, _LEASE_S)
    # The version of Fast DDS cannot be queried, but it is in the name of the loaded library.
    is_3 = "/libfastdds.so" in Path("/proc/self/maps").read_text(encoding="utf-8")
    variable, name = _PROFILES[is_3], "fastdds3" if is_3 else "fastdds"
    if discovery == "LOCALHOST":
        os.environ[_DISCOVERY] = "SYSTEM_DEFAULT"
        name += "_loopback"
    else:
        os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    os.environ[variable] = str(shared_directory() / "config" / f"{name}.xml")


def join() -> Any:
    """Join the domain as an observer, with a separate context, and return the context.

    Raises:
        ConfigurationError: if ROS 2 is not installed, or the environment is wrong.
    """
    prepare_ros()
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    context = rclpy.Context()
    rclpy.init(
        # Its log file would need a home directory, which a service may not have.
        args=["--ros-args", "--disable-external-lib-logs"], context=context,
        signal_handler_options=SignalHandlerOptions.NO,
    )
    return context


def ros_arguments(parameters: Iterable[Path], namespace: str) -> list[str]:
    """Return the ROS arguments for bringup's nodes, which disable rcl's own log files.

    These files would grow for months in the user's home directory, and a hanging disk would stop
    the node.

    Args:
        parameters: ROS 2 parameter files; later files override earlier ones.
        namespace: namespace of the nodes, such as ``/site1``; empty for none.
    """
    files = [word for file in parameters for word in ("--params-file", str(file))]
    remapped = ["-r", f"__ns:={namespace}"] if namespace else []
    return ["--ros-args", "--disable-external-lib-logs", *files, *remapped, "--"]


@contextmanager
def lock_bringup(namespace: str, directory: Path | None = None) -> Iterator[None]:
    """Lock a namespace of the ROS domain and a directory for a bringup of this user.

    Args:
        namespace: namespace such as ``/site1``; empty for none.
        directory: directory of a live site; None for none.

    Raises:
        OccupiedError: if another bringup is running in the namespace or with the directory.
        ConfigurationError: if the number of the domain is invalid.
        OSError: if the system does not support this kind of lock.
    """
    places = [f"ROS domain {read_domain()}, namespace {namespace or '/'}"]
    if directory is not None:
        places.append(f"{directory.resolve()}")
    with ExitStack() as locks:
        for place in places:
            try:
                locks.enter_context(acquire_name_lock(f"{os.getuid()} {place}"))
            except LockedError:
                raise OccupiedError(
                    f"a bringup is already running in {place}; stop it, or use another "
                    "--namespace, ROS_DOMAIN_ID or --state"
                ) from None
        yield


def add_graph_arguments(parser: argparse.ArgumentParser, pump: str = "") -> None:
    """Add the options of the graph, which ``run`` and ``live`` share.

    Args:
        parser: argument parser of the command.
        pump: default value of ``--pump``; if it is empty, ``external`` is the only choice.
    """
    group = parser.add_argument_group("the graph")
    group.add_argument(
        "--pump", choices=[*filter(None, [pump]), EXTERNAL], default=pump,
        help="source of /pump/flow; external selects a pump driver that you start yourself"
        + (f" (default: {pump})" if pump else ""),
    )
    add_namespace(
        group, "put the whole graph, including its clock, in the namespace /NAME, so that several "
        "graphs can run side by side in one ROS domain",
    )
    if pump:
        group.add_argument(
            "--peer-limit", type=make_number_type(2, 1e6), default=5.0, metavar="S",
            help="longest time to wait for a node (s of wall time; default: %(default)s s)",
        )
    group.add_argument(
        "--watch", action="store_true",
        help="show the graph on a page in a web browser, and print the address of the page; for a "
        "run, only at a --speed of 60 or less. The page closes when the graph stops, whereas the "
        "page of greenroof watch stays open. Requires the extra [watch]",
    )
    if not pump:
        group.add_argument(
            "--node-parameters", type=Path, metavar="FILE",
            help="ROS 2 parameter file for the parameters that bringup does not set, such as the "
            "limits of the pump node (doc/reference/nodes.md); unknown parameters are rejected",
        )


# --- starting a graph -----------------------------------------------------------------------------

# How long the watcher may take to end (s) before it is killed.
_ENDING_S = 3.0
# How often a watcher that has exited is started again, after which time, and how often it is
# checked (s).
_MAX_RESTARTS, _WAIT_S, _CHECK_S = 10, 2.0, 0.25


def bring_up(
    arguments: argparse.Namespace, start: Callable[[Signals], int], stopped: int = EXIT_INTERRUPTED
) -> int:
    """Start a graph, with the watcher for ``--watch``; return the exit code.

    Args:
        arguments: the parsed command line.
        start: function that runs the graph and returns the exit code.
        stopped: exit code to return if a signal arrives before the first node is started, or after
            the run.
    """
    signals, ending = Signals(), threading.Event()
    keeper = threading.Thread(target=_keep_watcher, args=(arguments.namespace, ending))
    if arguments.watch:
        keeper.start()
    try:
        code = start(signals)
    except InterruptedRun as error:  # before any node was started
        print(error, file=sys.stderr)
        return stopped
    finally:
        signals.ignore()
        ending.set()
        if keeper.is_alive():
            keeper.join()
    return code or (stopped if signals.received else EXIT_DONE)


def _keep_watcher(namespace: str, ending: threading.Event) -> None:
    """Run ``greenroof watch`` until the run ends; it prints its address.

    If the watcher exits early, it is started again, at most ten times, and a line says so; the run
    continues.
    """
    for left in reversed(range(_MAX_RESTARTS + 1)):
        process = subprocess.Popen(
            [sys.executable, "-m", "greenroof_ros", "watch", f"--namespace={namespace}"],
            stdin=subprocess.DEVNULL, stdout=sys.stderr,  # a run's output may be JSON
            start_new_session=True,  # Ctrl-C is for the run, which ends the watcher
            env=child_environment(),
        )
        while process.poll() is None and not ending.wait(_CHECK_S):
            pass
        if ending.is_set():
            process.terminate()
            try:
                process.wait(_ENDING_S)
            except subprocess.TimeoutExpired:
                process.kill()
            return
        then = f"starts again in {_WAIT_S:g} s" if left else "is given up"
        print_line(f"watch: the watcher has exited, and {then}; the run continues")
        if ending.wait(_WAIT_S):
            return
