"""The topics of a live graph."""

from __future__ import annotations

from dataclasses import replace

from greenroof_ros.interface.topics import Topic, read_topics


def read_live_topics() -> dict[str, Topic]:
    """Return the topics of a live graph, with the roles that replace the plant."""
    return {
        name: replace(
            topic,
            publishers=topic.live_publishers or topic.publishers,
            subscribers=topic.subscribers + topic.live_subscribers,
        )
        for name, topic in read_topics().items()
        if topic.live
    }
