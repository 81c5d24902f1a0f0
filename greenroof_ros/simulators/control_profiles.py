"""How the makes of drives obey their control words: state machines for the simulated drive.

Each is written from the maker's manual, not from the drive file, which has the control words and
conditions that the driver goes by; so the two hold each other to account. What a manual leaves open
is decided against the driver: the stricter reading stands here.
"""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass
from typing import ClassVar

from greenroof_ros.common.errors import ConfigurationError


class Motion(enum.Enum):
    """What the drive does with its motor."""

    FOLLOW = "ramps to its reference"
    HOLD = "keeps its speed"
    RAMP_DOWN = "ramps to rest"
    COAST = "lets it coast"


@dataclass(frozen=True)
class Seen:
    """What a status word tells besides the state machine."""

    moving: bool
    """the motor turns"""
    at_speed: bool
    """at the reference"""
    warning: bool


class ControlProfile(ABC):
    """A state machine.

    Attributes:
        raw: the registers that a client may write, by name; those of the timeout are called
            timeout_time and timeout_action.
        fault: code, or bits, of what has tripped the drive; 0 if nothing has.
        fault_stands: whether its cause does, so that it cannot be reset.
        local: whether somebody has taken the drive over at its panel.
        loss: code, or bits, of the fault after the communication timeout of this interface.
        lost: whether the bus was silent for longer than the drive's timeout.
        runs_locally: whether, left to its own settings, the drive runs.
    """

    EXTRA: ClassVar[Mapping[str, tuple[int, int]]] = {}
    """registers of the drive that no driver needs: address on the wire, value as delivered"""
    DELIVERED: ClassVar[Mapping[str, int]] = {}
    """timeout_time and timeout_action as delivered (raw)"""
    RUNS_AS_DELIVERED: ClassVar[bool] = False
    """whether the drive as delivered runs while no bus controls it"""
    STOPS: ClassVar[int] = 0
    """timeout_action that trips; nothing where there is no choice"""
    LOSS: ClassVar[Mapping[str, int]] = {}
    """code, or bits, of the fault after the communication timeout of each interface"""
    UNGUARDED_S: ClassVar[float] = 0.0
    """after power-up the timeout does not count for so long (s)"""

    def __init__(self, raw: MutableMapping[str, int], interface: str) -> None:
        self.raw = raw
        self.loss = self.LOSS.get(interface, 0)
        self.fault = self.last_fault = 0
        self.fault_stands = False
        self.local = False
        self.lost = self.runs_locally = False
        self.take_over_settings()
        self.power_up()

    @abstractmethod
    def power_up(self) -> None:
        """Begin anew; what is in the registers stays."""

    @abstractmethod
    def control(self, word: int) -> None:
        """Take in a control word."""

    @abstractmethod
    def status(self, seen: Seen) -> int:
        """Return the status word."""

    @property
    @abstractmethod
    def motion(self) -> Motion:
        """What the drive does with its motor."""

    @abstractmethod
    def communication_lost(self) -> None:
        """Do what the drive is set to do after its timeout."""

    def wrote(self, name: str) -> bool:
        """Take in that a register was written; tell whether that starts the timeout anew."""
        if name == "control":
            self.control(self.raw["control"])
        elif name in ("timeout_time", "timeout_action"):
            self.take_over_settings()
        return True

    def read(self) -> bool:
        """Tell whether being read starts the timeout anew."""
        return False

    def standstill(self) -> None:  # noqa: B027 - some wait for nothing
        """Take in that the motor has come to rest; called again and again."""

    def trip(self, fault: int) -> None:
        """Trip, or forget the fault if it is 0."""
        self.fault = fault
        self.last_fault = fault or self.last_fault

    @property
    def fault_register(self) -> int:
        """What the register of faults holds."""
        return self.fault

    @property
    def share(self) -> float | None:
        """A speed that is not the reference's (share of rated); None: it is."""
        return None

    @property
    def guard(self) -> tuple[int, int]:
        """Time and action of the timeout that are in force (raw)."""
        return self._in_force

    def take_over_settings(self) -> None:
        """Let the settings of the timeout be in force."""
        self._in_force = self.raw["timeout_time"], self.raw.get("timeout_action", 0)

    def _reset(self, rising: int, bit: int) -> bool:
        if not rising & bit or not self.fault or self.fault_stands:
            return False
        self.trip(0)
        return True


class _Abb(enum.Enum):
    INHIBITED = "switch-on inhibited"
    NOT_READY = "not ready to switch on"
    READY_ON = "ready to switch on"
    READY_RUN = "ready to operate"
    OPERATION = "operation enabled"
    OFF1 = "OFF1 active"
    OFF2 = "OFF2 active"
    OFF3 = "OFF3 active"


