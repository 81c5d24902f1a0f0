"""State machines of the simulated drives, by make, which interpret the control word.

Each state machine is based on the manufacturer's manual. The driver, in contrast, uses the control
words and conditions of the drive file, so the simulator and the driver verify each other. Where a
manual is ambiguous, the interpretation that is stricter for the driver is implemented.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import ClassVar

from greenroof_ros.live.simulators.simulated_drive import Motion, SimulatedDrive


class _Abb(enum.Enum):
    INHIBITED = "switch-on inhibited"
    NOT_READY = "not ready to switch on"
    READY_ON = "ready to switch on"
    READY_RUN = "ready to operate"
    OPERATION = "operation enabled"
    OFF1 = "OFF1 active"
    OFF2 = "OFF2 active"
    OFF3 = "OFF3 active"


class AbbDrives(SimulatedDrive):
    """ABB Drives profile on the embedded fieldbus interface of the ACS880.

    The source is the firmware manual 3AUA0000085967, "Control Word", "Status Word" and "State
    transition diagram", pages 617 to 620. After OFF1, the drive must come to a standstill before it
    can be switched on again. In the control word, bits 0 to 2 are OFF1 to OFF3 (active low), bit 3
    is run, bits 4 to 6 control the ramp, bit 7 is reset and bit 10 is remote.
    """

    DELIVERED = (30, 0)  # 58.16 3.0 s, 58.14 No action
    TRIPS = (1, 4)  # with other actions it warns at most, and the motor runs on
    LOSS: ClassVar = {"serial": 0x6681}
    RESET = 0x0080
    INITIAL = _Abb.INHIBITED
    EXTRA: ClassVar = {"refresh": 5805}  # 58.06 Communication control

    def restarts_timeout(self, name: str) -> bool:
        """Return True for any message if 58.15 is 1, else only for control word and reference."""
        mode = self.timeout.mode
        only = mode is None or self.read_raw(mode.register) != 1
        return not only or name in ("control", "reference")

    def on_write(self, name: str) -> None:
        """Obey a control word; apply the settings of group 58 only when 58.06 is set to 1."""
        if name == "control":
            self.control(self.read_raw(name))
        elif name == "refresh" and self.read_raw(name) == 1:
            self.apply_settings()
            self.write_raw(name, 0)

    def control(self, word: int) -> None:
        """Obey a control word; without bit 10, obey only bits 0 to 2.

        A control word of 0 is obeyed in full if the reference is also 0.
        """
        if not word & 0x0400 and (word or self.read_raw("reference")):
            word = self.word & ~0x0007 | word & 0x0007
        super().control(word)

    def standstill(self) -> None:
        """Leave OFF1, OFF2 or OFF3 now that the motor is at standstill."""
        if not self.fault and not self.local:
            after = {
                _Abb.OFF1: _Abb.NOT_READY, _Abb.OFF2: _Abb.INHIBITED, _Abb.OFF3: _Abb.INHIBITED,
            }
            off = self._off()
            self.state = self._switched_on(after.get(off, off))

    def next_state(self) -> _Abb:
        """Return the state of the diagram to which the control word leads."""
        return self._switched_on(self._off())

    def _off(self) -> _Abb:
        """Return the state to which OFF1 to OFF3 lead; OFF2 takes precedence, then OFF3."""
        word, state = self.word, _Abb(self.state)
        if not word & 0x0002:
            return _Abb.OFF2
        if not word & 0x0004 and state is not _Abb.OFF2:
            return _Abb.OFF3
        if not word & 0x0001 and state in (_Abb.READY_RUN, _Abb.OPERATION):
            return _Abb.OFF1
        return state

    def _switched_on(self, state: _Abb) -> _Abb:
        """Return the state to which a state leads with the switch-on bits of the control word."""
        word = self.word
        if state is _Abb.INHIBITED and not word & 0x0001:
            state = _Abb.NOT_READY
        if state is _Abb.NOT_READY and word & 0x0007 == 0x0006:
            state = _Abb.READY_ON
        if state is _Abb.READY_ON and word & 0x0007 == 0x0007:
            state = _Abb.READY_RUN
        if state in (_Abb.READY_RUN, _Abb.OPERATION):
            state = _Abb.OPERATION if word & 0x0008 else _Abb.READY_RUN
        return state

    @property
    def motion(self) -> Motion:
        """The motion, which bits 4 to 6 of the control word determine during operation."""
        if self.fault:
            return Motion.COAST
        if self.local or self.state in (_Abb.OFF1, _Abb.OFF3):
            return Motion.RAMP_DOWN
        if self.state is not _Abb.OPERATION:
            return Motion.COAST
        if self.word & 0x0050 != 0x0050:
            return Motion.RAMP_DOWN
        return Motion.FOLLOW if self.word & 0x0020 else Motion.HOLD

    def status(self) -> int:
        """Return the status word as on page 619 of the manual; external run enable is wired."""
        state, on = self.state, (_Abb.READY_RUN, _Abb.OPERATION)
        ramps = state in (_Abb.OFF1, _Abb.OFF3) and self.moving
        return _word({
            0: not self.fault and state in (_Abb.READY_ON, *on),
            1: not self.fault and state in on,
            2: not self.fault and (state is _Abb.OPERATION or ramps),
            3: self.fault, 4: state is not _Abb.OFF2, 5: state is not _Abb.OFF3,
            6: state is _Abb.INHIBITED, 7: self.warning,
            8: self.at_speed and state is _Abb.OPERATION, 9: not self.local, 12: True,
        })


class FcProfile(SimulatedDrive):
    """FC profile of the Danfoss VLT AQUA Drive FC 202.

    The source is the design guide, "Danfoss FC Control Profile". In the control word, bits 2
    (brake), 3 (coast), 4 (quick stop) and 5 (hold) are active low, bit 6 is start and bit 7 is
    reset. A word without bit 10 ("data valid") is ignored. After the timeout, parameter 8-04 takes
    effect: 5 stops and trips the drive, 2 stops it until the next valid word, and 1 freezes the
    output.
    """

    DELIVERED = (600, 0)  # 8-03 60 s, 8-04 Off
    TRIPS = (5,)
    LOSS: ClassVar = {"serial": 1 << 4}
    RESET = 0x0080

    def restarts_timeout(self, name: str) -> bool:
        """Return True only for valid control words."""
        return name == "control" and bool(self.read_raw(name) & 0x0400)

    def control(self, word: int) -> None:
        """Obey only valid control words."""
        if word & 0x0400:
            super().control(word)

    @property
    def motion(self) -> Motion:
        """The motion: coasting takes precedence over braking, and braking over the ramp."""
        word = self.word
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

    def status(self) -> int:
        """Return the status word as in the manual's table "Definition of the status bits"."""
        starts = self.motion in (Motion.FOLLOW, Motion.HOLD)
        return _word({
            0: True, 1: not self.fault, 2: self.word & 0x0008, 3: self.fault, 7: self.warning,
            8: self.at_speed, 9: not self.local, 10: True, 11: starts or self.moving,
        })


