"""Who is in a ROS domain: one bringup for each namespace, and no nodes of an earlier run."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError, OccupiedError
from greenroof_ros.common.lock import LockedError, take_lock
from greenroof_ros.graph.errors import no_ros
from greenroof_ros.graph.transport import choose_transport

# How long to listen for nodes that are in the graph already (s). On loopback they answer in well
# under half of it; whom this misses is met by the check for two publishers.
_LISTEN_S = 1.0
# Above it the ports of a domain run into those that the system lends.
_LAST_DOMAIN = 101
# Where bringups lock each other out: in memory, so that a full disk keeps none from starting.
_LOCKS = Path("/dev/shm")


def _domain() -> int:
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > _LAST_DOMAIN:
        raise ConfigurationError(
            f"must be a number from 0 to {_LAST_DOMAIN}", key="ROS_DOMAIN_ID", value=text
        )
    return int(text)


def _taken(what: str, namespace: str) -> OccupiedError:
    domain = _domain()
    place = f"in ROS domain {domain}" + (f", namespace {namespace}" if namespace else "")
    return OccupiedError(
        f"{what} already {place}; end it, or take another domain: "
        f"ROS_DOMAIN_ID={domain % 100 + 1} greenroof run ..., or another --namespace"
    )


@contextmanager
def only_bringup(namespace: str) -> Iterator[None]:
    """Hold a namespace of the ROS domain against another bringup on this machine.

    Discovery would find its nodes, too, but on a busy machine not always in time.

    Args:
        namespace: ``/site1``, or empty for none.

    Raises:
        OccupiedError: one runs already.
        ConfigurationError: the lock cannot be opened. Everybody may write where it is: a symbolic
            link in its place, to a file of this user's, is not followed.
    """
    name = f"greenroof_ros-{os.getuid()}-domain-{_domain()}{namespace.replace('/', '-')}.lock"
    lock = _LOCKS / name
    try:
        held = take_lock(lock)
    except LockedError:
        raise _taken("a bringup runs", namespace) from None
    except OSError as error:
        raise ConfigurationError(
            f"cannot be opened ({error.strerror}), without which two bringups could run one site; "
            "remove it", file=lock,
        ) from error
    with held:
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
    try:
        import rclpy
        from rclpy.node import Node
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise no_ros(error) from error
    choose_transport()
    context = rclpy.Context()
    rclpy.init(
        # Its log file would need a home directory, which a service may not have.
        args=["--ros-args", "--disable-external-lib-logs"], context=context,
        signal_handler_options=SignalHandlerOptions.NO,
    )
    node = Node("bringup", context=context, start_parameter_services=False, enable_rosout=False)
    try:
        until = time.monotonic() + _LISTEN_S
        while time.monotonic() < until:
            check()
            time.sleep(0.05)
            found = sorted(
                name
                for name, place in node.get_node_names_and_namespaces()
                if place == (namespace or "/") and name in names
            )
            if found:
                raise _taken(f"a graph with {', '.join(found)} runs", namespace)
    finally:
        node.destroy_node()
        context.try_shutdown()
