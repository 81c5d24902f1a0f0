"""The sensor file, and a Modbus client that refuses values that cannot be a level."""

from __future__ import annotations

import threading
import time
from contextlib import closing, suppress
from itertools import chain, cycle, islice, pairwise, repeat

import pytest
from graphs import free_ports
from modbus_wire import Answer, SerialWire, Wire, crc
from simulators import until

from greenroof_ros.live.devices import sensor as devices
from greenroof_ros.live.devices.modbus_line import DriveError, ModbusLine
from greenroof_ros.live.devices.sensor import ModbusReader, SensorLine
from greenroof_ros.live.devices.sensor_file import ModbusSensor


def sensor(at: str, **changed: object) -> ModbusSensor:
    """A sensor with 0.1 mm per count, up to 6 m, without a filter."""
    values: dict[str, object] = {
        "address": at, "device_id": 1, "register": 16, "kind": "input", "type": "uint16",
        "scale": 1e-4, "low": 0.0, "high": 6.0, "median": 1, "period": 0.05,
    }
    return ModbusSensor(**{**values, **changed})  # type: ignore[arg-type]


def reading(sensor: ModbusSensor, timeout_s: float = 0.2) -> ModbusReader:
    """The reader of a sensor alone on its line: three timeouts are half of the maximum age."""
    line = SensorLine(sensor.address)
    return ModbusReader(sensor, "m", line, max_age=6 * timeout_s)


def levels(readings: list[str], **changed: object) -> list[float | str]:
    """Return the result of each answer to function 04: levels, or the problem reported instead."""
    remaining = list(readings)

    def answer(request: bytes) -> Answer:
        if not remaining:
            return []
        assert request[7] == (4 if changed.get("kind", "input") == "input" else 3)
        data = bytes.fromhex(remaining.pop(0))
        body = bytes([request[6], request[7], len(data)]) + data
        return [(0.0, request[:4] + len(body).to_bytes(2, "big") + body)]

    results: list[float | str] = []
    with closing(Wire(answer)) as wire, closing(
        reading(sensor(wire.at, **changed), timeout_s=0.3)
    ) as client:
        before = client.snapshot
        client.start()
        while len(results) < len(readings):
            now = client.snapshot
            if now is not before:
                problem = now.problem.removeprefix(f"{wire.at}, device 1: ")
                results.append(problem or now.value or 0.0)
            before = now
            time.sleep(0.001)
    return results


# --- readings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "changed", "level"),
    [
        ("5A3C", {}, 2.31),  # 23100 x 0.1 mm
        ("0BB8", {"scale": 0.001, "offset": -0.5, "kind": "holding"}, 2.5),
        ("FF9C", {"type": "int16", "scale": 0.01, "offset": 3.0}, 2.0),  # -100
        ("0000 4020", {"type": "float32", "word_order": "low first", "scale": 1.0}, 2.5),
        ("8000 0000 0000 0000",
         {"type": "uint64", "word_order": "high first", "missing": 2**63},
         "reports 0x8000000000000000, which means 'no reading'"),
        # A moisture probe in 0.1 %: 0.361 m3/m3 of a substrate 0.108 m deep is 38.99 mm of water;
        # with the wilting point, 0.02 m3/m3, as the zero it is 36.83 mm.
        ("0169", {"scale": 0.001, "substrate_depth": 0.108}, 0.038988),
        ("0169", {"scale": 0.001, "offset": -0.02, "substrate_depth": 0.108}, 0.036828),
        ("03E9", {"scale": 0.001, "substrate_depth": 0.108, "high": 0.108},
         "reports 0.108108 m (raw 1001), which is not from 0 to 0.108 m"),
        # A value that cannot be a level is refused with the reason.
        ("EA61", {}, "reports 6.0001 m (raw 60001), which is not from 0 to 6 m"),
        ("FFFF", {"missing": 0xFFFF}, "reports 0xFFFF, which means 'no reading'"),
        ("7FC0 0000", {"type": "float32", "word_order": "high first", "scale": 1.0},
         "reports nan, which is not a number"),
    ],
)
def test_scale_offset_type_and_word_order(
    data: str, changed: dict[str, object], level: float | str
) -> None:
    (result,) = levels([data], **changed)
    assert result == (level if isinstance(level, str) else pytest.approx(level))


def test_the_median_leaves_single_wrong_readings_out_and_starts_again_after_a_refused_one() -> None:
    """Of three: 1, 1 (of 1, 9: the lower), 1, 2 | 3 alone, then 3 (of 3, 4)."""
    data = ["2710", "EA60", "2710", "4E20", "FFFF", "7530", "9C40"]  # 1, 6, 1, 2, -, 3, 4 m
    no_reading = "reports 0xFFFF, which means 'no reading'"
    assert levels(data, median=3, missing=0xFFFF) == [1.0, 1.0, 1.0, 2.0, no_reading, 3.0, 3.0]