class CimProfile(SimulatedDrive):
    """Modbus profile of Grundfos pumps with a CIM 200 or CIM 500 module.

    The source is the functional profile, sections 9.4 and 9.5. In the control word, bit 0 requests
    bus control, bit 1 switches the pump on and bit 2 resets an alarm. Without bus control, or after
    its loss, the pump follows its local setting: it stops if it is set up as this project requires,
    but runs if it has the factory settings.
    """

    DELIVERED = (0, 0)
    RESET = 0x0004
    EXTRA: ClassVar = {"control_mode": 101, "operation_mode": 102}
    _POWER_UP_MODE = 4  # constant pressure
    _CONSTANT_FREQUENCY = 1
    _OTHER_MODE = 0.6  # a speed that no set-point requested (share of the rated speed)

    def power_up(self) -> None:
        """Start in local control."""
        super().power_up()
        self.write_raw("control_mode", self._POWER_UP_MODE)

    @property
    def _remote(self) -> bool:
        return bool(self.word & 0x0001) and not self.local

    @property
    def _on(self) -> bool:
        return self._remote and bool(self.word & 0x0002)

    @property
    def motion(self) -> Motion:
        """The motion: the pump follows the set-point if it is on, and otherwise ramps down to 0."""
        if self.fault:
            return Motion.COAST
        return Motion.FOLLOW if self._on else Motion.RAMP_DOWN

    @property
    def setpoint(self) -> float:
        """The set-point, which applies only in constant-frequency mode under bus control."""
        modes = self.read_raw("control_mode"), self.read_raw("operation_mode")
        follows = self._remote and modes == (self._CONSTANT_FREQUENCY, 0)
        return super().setpoint if follows else self._OTHER_MODE

    def status(self) -> int:
        """Return the status word as in section 9.5 of the manual."""
        return _word({
            6: self.moving, 8: self._remote, 9: self._on, 10: self.fault, 12: self.local,
        })

    def communication_lost(self) -> None:
        """Return to local control; there is no alarm."""
        self.word = 0


