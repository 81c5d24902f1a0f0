"""Description of a make of MQTT relay: a file in ``config/drives/``, as frozen dataclasses.

Topics and payloads may contain the following placeholders: ``$device``, the relay's own topic,
taken from its address; ``$me``, the name of the requesting client; ``$id``, the number of the
message; and ``$seconds``, the relay's timer in seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from string import Template

from greenroof_ros.base.files import YamlMapping
from greenroof_ros.base.parameter import entry, find, read_record
from greenroof_ros.live.devices.drive_file import Source

MQTT = "mqtt"
# A timer shorter than this many rounds of questions cannot be renewed within a third of its time.
_ROUNDS = 6


@dataclass(frozen=True)
class RelayMessage:
    """A message to the relay."""

    topic: str = entry("topic on which the message is published")
    payload: str = entry("payload of the message")


@dataclass(frozen=True)
class Question:
    """A request to the relay, and the features by which its reply is recognized."""

    topic: str = entry("topic on which the request is published")
    answer: str = entry("topic of the reply, which is a JSON object")
    known_by: str = entry("path whose presence identifies the reply, such as result.output")
    payload: str = entry("payload of the request", default="")


@dataclass(frozen=True)
class Value:
    """A value in the reply to a request."""

    question: str = entry("name of the request (a key of `questions`)")
    path: str = entry("path of the value in the reply, such as result.output")


@dataclass(frozen=True)
class RelayState(Value):
    """The state of the relay, on or off."""

    is_on: str = entry("value that means on, in JSON notation", default="true")
    is_off: str = entry("value that means off, in JSON notation", default="false")


@dataclass(frozen=True)
class Setting(Value):
    """A setting with a required value, without which the relay could be on unintentionally."""

    value: str = entry("required value, in JSON notation")
    meaning: str = entry("description of the setting, for messages")


@dataclass(frozen=True)
class Scale:
    """The conversion of a range of raw values to seconds."""

    low: float = entry("minimum raw value of the range", 0)
    high: float = entry("maximum raw value of the range", 0)
    scale: float = entry("factor: seconds = scale x raw + offset", 1e-6, 1e6, default=1.0)
    offset: float = entry("offset of the conversion (s)", -1e6, 1e6, default=0.0)


@dataclass(frozen=True)
class Timer(Value):
    """The relay's own timer, which switches the relay off: its communication timeout."""

    scales: tuple[Scale, ...] = entry(
        "conversions to seconds, one for each range of raw values; a value outside all ranges "
        "means off"
    )
    how_to_set: str = entry(
        "instructions for setting the timer manually: location of the setting, and value")
    traps: str = entry("cases in which the timer is not effective", default="")

    # Drives on Modbus may have these, but no relay does.
    unguarded_after_power_up_s = 0.0
    local_settings_decide = False

    def seconds(self, raw: float) -> float | None:
        """Return the time for a raw value (s); None if the timer is off."""
        return next((
            scale.scale * raw + scale.offset for scale in self.scales
            if scale.low <= raw <= scale.high
        ), None)


@dataclass(frozen=True)
class RelayFile:
    """The description of a make of relay."""

    protocol: str = entry(
        "protocol of the relay, always mqtt; only relay files have this key", choices=(MQTT,)
    )
    make: str = entry("name of the manufacturer")
    model: str = entry("model of the relay, and its firmware")
    sources: tuple[Source, ...] = entry("documents on which the file is based")
    unverified: tuple[str, ...] = entry(
        "keys of this file (such as timer) that could not be verified against the manufacturer's "
        "documents"
    )
    questions: dict[str, Question] = entry("requests to the relay, by name")
    state: RelayState = entry("value in a reply that shows whether the relay is on")
    timer: Timer = entry(
        "value in a reply that gives the time after which the relay switches itself off"
    )
    must: tuple[Setting, ...] = entry(
        "settings that must have certain values; they are read together with the timer"
    )
    name: Value = entry("value in a reply that identifies the relay, for messages")
    switch_on: RelayMessage = entry(
        "message that switches the relay on; it is repeated to keep the relay on"
    )
    switch_off: RelayMessage = entry(
        "message that switches the relay off; it is repeated for as long as the relay must be off"
    )
    set_up: tuple[str, ...] = entry("other settings that must be made manually on the relay")
    number: str = entry(
        "path of the request's $id in every reply; empty if the replies have no id but arrive in "
        "the order of the requests",
        default="",
    )
    period: float = entry("minimum polling interval (s)", 0.05, 5, default=0.5)
    answer_within: float = entry("maximum time to wait for a reply (s)", 0.1, 10, default=1.0)
    path: Path = Path()

    # A relay is on or off, with no speed in between.
    min_speed = 1.0

    @property
    def min_timer(self) -> float:
        """The shortest timer that can be renewed in time (s)."""
        return _ROUNDS * self.period

    @property
    def unverified_and_vital(self) -> tuple[str, ...]:
        """All unverified keys, since each could let a pump run when it must be off."""
        return self.unverified


def read_relay_file(path: Path) -> RelayFile:
    """Read and check a relay file.

    Raises:
        ConfigurationError: if a key or value is missing, unknown, impossible or contradictory.
    """
    return replace(read_record(RelayFile, path, _mistakes), path=path)


def _mistakes(relay: RelayFile, content: YamlMapping) -> Iterator[tuple[str, str]]:
    values = {
        "state": relay.state, "timer": relay.timer, "name": relay.name,
        **{f"must.{number}": setting for number, setting in enumerate(relay.must, start=1)},
    }
    for key, value in values.items():
        if value.question not in relay.questions:
            yield f"{key}.question", (
                "must be the name of a request under questions in this file: "
                f"{', '.join(relay.questions)}"
            )
    texts = {
        f"{key}.{name}": text
        for key, part in {
            "switch_on": relay.switch_on, "switch_off": relay.switch_off,
            **{f"questions.{name}": question for name, question in relay.questions.items()},
        }.items() for name, text in vars(part).items()
    }
    for key, text in texts.items():
        names = ["device", "me"]
        if key.endswith(".payload"):
            names += ["id", "seconds"] if key == "switch_on.payload" else ["id"]
        elif set(text) & set("#+"):
            yield key, "must be a single topic, without the wildcards # and +"
        try:
            Template(text).substitute(dict.fromkeys(names, ""))
        except (KeyError, ValueError):
            allowed = ", ".join(f"${name}" for name in names)
            yield key, f"may contain only these placeholders: {allowed}"
    if relay.number and any("$id" not in question.payload for question in relay.questions.values()):
        yield "number", "requires $id in the payload of every request"
    if relay.state.is_on == relay.state.is_off:
        yield "state.is_off", "must differ from is_on"
    for number, scale in enumerate(relay.timer.scales, start=1):
        if scale.low > scale.high:
            yield f"timer.scales.{number}.low", f"must be at most high, which is {scale.high:g}"
    for number, key in enumerate(relay.unverified, start=1):
        if find(content, key)[1] is None:
            yield f"unverified.{number}", "is not a key of this file"