class AbbDrives(ControlProfile):
    """ABB Drives profile: ACS880 firmware manual 3AUA0000085967, embedded fieldbus interface.

    Control Word, Status Word and State transition diagram, pages 617 to 620. After OFF1 the diagram
    asks for rest before the drive can be switched on again.
    """

    # 58.06 Communication control, 58.15 Communication loss mode (2: only CW, Ref1 and Ref2 count)
    EXTRA: ClassVar = {"refresh": (5805, 0), "loss_mode": (5814, 2)}
    # 58.14 No action, 58.16 3.0 s
    DELIVERED: ClassVar = {"timeout_action": 0, "timeout_time": 30}
    STOPS: ClassVar = 1
    LOSS: ClassVar = {"serial": 0x6681}
    UNGUARDED_S: ClassVar = 30.0

    def power_up(self) -> None:
        """Begin in SWITCH-ON INHIBITED; parameters of group 58 are in force as they stand."""
        self._state = _Abb.INHIBITED
        self._word = 0
        self.take_over_settings()

    def read(self) -> bool:
        """Any message counts where 58.15 is 1."""
        return self.raw["loss_mode"] == 1

    def wrote(self, name: str) -> bool:
        """Count control word and reference; with 58.06 = 1 take over what group 58 says."""
        if name == "control":
            self.control(self.raw["control"])
        elif name == "refresh" and self.raw["refresh"] == 1:
            self.take_over_settings()
            self.raw["refresh"] = 0
        return name in ("control", "reference") or self.read()

    def control(self, word: int) -> None:
        """Bits 0 to 2 are OFF1 to OFF3, active low; 3 run; 4 to 6 ramp; 7 reset; 10 remote."""
        if not word & 0x0400 and (word or self.raw["reference"]):
            word = self._word & ~0x0007 | word & 0x0007  # the rest does not get through
        rising = word & ~self._word
        self._word = word
        if self._reset(rising, 0x0080):
            self._state = _Abb.INHIBITED
        elif not self.fault and not self.local:
            self._step(at_rest=False)

    def standstill(self) -> None:
        """OFF1, OFF2 and OFF3 end at rest."""
        if not self.fault and not self.local:
            self._step(at_rest=True)

    def _step(self, *, at_rest: bool) -> None:
        word = self._word
        if not word & 0x0002:
            self._state = _Abb.OFF2
        elif not word & 0x0004 and self._state is not _Abb.OFF2:
            self._state = _Abb.OFF3
        elif not word & 0x0001 and self._state in (_Abb.READY_RUN, _Abb.OPERATION):
            self._state = _Abb.OFF1
        if at_rest and self._state in (_Abb.OFF2, _Abb.OFF3):
            self._state = _Abb.INHIBITED
        if at_rest and self._state is _Abb.OFF1:
            self._state = _Abb.NOT_READY
        if self._state is _Abb.INHIBITED and not word & 0x0001:
            self._state = _Abb.NOT_READY
        if self._state is _Abb.NOT_READY and word & 0x0007 == 0x0006:
            self._state = _Abb.READY_ON
        if self._state is _Abb.READY_ON and word & 0x0007 == 0x0007:
            self._state = _Abb.READY_RUN
        if self._state in (_Abb.READY_RUN, _Abb.OPERATION):
            self._state = _Abb.OPERATION if word & 0x0008 else _Abb.READY_RUN

    @property
    def motion(self) -> Motion:
        """In operation as bits 4 to 6 say, otherwise off."""
        if self.fault:
            return Motion.COAST
        if self.local or self._state in (_Abb.OFF1, _Abb.OFF3):
            return Motion.RAMP_DOWN
        if self._state is not _Abb.OPERATION:
            return Motion.COAST
        if self._word & 0x0050 != 0x0050:
            return Motion.RAMP_DOWN
        return Motion.FOLLOW if self._word & 0x0020 else Motion.HOLD

    def status(self, seen: Seen) -> int:
        """Bits as on page 619; external run enable is wired."""
        state, on = self._state, (_Abb.READY_RUN, _Abb.OPERATION)
        ramps = state in (_Abb.OFF1, _Abb.OFF3) and seen.moving
        return _word({
            0: not self.fault and state in (_Abb.READY_ON, *on),
            1: not self.fault and state in on,
            2: not self.fault and (state is _Abb.OPERATION or ramps),
            3: self.fault, 4: state is not _Abb.OFF2, 5: state is not _Abb.OFF3,
            6: state is _Abb.INHIBITED, 7: seen.warning,
            8: seen.at_speed and state is _Abb.OPERATION, 9: not self.local, 12: True,
        })

    def communication_lost(self) -> None:
        """58.14: 1 and 4 trip; the rest is a warning at most, and the motor runs on."""
        if self.guard[1] in (1, 4):
            self.trip(self.loss)


