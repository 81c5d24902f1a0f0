"""Messages at the moment in which an executor begins to listen: ``python test/swaps.py``.

Another process is asked for five messages, and within about a millisecond, in which they come, a
node is given to rclpy's fast executor. It counts the rounds in which the executor did not hand on
all of them within half a second; with ``--plain`` the node is merely added to it.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

_TOPICS = [f"message_{number}" for number in range(5)]
_ASKING = "ask"
# So long after the question the executor begins to listen at most, and so long after it a message
# is lost (s).
_LATEST_S, _LOST_S = 1.2e-3, 0.5


def _answer() -> None:
    """Publish a message on each topic whenever one is asked for."""
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from std_msgs.msg import Float64

    from greenroof_ros.graph.domain import make_executor

    rclpy.init()
    node = rclpy.create_node("answering")
    publishers = [node.create_publisher(Float64, topic, _qos()) for topic in _TOPICS]

    def on_question(question: Any) -> None:
        for publisher in publishers:
            publisher.publish(question)

    node.create_subscription(Float64, _ASKING, on_question, _qos())
    executor = make_executor()
    executor.add_node(node)
    try:
        while True:
            executor.spin_once(timeout_sec=1.0)
    except (ExternalShutdownException, KeyboardInterrupt):
        pass


def _qos() -> Any:
    from greenroof_ros.common.interface import read_topics
    from greenroof_ros.graph.messages import qos_profile

    return qos_profile(read_topics()["/roof/level"].qos)


def swap(rounds: int, *, plain: bool) -> int:
    """Have another executor begin to listen, again and again, while messages come.

    Args:
        rounds: how often.
        plain: without what :func:`greenroof_ros.graph.domain.begin_to_listen` adds.

    Returns:
        In how many rounds a message was not handed on.
    """
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.serialization import deserialize_message
    from std_msgs.msg import Float64

    from greenroof_ros.graph.domain import begin_to_listen, make_executor
    from greenroof_ros.graph.rclpy_internals import waiting_in

    rclpy.init()
    node = rclpy.create_node("swapping")
    newest = [0.0] * len(_TOPICS)

    def on_message(index: int, message: bytes) -> None:
        newest[index] = deserialize_message(message, Float64).data

    subscriptions = [
        node.create_subscription(Float64, topic, partial(on_message, index), _qos(), raw=True)
        for index, topic in enumerate(_TOPICS)
    ]
    ask = node.create_publisher(Float64, _ASKING, _qos())
    drawn = random.Random(0)
    lost = 0
    first = SingleThreadedExecutor()
    first.add_node(node)
    while not (ask.get_subscription_count() and all(node.count_publishers(one) for one in _TOPICS)):
        first.spin_once(timeout_sec=0.1)
    first.remove_node(node)
    for number in range(1, rounds + 1):
        ask.publish(Float64(data=float(number)))
        at = time.perf_counter() + drawn.uniform(0, _LATEST_S)
        while time.perf_counter() < at:
            pass
        fast = make_executor()
        if plain:
            fast.add_node(node)
        else:
            begin_to_listen(fast, node)
        until = time.monotonic() + _LOST_S
        while min(newest) < number and time.monotonic() < until:
            fast.spin_once(timeout_sec=0.05)
        if min(newest) < number:
            lost += 1
            for subscription in subscriptions:
                for message, _ in waiting_in(subscription):
                    subscription.callback(message)
            if min(newest) < number:
                raise RuntimeError(f"round {number}: a message did not come at all: {newest}")
        fast.remove_node(node)
        del fast  # its end would take the node from the next one
    node.destroy_node()
    rclpy.shutdown()
    return lost


def main() -> int:
    """Count, and print the count; exit code 1 where a message was left behind."""
    parser = argparse.ArgumentParser(
        prog="python test/swaps.py", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--rounds", type=int, default=100_000, help="default: %(default)s")
    parser.add_argument("--plain", action="store_true", help="what happens without the repair")
    parser.add_argument("--answer", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    from graphs import own_domain

    from greenroof_ros.graph.domain import choose_transport

    if arguments.answer:
        choose_transport()
        _answer()
        return 0
    with own_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        with subprocess.Popen(
            [sys.executable, str(Path(__file__).resolve()), "--answer"],
            env={**os.environ, "PYTHONPATH": str(HERE.parent)},
        ) as answering:
            choose_transport()
            try:
                lost = swap(arguments.rounds, plain=arguments.plain)
            finally:
                answering.terminate()
        print(f"{lost} of {arguments.rounds} times a message was left behind")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
