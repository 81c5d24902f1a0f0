"""Values in one or two 16-bit registers, and texts in several."""

from __future__ import annotations

import math
from collections.abc import Sequence

# How many registers a number takes.
WIDTHS = {"uint16": 1, "int16": 1, "uint32": 2, "int32": 2, "float32": 2}
WORD_ORDERS = ("", "high first", "low first")


def limits(kind: str) -> tuple[float, float]:
    """Return the least and the greatest value of a type."""
    if kind == "float32":
        return -math.inf, math.inf
    bits = 16 * WIDTHS[kind]
    return (0, 2**bits - 1) if kind.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def decode(registers: Sequence[int], kind: str, word_order: str = "") -> int | float | str:
    """Return the value in some registers: a text for the type ``text``, else a number."""
    from pymodbus.client.mixin import ModbusClientMixin

    types = ModbusClientMixin.DATATYPE
    value = ModbusClientMixin.convert_from_registers(
        registers, types.STRING if kind == "text" else types[kind.upper()],
        "little" if word_order == "low first" else "big", "latin-1",
    )
    assert not isinstance(value, list)
    return value.replace("\0", " ").strip() if isinstance(value, str) else value


def encode(value: float, kind: str, word_order: str = "") -> list[int]:
    """Return the registers of a number, rounded and limited to what the type can hold."""
    from pymodbus.client.mixin import ModbusClientMixin

    if kind != "float32":
        low, high = limits(kind)
        value = int(min(max(round(value), low), high))
    return ModbusClientMixin.convert_to_registers(
        value, ModbusClientMixin.DATATYPE[kind.upper()],
        "little" if word_order == "low first" else "big",
    )
