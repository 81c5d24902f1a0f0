"""All private parts of rclpy that this package uses, each with the reason.

A new rclpy can drop any of them without notice: ``test/graph/test_rclpy_internals.py`` uses all of
them, and then fails.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

_CLOCK = "/clock"  # rclpy's name


class NoClockSubscription:
    """Mixin for ``Node`` that keeps rclpy from subscribing to the clock in simulated time.

    rclpy's own subscription, which is to ``/clock`` even in a namespace, costs 35 us of processor
    time per tick in every node. rclpy opens it with this method, and has no public way to prevent
    it.
    """

    def create_subscription(self, msg_type: Any, topic: str, *args: Any, **options: Any) -> Any:
        """Open a subscription, except rclpy's own subscription to the clock."""
        if topic == _CLOCK:
            return None
        return super().create_subscription(  # type: ignore[misc]
            msg_type, topic, *args, **options
        )


def raw_publish(publisher: Any) -> Callable[[bytes], None]:
    """Return a function that publishes serialised messages on a publisher.

    For every message, rclpy's own ``publish`` compares types and locks the publisher against its
    destruction by another thread, which takes a quarter of its time.
    """
    publish: Callable[[bytes], None] = publisher.handle.publish_raw
    return publish


def take_messages(subscription: Any) -> Iterator[tuple[bytes, Any]]:
    """Yield the waiting messages, each serialised and with its metadata from rclpy.

    rclpy passes messages only to callbacks. Its fast executor calls no callback for messages that
    waited before it listened, and passes the publisher's sequence number to none.
    """
    with subscription.handle:
        while (sample := subscription.handle.take_message(subscription.msg_type, True)) is not None:
            yield sample
