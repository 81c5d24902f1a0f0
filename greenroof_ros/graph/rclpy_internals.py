"""What this package uses of rclpy that is not public: here and nowhere else, each with its reason.

A new rclpy may lack any of it without a word, so that ``test/graph/test_rclpy_internals.py`` uses
all of it, and fails then.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

_CLOCK = "/clock"  # as rclpy names it


class NoClockSubscription:
    """Beside ``Node``: a node in simulated time that does not subscribe to the clock by itself.

    rclpy's own subscription, to ``/clock`` even in a namespace, costs 35 us of processor time a
    tick in each node. It is opened by this method, and there is no public way to do without.
    """

    def create_subscription(self, msg_type: Any, topic: str, *args: Any, **options: Any) -> Any:
        """Open a subscription, but not rclpy's own to the clock."""
        if topic == _CLOCK:
            return None
        return super().create_subscription(  # type: ignore[misc]
            msg_type, topic, *args, **options
        )


def waiting_in(subscription: Any) -> Iterator[tuple[bytes, Any]]:
    """Take the messages that wait, serialised, each with what rclpy says of it.

    rclpy hands them to callbacks only, and its fast executor calls none for what waited before
    it listened, and none says the number that the publisher gave a message.
    """
    with subscription.handle:
        while (sample := subscription.handle.take_message(subscription.msg_type, True)) is not None:
            yield sample


def lifecycle_state(node: Any) -> int:
    """Return the present state of a lifecycle node: there is no public way to read it."""
    return int(node._state_machine.current_state[0])


def wrap_change_state(
    node: Any, wrap: Callable[[Callable[[Any, Any], Any]], Callable[[Any, Any], Any]]
) -> None:
    """Wrap what answers a lifecycle node's service ``change_state``.

    rclpy's own answer ends the node with an exception where the present state lacks a transition, a
    second *activate* perhaps (rclpy issue 1209).
    """
    service = node._service_change_state
    service.callback = wrap(service.callback)
