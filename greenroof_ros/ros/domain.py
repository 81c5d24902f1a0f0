"""Access to the ROS domain: joining it, and finding the other nodes in it.

ROS is imported only when a function needs it.

The nodes communicate over UDP on the loopback interface, never through shared memory, although Fast
DDS (the default middleware of ROS 2) uses shared memory by default between processes of one
machine. A process, such as a ``ros2 topic echo`` after Ctrl-Z, that is stopped while it holds a
lock in shared memory freezes unrelated nodes, and ``kill -9`` leaves the memory behind. UDP has
neither problem, but makes each tick a little longer.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from greenroof_ros.base.errors import (
    ConfigurationError,
    OccupiedError,
    describe_choices,
    describe_extra,
)
from greenroof_ros.base.files import shared_directory
from greenroof_ros.base.processes import LockedError, acquire_name_lock
from greenroof_ros.base.ranges import Range

_DISCOVERY = "ROS_AUTOMATIC_DISCOVERY_RANGE"
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
# The packages of ROS 2 that this package imports.
_ROS = (
    "rclpy", "rcl_interfaces", "std_msgs", "std_srvs", "rosgraph_msgs", "diagnostic_msgs",
    "builtin_interfaces", "rpyutils", "rosidl_runtime_py",
)
# How long to listen for nodes that are already in the graph (s). On loopback they answer in well
# under half of that. The check for two publishers finds a node that is missed here.
_LISTEN_S = 1.0
# How long the middleware may take to shut down (s): a fraction of a second, unless the machine is
# busy. Fast DDS can lock up and spin while it shuts down at the same time as a peer, in a call or
# when Python frees its last objects at exit. No Python code runs then, so the kernel must end the
# process (SIGALRM).
SHUTDOWN_S = 6


def end_without_ros() -> None:
    """Exit with a one-line error and code 2 if ROS 2 is missing."""
    try:
        _check_ros()
    except ConfigurationError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def check_environment() -> None:
    """Check that ROS 2 can be loaded, and will use the domain and range in the environment.

    Raises:
        ConfigurationError: if ROS 2 is missing, or if ROS would silently use another domain or
            range, so that messages might leave the machine.
    """
    _check_ros()
    read_domain()
    scope = os.environ.get(_DISCOVERY)
    if scope and scope not in _RANGES:
        raise ConfigurationError(describe_choices(_RANGES, scope), key=_DISCOVERY, value=scope)


def _check_ros() -> None:
    if importlib.util.find_spec("rclpy") is None:
        raise ConfigurationError(
            f"ROS 2 is not available: source your ROS 2, or {describe_extra('ros')}; "
            "greenroof simulate does not need ROS 2"
        )


def read_domain() -> int:
    """Return the number of the ROS domain.

    Raises:
        ConfigurationError: if the variable is not the number of a domain that has ports, or if ROS
            would read it as an octal number.
    """
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not re.fullmatch("0|[1-9][0-9]{0,2}", text) or int(text) > _LAST_DOMAIN:
        raise ConfigurationError(
            Range(0, _LAST_DOMAIN, whole=True).expected(), key="ROS_DOMAIN_ID", value=text
        )
    return int(text)


def parse_namespace(text: str) -> str:
    """Return a namespace in ROS notation, such as ``/site1``; empty for no namespace."""
    name = text.strip("/")
    if name and not re.fullmatch(r"([A-Za-z_]\w*/)*[A-Za-z_]\w*", name, re.ASCII):
        raise ValueError
    return f"/{name}" if name else ""


# argparse shows this in its error message
parse_namespace.__name__ = (
    "namespace of letters, digits and _ that does not begin with a digit, such as site1"
)


def add_namespace(parser: argparse.ArgumentParser, more: str = "") -> None:
    """Add the option for the namespace of the graph that a command joins."""
    parser.add_argument(
        "--namespace", type=parse_namespace, default="", metavar="NAME",
        help=f"namespace of the graph, as passed to greenroof run or live{more} (default: none)",
    )


@contextmanager
def require_ros() -> Iterator[None]:
    """Turn an import error of ROS 2 in the block into a ConfigurationError.

    Raises:
        ConfigurationError: if ROS 2 cannot be imported; the message states the remedy.
    """
    check_environment()
    try:
        yield
    except ImportError as error:
        if error.name and error.name.partition(".")[0] not in _ROS:
            raise  # of another package, such as one that a user's controller needs
        raise ConfigurationError(
            "ROS 2 cannot be imported: repair the installation of ROS 2, or "
            f"{describe_extra('ros')}; greenroof simulate does not need ROS 2 ({error})"
        ) from error


def _is_fast_dds_3() -> bool:
    """Detect Fast DDS 3 from the loaded library's name, since its version cannot be queried."""
    return "/libfastdds.so" in Path("/proc/self/maps").read_text(encoding="utf-8")