class _Cia(enum.Enum):
    DISABLED = 0x0040
    READY = 0x0021
    SWITCHED_ON = 0x0023
    ENABLED = 0x0027
    QUICK_STOP = 0x0007
    REACTION = 0x000F
    FAULT = 0x0008


class Cia402(SimulatedDrive):
    """CiA 402 profile of the Schneider Electric Altivar drives.

    The source is BBV51701, state chart, pages 9 to 13. The value of a state consists of bits 0 to
    3, 5 and 6 of the status word ETA. LFT contains the last error, which a reset does not clear. In
    the control word, bit 0 is 'switch on', bit 1 'enable voltage', bit 2 'quick stop' (active low),
    bit 3 'enable operation', bit 7 'fault reset' and bit 8 'halt'. After the timeout, the values 1
    (freewheel), 6 (ramp), 7 (fast stop) and 8 (DC injection) of SLL and ETHL trip the drive; 2
    stops the drive without an error.
    """

    DELIVERED = (100, 1)  # TTO and TTOB 10.0 s, SLL and ETHL freewheel stop
    TRIPS = (1, 6, 7, 8)
    LOSS: ClassVar = {"serial": 5, "tcp": 150}
    RESET = 0x0080
    INITIAL = _Cia.DISABLED

    @property
    def fault_register(self) -> int:
        """The code of the last error, even if that error has been reset."""
        return self.last_fault

    def next_state(self) -> _Cia:
        """Return the next state of the state chart; 'ready' first leads to 'switched on'."""
        word, state = self.word, self.state
        if not word & 0x0002:  # disable voltage
            return _Cia.DISABLED
        if not word & 0x0004:
            running = state in (_Cia.ENABLED, _Cia.QUICK_STOP)
            return _Cia.QUICK_STOP if running else _Cia.DISABLED
        if state is _Cia.QUICK_STOP or (state is _Cia.DISABLED and word & 0x0001):
            return state
        if not word & 0x0001:  # shutdown
            return _Cia.READY
        if not word & 0x0008 or state is _Cia.READY:
            return _Cia.SWITCHED_ON
        return _Cia.ENABLED

    def standstill(self) -> None:
        """Leave a quick stop or the reaction to a fault now that the motor is at rest."""
        after = {_Cia.QUICK_STOP: _Cia.DISABLED, _Cia.REACTION: _Cia.FAULT}
        self.state = after.get(self.state, self.state)

    def trip(self, fault: int) -> None:
        """Trip; a ramped stop after a timeout passes through the state 'fault reaction'."""
        super().trip(fault)
        if fault:
            ramps = fault == self.loss and self.guard[1] in (6, 7)
            self.state = _Cia.REACTION if ramps else _Cia.FAULT

    @property
    def motion(self) -> Motion:
        """The motion: the drive follows its reference only in the state 'operation enabled'."""
        if self.state is _Cia.ENABLED and not self.local:
            stopped = self.word & 0x0100 or (self.lost and self.guard[1] == 2)
            return Motion.RAMP_DOWN if stopped else Motion.FOLLOW
        if self.state in (_Cia.SWITCHED_ON, _Cia.QUICK_STOP, _Cia.REACTION) or (
            self.local and not self.fault
        ):
            return Motion.RAMP_DOWN
        return Motion.COAST

    def status(self) -> int:
        """Return the status word ETA: state, voltage, warning, remote, reference reached."""
        return int(self.state.value) | _word({
            4: True, 7: self.warning, 9: not self.local, 10: self.at_speed,
        })


DRIVES: Mapping[str, type[SimulatedDrive]] = {
    "ABB": AbbDrives, "Danfoss": FcProfile, "Grundfos": CimProfile, "Schneider Electric": Cia402,
}


def _word(bits: Mapping[int, object]) -> int:
    return sum(1 << bit for bit, on in bits.items() if on)
