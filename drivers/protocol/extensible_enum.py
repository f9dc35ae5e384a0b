"""Enumerations of numbers on the wire that later versions and vendors may extend."""

from enum import IntEnum
from typing import Self

from drivers.protocol.definition import PROTOCOL


class ExtensibleEnum(IntEnum):
    """Numbers of one byte; one without a name is NUMBER_n, or VENDOR_n in the vendors' range."""

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        if not isinstance(value, int) or not 0 <= value <= 255:
            return None
        member = int.__new__(cls, value)
        member._name_ = f"{'VENDOR' if value >= PROTOCOL.vendor_numbers else 'NUMBER'}_{value}"
        member._value_ = value
        return member
