"""Values in one or two 16-bit registers."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

_CODES = {"uint16": "H", "int16": "h", "uint32": "I", "int32": "i", "float32": "f"}
TYPES = tuple(_CODES)
WORD_ORDERS = ("", "high first", "low first")


def width(kind: str) -> int:
    """Return how many registers a type takes."""
    return struct.calcsize(f">{_CODES[kind]}") // 2


def limits(kind: str) -> tuple[float, float]:
    """Return the least and the greatest value of a type."""
    if kind == "float32":
        return -math.inf, math.inf
    bits = 16 * width(kind)
    return (0, 2**bits - 1) if kind.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def unsigned(registers: Sequence[int], word_order: str) -> int:
    """Return the bits of one or two registers as one number."""
    words = registers[::-1] if word_order == "low first" else registers
    return int.from_bytes(b"".join(word.to_bytes(2, "big") for word in words), "big")


def decode(registers: Sequence[int], kind: str, word_order: str = "") -> float:
    """Return the value in one or two registers."""
    raw = unsigned(registers, word_order)
    value: float = struct.unpack(f">{_CODES[kind]}", raw.to_bytes(2 * len(registers), "big"))[0]
    return value


def encode(value: float, kind: str, word_order: str = "") -> list[int]:
    """Return the registers of a value, rounded and limited to what the type can hold."""
    if kind != "float32":
        low, high = limits(kind)
        value = int(min(max(round(value), low), high))
    packed = struct.pack(f">{_CODES[kind]}", value)
    words = [int.from_bytes(packed[at:at + 2], "big") for at in range(0, len(packed), 2)]
    return words[::-1] if word_order == "low first" else words