def test_no_level_of_before_a_suspend_counts_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine was suspended for an hour between the third reading and the fourth."""
    slept = chain([0.0] * 4, repeat(3600.0))  # the first call is before any reading
    monkeypatch.setattr(devices, "suspended_time", lambda: next(slept))
    assert levels(["2710"] * 3 + ["9C40"] * 2, median=3) == [1.0, 1.0, 1.0, 4.0, 4.0]


GOOD, BAD = True, False


@pytest.mark.parametrize(
    ("stretches", "refused"),
    [
        ([(59, 1.0, [BAD, GOOD])], 5),  # of the first nine
        ([(60, 1.0, [BAD, GOOD])], 30),  # the first minute is over
        ([(5, 0.05, [*20 * [BAD], GOOD])], 20),  # at once
        ([(180, 1.0, [*19 * [GOOD], BAD])], None),  # one in twenty is no tenth
        ([(40, 1.0, [BAD]), (20, 1.0, [GOOD])], None),  # it was lost, which is an alarm of its own
        ([(60, 1.0, [BAD, GOOD]), (5, 1.0, [BAD])], None),  # likewise, now
        ([(60, 1.0, [BAD, GOOD]), (130, 1.0, [GOOD])], None),  # it is mended
        ([(2, 0.1, [BAD])], None),  # none is good: it may be lost
    ],
)
def test_too_many_refused_readings(
    monkeypatch: pytest.MonkeyPatch, stretches: list[tuple[float, float, list[bool]]],
    refused: int | None,
) -> None:
    """More than a tenth of a minute's, and five: for how long (s), and what comes in a period."""
    now = 1000.0
    monkeypatch.setattr(devices.time, "monotonic", lambda: now)
    share = devices.RefusedShare()
    for seconds, period, pattern in stretches:
        for good in islice(cycle(pattern), round(seconds / period)):
            now += period
            share.count("" if good else "reports nonsense")
    assert (share.diagnosis and share.diagnosis.values["refused"]) == refused


def test_a_sensor_that_comes_and_goes_is_read_while_it_is_there() -> None:
    port = free_ports(1)[0]
    with closing(reading(sensor(f"tcp://127.0.0.1:{port}"))) as exchange:
        assert exchange.snapshot.problem == "not yet read"
        exchange.start()
        for _ in range(2):
            until(lambda: "cannot connect" in exchange.snapshot.problem)
            assert exchange.snapshot.value is None
            with closing(Wire(
                lambda request: [(0.0, request[:4] + bytes.fromhex("0005 01 04 02 2710"))],
                port=port,
            )):
                until(lambda: exchange.snapshot.value == 1.0)
                assert exchange.snapshot.problem == ""
                assert time.monotonic() - exchange.snapshot.read_at < 0.5


