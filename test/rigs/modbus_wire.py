"""The other end of a Modbus line, byte by byte: it records requests and sends answers."""

from __future__ import annotations

import contextlib
import re
import socket
import struct
import threading
import time
from collections.abc import Callable

# What answers a request: frames, each after a wait (s); None closes the connection.
Answer = list[tuple[float, bytes]] | None

# Returns the bytes of a frame that is written as hexadecimal digits and spaces.
frame = bytes.fromhex


class Wire:
    """A TCP port that takes Modbus TCP frames and gives the answers that a test defines."""

    def __init__(self, answer: Callable[[bytes], Answer], port: int = 0) -> None:
        self.answer = answer
        self.requests: list[bytes] = []
        self.connections = 0
        self.resets = 0  # number of connections that the other side reset instead of closing
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listener.getsockname()[1]
        self.open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def frames(self) -> list[str]:
        """The received frames, in hexadecimal digits."""
        return [request.hex() for request in self.requests]

    @property
    def at(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    @property
    def gateway(self) -> str:
        """The same address, as a gateway to a drive's serial port."""
        return f"gateway://127.0.0.1:{self.port}"

    def close(self) -> None:
        for each in (self._listener, *self.open):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        self.open.clear()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self.connections += 1
            self.open.append(connection)
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection.makefile("rb") as stream:
                while head := stream.read(6):
                    request = head + stream.read(int.from_bytes(head[4:6], "big"))
                    self.requests.append(request)
                    answers = self.answer(request)
                    if answers is None:
                        connection.close()
                        return
                    for wait, data in answers:
                        time.sleep(wait)
                        connection.sendall(data)
        except ConnectionResetError:
            self.resets += 1
        except OSError:
            pass


def script(dialogue: str) -> tuple[list[bytes], Callable[[bytes], Answer]]:
    """Return the requests of a dialogue, and a function that gives their answers in that order.

    Each frame starts with the Modbus TCP header (Modbus Messaging on TCP/IP V1.0b, section 3.1):
    transaction (2 bytes, 1, 2, ...), protocol 0000, length, and unit 1.

    Args:
        dialogue: ``REGISTER? WORD ...`` or ``REGISTER= WORD``, in hexadecimal digits and separated
            by commas; ``! CODE`` after a step is its exception.
    """
    requests, answers = [], []
    steps = re.findall(r"(\w{4})([?=])([ \w]+)(?:!([ \w]+))?", dialogue)
    for number, (register, sign, words, refused) in enumerate(steps, start=1):
        data = frame(words)
        request = answer = b"\6" + frame(register) + data
        if sign == "?":
            request = b"\3" + frame(register) + struct.pack(">H", len(data) // 2)
            answer = b"\3" + bytes([len(data)]) + data
        if refused:
            answer = bytes([request[0] | 0x80]) + frame(refused)
        for body, frames in ((request, requests), (answer, answers)):
            frames.append(struct.pack(">HHHB", number, 0, len(body) + 1, 1) + body)
    remaining = iter([[(0.0, answer)] for answer in answers])
    return requests, lambda _request: next(remaining, [])


class Registers:
    """Holding registers behind Modbus TCP; a write can change other registers, or be refused."""

    def __init__(self, values: dict[int, int]) -> None:
        self.values = values
        self.written: list[tuple[int, int]] = []
        self.silent = False
        self.refused: set[int] = set()
        self.on_write: Callable[[int, int], None] = lambda _address, _word: None

    def __call__(self, request: bytes) -> Answer:
        if self.silent:
            return []
        head, function = request[:4], request[7]
        address = int.from_bytes(request[8:10], "big")
        number = int.from_bytes(request[10:12], "big")
        if function == 6 and address in self.refused:
            return [(0.0, head + bytes([0, 3, request[6], 0x86, 6]))]
        if function == 6:
            self.written.append((address, number))
            self.values[address] = number
            self.on_write(address, number)
            return [(0.0, request)]
        if any(address + offset not in self.values for offset in range(number)):
            return [(0.0, head + bytes([0, 3, request[6], 0x83, 2]))]
        data = b"".join(
            self.values[address + offset].to_bytes(2, "big") for offset in range(number)
        )
        body = bytes([request[6], 3, len(data)]) + data
        return [(0.0, head + len(body).to_bytes(2, "big") + body)]


def acs880() -> Registers:
    """Return registers that follow the state diagram of the ABB Drives profile.

    ACS880 firmware manual, page 620; only what the tests need: 0x047E leads to READY TO SWITCH ON,
    0x047F from there to OPERATION, and a rising bit 7 out of FAULT.
    """
    drive = Registers({
        0: 0, 1: 0, 3: 0x1270, 4: 0, 400: 0, 405: 0, 702: 1234, 5813: 1, 5814: 2, 5815: 50,
    })

    def moved(address: int, word: int) -> None:
        state = drive.values[3]
        if address == 0:
            if word & 0x0080 and state & 0x0008:
                state = 0x1270
            elif state & 0x0008:
                pass
            elif not word & 0x0001:
                state = 0x1231
            elif state & 0x0001:
                state = 0x1337
        drive.values[3] = state
        drive.values[4] = drive.values[1] if state & 0x0004 else 0

    drive.on_write = moved
    return drive