class FcProfile(ControlProfile):
    """FC profile of Danfoss: VLT AQUA Drive FC 202, design guide, "Danfoss FC Control Profile"."""

    # 8-04 Off, 8-03 60 s
    DELIVERED: ClassVar = {"timeout_action": 0, "timeout_time": 600}
    STOPS: ClassVar = 5
    LOSS: ClassVar = {"serial": 1 << 4}

    def power_up(self) -> None:
        """Begin at rest, without a valid control word."""
        self._word = 0

    def wrote(self, name: str) -> bool:
        """Only a control word with bit 10, "data valid", is one."""
        if name == "control" and not self.raw["control"] & 0x0400:
            return False
        super().wrote(name)
        return name == "control"

    def control(self, word: int) -> None:
        """Bit 2 brake, 3 coast, 4 quick stop and 5 hold are active low; 6 starts; 7 resets."""
        rising = word & ~self._word
        self._word = word
        self._reset(rising, 0x0080)

    @property
    def motion(self) -> Motion:
        """Coasting goes before braking, and that before the ramp."""
        word = self._word
        if self.fault:
            return Motion.RAMP_DOWN if self.fault == self.loss else Motion.COAST
        if not word & 0x0008:
            return Motion.COAST
        stopped = self.lost and self.guard[1] == 2
        if self.local or stopped or word & 0x0014 != 0x0014:
            return Motion.RAMP_DOWN
        if not word & 0x0020 or (self.lost and self.guard[1] == 1):
            return Motion.HOLD
        return Motion.FOLLOW if word & 0x0040 else Motion.RAMP_DOWN

    def status(self, seen: Seen) -> int:
        """Bits as in the table "Definition of the status bits"."""
        starts = self.motion in (Motion.FOLLOW, Motion.HOLD)
        return _word({
            0: True, 1: not self.fault, 2: self._word & 0x0008, 3: self.fault, 7: seen.warning,
            8: seen.at_speed, 9: not self.local, 10: True, 11: starts or seen.moving,
        })

    def communication_lost(self) -> None:
        """8-04: 5 stops and trips, 2 stops until there is a valid word, 1 freezes the output."""
        if self.guard[1] == 5:
            self.trip(self.loss)


class CimProfile(ControlProfile):
    """Modbus for Grundfos pumps (CIM 200, CIM 500): functional profile, sections 9.4 and 9.5.

    While the bus has not taken over, or has lost control, the pump does what it is set to locally:
    as set up for this project it stops, as delivered it runs.
    """

    DELIVERED: ClassVar = {"timeout_time": 0}
    RUNS_AS_DELIVERED: ClassVar = True
    _POWER_UP_MODE = 4  # constant pressure
    _CONSTANT_FREQUENCY = 1
    _OTHER_MODE = 0.6  # a speed that no set-point asked for (share of rated)

    def power_up(self) -> None:
        """Begin in local control."""
        self._word = 0
        self.raw["control_mode"] = self._POWER_UP_MODE

    def read(self) -> bool:
        """Any message counts."""
        return True

    def control(self, word: int) -> None:
        """Bit 0 asks for the bus, 1 on, 2 resets an alarm."""
        rising = word & ~self._word
        self._word = word
        self._reset(rising, 0x0004)

    @property
    def _remote(self) -> bool:
        return bool(self._word & 0x0001) and not self.local

    @property
    def _on(self) -> bool:
        return bool(self._word & 0x0002) if self._remote else self.runs_locally

    @property
    def motion(self) -> Motion:
        """On or off."""
        if self.fault:
            return Motion.COAST
        return Motion.FOLLOW if self._on else Motion.RAMP_DOWN

    @property
    def share(self) -> float | None:
        """The set-point is a speed in one control mode alone."""
        follows = (
            self._remote and self.raw["control_mode"] == self._CONSTANT_FREQUENCY
            and self.raw.get("operation_mode", 0) == 0
        )
        return None if follows else self._OTHER_MODE

    def status(self, seen: Seen) -> int:
        """Bits as in section 9.5."""
        return _word({
            6: seen.moving, 8: self._remote, 9: self._on, 10: self.fault, 12: self.local,
        })

    def communication_lost(self) -> None:
        """The pump goes back to local control; there is no alarm."""
        self._word = 0


