"""The faults of the simulators, and the workbench registers that request them.

A workbench is a Modbus device, number 247, on a TCP port of its own. So it can be reached while the
drive refuses its clients, has no power or is on a serial line, and its requests are no traffic for
the drive. All its registers are holding registers.
"""

from __future__ import annotations

import argparse
import functools
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass

from greenroof_ros.common.errors import ConfigurationError, must_be_one_of
from greenroof_ros.common.ranges import Range

DEVICE_ID = 247
SPEED, FAULT, PARAMETER, POWER_CYCLE, LOCAL, CISTERN_LEVEL = range(6)
SPEED_UNIT = 1e-4
LEVEL_UNIT = 1e-4
DEFAULT = 0xFFFF
"""as a parameter: use the fault's default"""


@dataclass(frozen=True)
class Fault:
    """A fault that can be requested.

    Attributes:
        number: the value of workbench register 1 that requests it.
        meaning: what then happens.
        parameter: the meaning of its parameter, register 2; empty if it has none.
        default: of the parameter.
    """

    number: int
    meaning: str
    parameter: str = ""
    default: int = 0


NONE = "none"
DRIVE_FAULTS: Mapping[str, Fault] = {
    NONE: Fault(0, "no fault"),
    "refused": Fault(1, "connections are refused, and existing ones are closed"),
    "dropped": Fault(2, "every request closes its connection"),
    "half_open": Fault(3, "connections are accepted, but no request gets through"),
    "silence": Fault(4, "requests are obeyed, but never answered"),
    "slow": Fault(5, "answers come late, but in time", "ms", 200),
    "late": Fault(6, "answers come after the client has given up", "ms", 1500),
    "split": Fault(7, "answers come byte by byte", "ms between two bytes", 5),
    "garbage": Fault(8, "random bytes come instead of answers", "how many", 16),
    "wrong_unit": Fault(9, "answers come from the next device id"),
    "wrong_function": Fault(10, "answers are to the next function code"),
    "wrong_length": Fault(11, "answers lack their last byte"),
    "absurd_value": Fault(12, "the speed register reads nonsense", "the raw value", 0x7FFF),
    "exception": Fault(13, "every request is refused", "exception code", 4),
    "drive_fault": Fault(
        14, "the drive trips and cannot be reset while this is active",
        "code, or bits, in its register of faults; 0: the first of the drive file", 0,
    ),
    "speed_stays": Fault(15, "the speed stays as it is"),
    "stuck_running": Fault(
        16, "the motor runs on, regardless of what the drive is ordered to do",
        "speed in 0.01 %; 0: the present one", 0,
    ),
    "power_cycle": Fault(17, "the drive loses power for a moment, once"),
    "timeout_off": Fault(18, "the drive's communication timeout is turned off, for good"),
    "refused_writes": Fault(19, "every write is refused", "exception code", 6),
    "runs_on": Fault(
        20, "ordered to stop, the drive reports off, but the motor runs on until the drive's "
        "communication timeout expires",
        "how long each connection lasts, s; 0: forever", 0,
    ),
    "echo": Fault(26, "no request gets through, and the line returns what is sent"),
}
RELAY_FAULTS: Mapping[str, Fault] = {
    **{name: DRIVE_FAULTS[name] for name in (NONE, "silence", "late", "garbage", "power_cycle")},
    "timer_off": Fault(18, "the relay's timer is turned off, for good"),
    "timer_long": Fault(21, "the relay's timer is set, for good", "s", 120),
    "power_up_on": Fault(22, "the relay is set to be on after power-up, for good"),
    "deaf": Fault(23, "the relay answers, but only its timer switches it"),
    "auto_on": Fault(25, "a Shelly is set to switch itself on again after off, for good"),
    "welded": Fault(24, "the contact no longer opens; the relay reports what was ordered"),
}
SITE_FAULTS: Mapping[str, Fault] = {
    NONE: Fault(0, "no fault"),
    "cistern_frozen": Fault(1, "the cistern's sensor repeats its last reading"),
    "cistern_silent": Fault(2, "the cistern's sensor does not answer"),
    "cistern_absurd": Fault(3, "the cistern's sensor reads nonsense", "the raw value", 0xFFFE),
    "cistern_noisy": Fault(
        4, "the cistern's sensor is noisy", "standard deviation in 0.1 mm", 500
    ),
    "cistern_drifting": Fault(5, "the cistern's sensor drifts upwards", "0.1 mm per minute", 100),
    "roof_frozen": Fault(6, "the roof's sensor repeats its last reading"),
    "roof_silent": Fault(7, "the roof's sensor does not answer"),
    "roof_absurd": Fault(8, "the roof's sensor reads nonsense", "the raw value", 0xFFFE),
    "roof_noisy": Fault(9, "the roof's sensor is noisy", "standard deviation in 0.1 mm", 100),
    "roof_drifting": Fault(10, "the roof's sensor drifts upwards", "0.1 mm per minute", 50),
    "burst_pipe": Fault(11, "pumped water does not arrive on the roof"),
    "leak": Fault(12, "the cistern loses water", "ml per second", 500),
    "closed_valve": Fault(13, "the pump moves no water, however it runs"),
}


def add_option(parser: argparse.ArgumentParser, known: Mapping[str, Fault]) -> None:
    """Add the option ``--fault`` to a command."""
    parser.add_argument(
        "--fault", type=functools.partial(_read_fault, known=known), default=NONE,
        metavar="KIND[=PARAMETER]",
        help="fault that is active from the start; see the list of faults",
    )


def _read_fault(text: str, known: Mapping[str, Fault]) -> tuple[str, int]:
    """Return name and parameter of a fault from an option such as ``--fault slow=300``.

    Raises:
        ConfigurationError: there is no such fault, or it cannot have that parameter.
    """
    name, equals, parameter = text.partition("=")
    if name not in known:
        raise ConfigurationError(must_be_one_of(known, name), key="--fault", value=text)
    if not equals:
        return name, DEFAULT
    if not known[name].parameter:
        raise ConfigurationError(f"{name} has no parameter", key="--fault", value=text)
    if not parameter.isdecimal() or int(parameter) >= DEFAULT:
        raise ConfigurationError(
            f"its parameter ({known[name].parameter}) "
            + Range(0, DEFAULT - 1, whole=True).expected(), key="--fault", value=text,
        )
    return name, int(parameter)


def list_faults(known: Mapping[str, Fault]) -> str:
    """Return the help text that describes each fault."""
    lines = []
    for name, fault in known.items():
        shown = f" ({fault.parameter}; default {fault.default})" if fault.parameter else ""
        lines += textwrap.wrap(
            f"{fault.number:2d} {name:17s} {fault.meaning}{shown}", 78, initial_indent="  ",
            subsequent_indent=" " * 23,
        )
    return "\n".join(lines)
