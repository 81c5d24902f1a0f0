"""The topics of a live graph."""

from __future__ import annotations

from dataclasses import replace

from greenroof_ros.interface.states import PLANT
from greenroof_ros.interface.topics import Topic, read_topics


def read_live_topics() -> dict[str, Topic]:
    """Return the topics of a live graph, which has no plant."""
    return {
        name: replace(
            topic,
            publishers=topic.live_publishers or tuple(
                role for role in topic.publishers if role != PLANT
            ),
            subscribers=topic.subscribers + topic.live_subscribers,
        )
        for name, topic in read_topics().items()
        if topic.live
    }