def prepare_ros() -> None:
    """Prepare this process for ROS, and select UDP; call this function before ``rclpy.init``.

    If the user allows the graph to leave the machine (``ROS_AUTOMATIC_DISCOVERY_RANGE`` other than
    ``LOCALHOST``), UDP uses all network interfaces. Nothing is changed if the user names a profiles
    file or uses another middleware.

    With ``LOCALHOST``, the middleware would use shared memory regardless of the profiles file.
    Therefore this function sets ``SYSTEM_DEFAULT`` instead, and a profiles file that binds all
    sockets to the loopback interface.

    Raises:
        ConfigurationError: if :func:`check_environment` raises one.
    """
    check_environment()
    import rclpy

    # The first node would import ROS's generator of Python code, with a parser and templates, which
    # nothing here uses. Blocking the import saves a tenth of a node's start time.
    sys.modules.setdefault("rosidl_generator_py.generate_py_impl", None)  # type: ignore[arg-type]
    # To ROS, empty means SUBNET.
    discovery = os.environ[_DISCOVERY] = os.environ.get(_DISCOVERY) or "LOCALHOST"
    fast_dds = rclpy.get_rmw_implementation_identifier().startswith("rmw_fastrtps")
    if not fast_dds or any(map(os.environ.get, _PROFILES)):
        return
    os.environ.setdefault(LEASE, _LEASE_S)
    is_3 = _is_fast_dds_3()
    variable, name = _PROFILES[is_3], "fastdds3" if is_3 else "fastdds"
    if discovery == "LOCALHOST":
        os.environ[_DISCOVERY] = "SYSTEM_DEFAULT"
        name += "_loopback"
    else:
        os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    os.environ[variable] = str(shared_directory() / "config" / f"{name}.xml")


def join(words: Sequence[str] = ()) -> Any:
    """Join the domain as an observer, with a separate context, and return the context.

    Args:
        words: command line whose ROS arguments apply to the nodes of the context.

    Raises:
        ConfigurationError: if ROS 2 is not installed.
    """
    with require_ros():
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    prepare_ros()
    context = rclpy.Context()
    rclpy.init(
        # Its log file would need a home directory, which a service may not have.
        args=["--ros-args", "--disable-external-lib-logs", "--", *words], context=context,
        signal_handler_options=SignalHandlerOptions.NO,
    )
    return context


def ros_arguments(
    parameters: Iterable[Path], namespace: str, more: Sequence[str] = ()
) -> list[str]:
    """Return the ROS arguments for bringup's nodes, which disable rcl's own log files.

    These files would grow for months in the user's home directory, and a hanging disk would stop
    the node.

    Args:
        parameters: ROS 2 parameter files; later files override earlier ones.
        namespace: namespace of the nodes, such as ``/site1``; empty for none.
        more: a command line whose ROS arguments apply as well; of parameters, the last one wins.
    """
    files = [word for file in parameters for word in ("--params-file", str(file))]
    remapped = ["-r", f"__ns:={namespace}"] if namespace else []
    return ["--ros-args", "--disable-external-lib-logs", *files, *remapped, "--", *more]


def _occupied(reason: str, namespace: str) -> OccupiedError:
    domain = read_domain()
    place = f"in ROS domain {domain}" + (f", namespace {namespace}" if namespace else "")
    return OccupiedError(
        f"{reason} is already running {place}; stop it, or use another --namespace or another "
        f"domain, such as ROS_DOMAIN_ID={domain % 100 + 1}"
    )


@contextmanager
def lock_namespace(namespace: str) -> Iterator[None]:
    """Lock a namespace of the ROS domain, so that only one bringup of this user runs in it.

    Discovery would also find the nodes of another bringup, but not always in time on a busy
    machine.

    Args:
        namespace: namespace such as ``/site1``; empty for none.

    Raises:
        OccupiedError: if a bringup is already running in the namespace.
        OSError: if the system does not support this kind of lock.
    """
    try:
        lock = acquire_name_lock(f"{os.getuid()}-domain-{read_domain()}{namespace}")
    except LockedError:
        raise _occupied("a bringup", namespace) from None
    with lock:
        yield


def refuse_other_nodes(namespace: str, names: Collection[str], check: Callable[[], None]) -> None:
    """Listen for 1 s, and raise an error if nodes with these names are already in the namespace.

    The listening node leaves the graph before the nodes of the run are created.

    Args:
        namespace: namespace such as ``/site1``; empty for none.
        names: names of the nodes of the run.
        check: callback that is called every 50 ms; it can raise an error to end the wait.

    Raises:
        OccupiedError: if a node with one of the names is already in the namespace.
        ConfigurationError: if ROS 2 is not installed.
    """
    context = join()
    from rclpy.node import Node

    node = Node("bringup", context=context, start_parameter_services=False, enable_rosout=False)
    try:
        until = time.monotonic() + _LISTEN_S
        while time.monotonic() < until:
            check()
            time.sleep(0.05)
            running = sorted(
                name
                for name, place in node.get_node_names_and_namespaces()
                if place == (namespace or "/") and name in names
            )
            if running:
                raise _occupied(f"a graph with {', '.join(running)}", namespace)
    finally:
        node.destroy_node()
        context.try_shutdown()