def test_no_error_ends_the_reading_for_good(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that no one expects is reported, and the sensor is tried again."""
    monkeypatch.setattr(ModbusLine, "connect", lambda line: 1 / 0)
    with closing(reading(sensor("tcp://127.0.0.1:502"))) as exchange:
        exchange.start()
        until(lambda: "tcp://127.0.0.1:502: reading failed: Zero" in exchange.snapshot.problem)
        first = exchange.snapshot
        assert first.value is None
        until(lambda: exchange.snapshot.read_at > first.read_at)


# --- several on one line --------------------------------------------------------------------------


class TwoSensors:
    """The other end of a serial line with the devices 1 and 2, at 1.0 m and 3.0 m."""

    def __init__(self) -> None:
        self.data = {1: "2710", 2: "7530"}
        self.delay_s = 0.0  # before device 1 answers

    def __call__(self, request: bytes) -> bytes:
        if request[0] == 1:
            time.sleep(self.delay_s)
        if not (data := bytes.fromhex(self.data[request[0]])):
            return b""
        frame = bytes([request[0], 4, len(data)]) + data
        return frame + crc(frame)


def both(at: str, max_age: float) -> list[ModbusReader]:
    """Return the readers of both sensors, not started; device 1 is due far more often."""
    line = SensorLine(at)
    return [
        ModbusReader(sensor(at, device_id=number, period=period), "m", line, max_age)
        for number, period in ((1, 0.05), (2, 0.2))
    ]


def gaps(reader: ModbusReader, seconds: float) -> list[float]:
    """Return the times between the good readings of the next seconds; all must be 3.0 m."""
    began, times = time.monotonic(), []
    while time.monotonic() - began < seconds:
        now = reader.snapshot
        if not now.problem and now.read_at not in times:
            assert now.value == 3.0
            times.append(now.read_at)
        time.sleep(0.005)
    return [after - before for before, after in pairwise([began, *times, time.monotonic()])]


def test_a_sensor_next_to_a_silent_or_wrong_one_on_a_serial_line() -> None:
    """Readings of the good one are never further apart than its maximum age, 3 s, in any case.

    For a silent neighbour they come after at most its period and three timeouts, 0.2 + 0.75 s.
    """
    devices = TwoSensors()
    with closing(SerialWire(devices)) as wire:
        first, second = both(wire.line, 3.0)
        with closing(first), closing(second):
            for reader in (first, second):
                reader.start()
            until(lambda: (first.snapshot.value, second.snapshot.value) == (1.0, 3.0))
            for data, problem in (
                ("", "no valid response within 0.25 s"), ("FFFF", "which is not from 0 to 6 m"),
                ("27102710", "2 registers, not 1"),
            ):
                devices.data[1] = data
                until(lambda problem=problem: problem in first.snapshot.problem)
                assert first.snapshot.value is None
                apart = gaps(second, 3.0)
                assert max(apart) < 3.0 and sorted(apart)[len(apart) // 2] < 1.0, data
            devices.data[1] = "2710"
            until(lambda: first.snapshot.value == 1.0)
            assert second.snapshot.value == 3.0


def test_a_late_answer_of_one_sensor_is_no_level_of_the_other() -> None:
    """Device 1 answers after 0.35 s, 0.1 s after the timeout: device 2 has been asked by then."""
    devices = TwoSensors()
    devices.delay_s = 0.35
    with closing(SerialWire(devices)) as wire:
        first, second = both(wire.line, 3.0)
        with closing(first), closing(second):
            first.start()
            until(lambda: "no valid response" in first.snapshot.problem)
            until(lambda: second.snapshot.value is not None)
            until(lambda: len(gaps(second, 3.0)) > 2)
            assert first.snapshot.value is None


@pytest.mark.parametrize("late_s", [0.3, 0.4, 0.6])
def test_a_late_answer_is_no_value_of_the_next_register(late_s: float) -> None:
    """Two channels of one device, at 1.0 m and 3.0 m, behind a gateway.

    It gives a late answer the number of the request that it received last.
    """
    data, wait_s, newest = {16: "2710", 17: "7530"}, 0.0, b""

    def answer(request: bytes) -> Answer:
        nonlocal newest
        newest = request

        def send() -> None:
            body = bytes.fromhex("0005 01 04 02" + data[request[9]])
            with suppress(OSError, IndexError):
                wire.newest.sendall(newest[:4] + body)

        threading.Timer(wait_s, send).start()
        return []

    with closing(Wire(answer)) as wire:
        line = SensorLine(wire.gateway)
        readers = [
            ModbusReader(sensor(wire.gateway, register=register, period=0.2), "m", line, 3.0)
            for register in data
        ]
        with closing(readers[0]), closing(readers[1]):
            line.start()
            until(lambda: [reader.snapshot.value for reader in readers] == [1.0, 3.0])
            wait_s = late_s
            until(lambda: all("no valid" in reader.snapshot.problem for reader in readers))
            end = time.monotonic() + 2.0
            while time.monotonic() < end:
                assert readers[0].snapshot.value in (None, 1.0)
                assert readers[1].snapshot.value in (None, 3.0)
                time.sleep(0.01)


def test_nothing_else_opens_a_line_that_is_read() -> None:
    """Neither a drive nor another program: bytes of two would mix."""
    with closing(SerialWire(TwoSensors())) as wire:
        first, second = both(wire.line, 3.0)
        with closing(first), closing(second):
            first.start()
            until(lambda: second.snapshot.value == 3.0)
            with pytest.raises(DriveError, match="cannot connect"):
                sensor(wire.line).line(0.2).connect()
        sensor(wire.line).line(0.2).connect()


def test_sensors_behind_one_gateway_share_a_connection() -> None:
    """Then device 9 is lost, which the gateway reports: the other sensor is read on."""
    answers = {1: "01 04 02 7530", 9: "09 04 02 2710"}

    def answer(request: bytes) -> Answer:
        body = bytes.fromhex(answers[request[6]])
        return [(0.0, request[:4] + len(body).to_bytes(2, "big") + body)]

    with closing(Wire(answer)) as wire:
        line = SensorLine(wire.at)
        good, lost = (
            ModbusReader(sensor(wire.at, device_id=number), "m", line) for number in (1, 9)
        )
        with closing(good), closing(lost):
            good.start()
            until(lambda: (good.snapshot.value, lost.snapshot.value) == (3.0, 1.0))
            assert wire.connections == 1
            answers[9] = "09 84 0B"
            until(lambda: "device 9: reading register 16: rejected with exception 11" in (
                lost.snapshot.problem))
            assert len(gaps(good, 4.0)) > 3
