"""Controller, sensors and weather played by the campaign, with or without the faults of a case."""

from __future__ import annotations

import math
import random
import threading
import time
from collections.abc import Callable, Sequence

from faults.truth import Truth
from faults.watcher import Watcher

from greenroof_ros.physics.pump import flow_at
from greenroof_ros.site.site import Site

Value = float | Sequence[float]
PERIOD_S = 1.0
# The fault *intermittent* of PX4: on for 2 s, off for 7 s.
ON_S, OFF_S = 2.0, 7.0
HOSTILE = (math.nan, math.inf, -math.inf, -1.0, -1e-9, -1e300)
# Values too large for other topics; as a command they are treated as 1.
HUGE = (101.0, 1e9, 1.7976931348623157e308)
# Wrong values that look right, by topic: an offset, or a value of its own.
_WRONG: dict[str, Callable[[float], float]] = {
    "/cistern/level": lambda level: level + 0.3,
    "/roof/level": lambda level: level + 0.1,
    "/weather/frost": lambda frost: 1.0,
    "/pump/command": lambda command: -0.5,
    "/forecast/precipitation": lambda rain: 1e-4,
    "/forecast/evapotranspiration": lambda loss: 1e-3,
    "/pump/flow": lambda flow: 0.5 * flow,
    "/pump/meter": lambda flow: 0.0,
    "/gauge/precipitation": lambda rain: 5e-5,
    "/gauge/temperature": lambda degrees: -5.0,
}
# Delay of a delayed topic (s), and factor of the period of a slow one.
_DELAY_S, _SLOW = 2.0, 4.0
# Resolution of a coarse sensor (m), below level_tolerance and frozen_movement.
_COARSE_M = 0.005


class Players:
    """Publishes each topic once a second, with one of the faults of PX4's list.

    Levels follow from the drive's true speed.

    Attributes:
        topics: the published topics.
    """

    def __init__(
        self, watcher: Watcher, truth: Truth, site: Site, topics: Sequence[str]
    ) -> None:
        self.topics = set(topics)
        self._watcher = watcher
        self._mode = dict.fromkeys(topics, "ok")
        self._began = time.monotonic()
        self._last: dict[str, Value] = {}
        self._random = random.Random(0)
        self.cistern, self.roof = 2.9, 0.01
        self._truth, self._site = truth, site
        good: dict[str, Callable[[], Value]] = {
            "/cistern/level": lambda: self.cistern,
            "/roof/level": lambda: self.roof,
            "/weather/frost": lambda: 0.0,
            "/pump/command": lambda: 1.0,
            "/pump/flow": self._flow,
            "/pump/meter": self._flow,
            "/forecast/precipitation": lambda: [0.0] * site.M,
            "/forecast/evapotranspiration": lambda: [1e-7] * site.M,
            "/gauge/precipitation": lambda: 0.0,
            "/gauge/temperature": lambda: 15.0,
        }
        self._values = {topic: good[topic] for topic in topics}
        self._next: dict[str, float] = dict.fromkeys(self._values, 0.0)
        self._ended = False
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ended = True
        self._thread.join(3)

    def _flow(self) -> float:
        return flow_at(self._site, self._truth.speed, self.cistern)

    def _play(self) -> None:
        at = time.monotonic()
        while not self._ended:
            time.sleep(0.02)
            before, at = at, time.monotonic()
            pumped = self._flow() * (at - before)
            self.cistern -= pumped / self._site.a1
            self.roof += pumped / self._site.a2
            for topic, value in self._values.items():
                if at >= self._next[topic]:
                    slow = _SLOW if self._mode[topic] == "slow" else 1.0
                    self._next[topic] = max(at, self._next[topic] + slow * PERIOD_S)
                    changed_value = self._changed(topic, value())
                    if changed_value is not None:
                        self._watcher.publish(topic, changed_value)

    def set(self, topic: str, mode: str, rng: random.Random) -> None:
        """Publish a topic with this fault from now on."""
        self._random = random.Random(rng.random())
        self._began = time.monotonic()
        self._mode[topic] = mode

    def _changed(self, topic: str, value: Value) -> Value | None:
        """Return the value to publish; None if nothing is published now."""
        mode, since = self._mode[topic], time.monotonic() - self._began
        match mode:
            case "off":
                return None
            case "intermittent" if since % (ON_S + OFF_S) > ON_S:
                return None
            case "delayed":
                threading.Timer(_DELAY_S, self._watcher.publish, (topic, value)).start()
                return None
            case "garbage":
                return _garbage(topic, value, self._random)
            case "wrong":
                return _wrong(topic, value)
            case "coarse" if isinstance(value, float):
                return round(value / _COARSE_M) * _COARSE_M
        if mode != "stuck":
            self._last[topic] = value
        return self._last[topic]

    def burst(self, topic: str, count: int, rng: random.Random) -> None:
        """Publish this many hostile values as fast as possible, with random pauses."""
        sample = self._values[topic]()
        self._random = random.Random(rng.random())
        for number in range(count):
            self._watcher.publish(topic, _garbage(topic, sample, self._random))
            if number % 500 == 499:
                time.sleep(rng.uniform(0.0, 0.05))


def _wrong(topic: str, value: Value) -> Value:
    change = _WRONG[topic]
    return change(value) if isinstance(value, float) else [change(number) for number in value]


def _garbage(topic: str, value: Value, rng: random.Random) -> Value:
    hostile = HOSTILE if topic == "/pump/command" else HOSTILE + HUGE
    if topic == "/gauge/temperature":
        hostile = tuple(degrees for degrees in hostile if not -90 <= degrees <= 60)
    if isinstance(value, float):
        return rng.choice(hostile)
    # A controller that needs no forecast accepts one of another length, but not invalid values.
    count = rng.choice((len(value), len(value) - 3, 1))
    return [rng.choice(hostile) for _ in range(count)]