class _Cia(enum.Enum):
    DISABLED = 0x0040
    READY = 0x0021
    SWITCHED_ON = 0x0023
    ENABLED = 0x0027
    QUICK_STOP = 0x0007
    REACTION = 0x000F
    FAULT = 0x0008


class Cia402(ControlProfile):
    """CiA 402 as Schneider Electric's Altivar has it: BBV51701, state chart, pages 9 to 13.

    The values of the states are the bits 0 to 3, 5 and 6 of ETA. LFT is the last error; a reset
    leaves it as it is.
    """

    # SLL and ETHL freewheel stop, TTO and TTOB 10.0 s
    DELIVERED: ClassVar = {"timeout_action": 1, "timeout_time": 100}
    STOPS: ClassVar = 1
    LOSS: ClassVar = {"serial": 5, "tcp": 150}

    def power_up(self) -> None:
        """Begin in 'switch on disabled'."""
        self._state = _Cia.DISABLED
        self._word = 0

    def read(self) -> bool:
        """Any message counts."""
        return True

    @property
    def fault_register(self) -> int:
        """The last error, reset or not."""
        return self.last_fault

    def control(self, word: int) -> None:
        """Bits 0 switch on, 1 voltage, 2 no quick stop, 3 enable, 7 reset, 8 halt."""
        rising = word & ~self._word
        self._word = word
        if self.fault:
            if self._reset(rising, 0x0080):
                self._state = _Cia.DISABLED
            return
        if self.local:
            return
        state = self._state
        if not word & 0x0002:
            state = _Cia.DISABLED  # disable voltage
        elif not word & 0x0004:
            if state is _Cia.ENABLED:
                state = _Cia.QUICK_STOP
            elif state is not _Cia.QUICK_STOP:
                state = _Cia.DISABLED
        elif state is _Cia.DISABLED:
            state = _Cia.READY if word & 0x0007 == 0x0006 else state  # shutdown
        elif state is not _Cia.QUICK_STOP:
            state = {
                0x0006: _Cia.READY, 0x000E: _Cia.READY, 0x0007: _Cia.SWITCHED_ON,
                # from 'ready', enable operation switches on first
                0x000F: _Cia.SWITCHED_ON if state is _Cia.READY else _Cia.ENABLED,
            }[word & 0x000F]
        self._state = state

    def standstill(self) -> None:
        """A quick stop and the reaction to a fault end at rest."""
        if self._state is _Cia.QUICK_STOP:
            self._state = _Cia.DISABLED
        if self._state is _Cia.REACTION:
            self._state = _Cia.FAULT

    def trip(self, fault: int) -> None:
        """Trip: with freewheel stop there is nothing to wait for."""
        super().trip(fault)
        if fault:
            ramps = fault == self.loss and self.guard[1] in (6, 7)
            self._state = _Cia.REACTION if ramps else _Cia.FAULT
        elif self._state in (_Cia.REACTION, _Cia.FAULT):
            self._state = _Cia.DISABLED

    @property
    def motion(self) -> Motion:
        """Enabled follows the reference; 'switched on' from there is a stop on the ramp."""
        if self._state is _Cia.ENABLED and not self.local:
            if self.lost and self.guard[1] == 2:
                return Motion.RAMP_DOWN
            return Motion.RAMP_DOWN if self._word & 0x0100 else Motion.FOLLOW
        if self._state in (_Cia.SWITCHED_ON, _Cia.QUICK_STOP, _Cia.REACTION) or (
            self.local and not self.fault
        ):
            return Motion.RAMP_DOWN
        return Motion.COAST

    def status(self, seen: Seen) -> int:
        """ETA: the state, voltage, remote, reference reached."""
        return self._state.value | _word({
            4: True, 7: seen.warning, 9: not self.local, 10: seen.at_speed,
        })

    def communication_lost(self) -> None:
        """SLL, ETHL: 1 freewheel, 6 ramp, 7 fast, 8 DC injection trip; 2 stops without error."""
        if self.guard[1] in (1, 6, 7, 8):
            self.trip(self.loss)


_PROFILES = {
    "ABB": AbbDrives, "Danfoss": FcProfile, "Grundfos": CimProfile, "Schneider Electric": Cia402,
}


def profile_of(make: str) -> type[ControlProfile]:
    """Return the state machine of a make.

    Raises:
        ConfigurationError: none is known.
    """
    if make not in _PROFILES:
        raise ConfigurationError(
            f"cannot be simulated; these can: {', '.join(_PROFILES)}", key="make", value=make
        )
    return _PROFILES[make]


def _word(bits: Mapping[int, object]) -> int:
    return sum(1 << bit for bit, on in bits.items() if on)
