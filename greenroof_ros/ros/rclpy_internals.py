"""All private parts of rclpy that this package uses, with the reasons for using them.

A new version of rclpy can remove any of these parts without notice.
``test/ros/test_messages.py`` uses all of them, and fails if one is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any


def raw_publish(publisher: Any) -> Callable[[bytes], None]:
    """Return a function that publishes serialised messages on a publisher.

    For every message, rclpy's own ``publish`` compares types and locks the publisher against
    destruction by another thread; these steps take a quarter of the time of ``publish``.
    """
    publish: Callable[[bytes], None] = publisher.handle.publish_raw
    return publish


def take_messages(subscription: Any) -> Iterator[tuple[bytes, Any]]:
    """Yield the waiting messages, each as serialised bytes with rclpy's metadata.

    rclpy passes messages only to callbacks. The fast executor of rclpy calls no callback for
    messages that arrived before the executor began to listen, and does not pass the publisher's
    sequence number to callbacks.
    """
    with subscription.handle:
        while (sample := subscription.handle.take_message(subscription.msg_type, True)) is not None:
            yield sample
