"""Capabilities as the amplifier states them, which can be invalid."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from drivers.protocol.definition import FEATURES, MESSAGES, capability_ranges
from drivers.protocol.records import Field, Number, Record, Values
from drivers.protocol.records import Rows as RowsOf
from era_haptics.lab.conformance.outcomes import UnusableCapability

_WORD = 0xFFFF


def _unlimited(field: Field) -> Field:
    """Return a copy of a field without limits on its numbers, except for channels."""
    if isinstance(field, RowsOf):
        return replace(field, record=Record(*map(_unlimited, field.record.fields)))
    if isinstance(field, Number) and field.name != "channels":
        lowest = int(field.is_added)  # 0: not stated
        quantity = replace(field.quantity, minimum=lowest, maximum=_WORD)
        return replace(field, quantity=quantity)
    return field


_REPLY = MESSAGES["GetCaps"].reply
(_LIMITS,) = (field.record for field in _REPLY.fields if isinstance(field, RowsOf))
STATED = Record(*map(_unlimited, _REPLY.fields))
"""Reply to GetCaps; any word is accepted as a number, so that wrong ones can be reported."""


class Capabilities(dict[str, Any]):
    """Capabilities by name; wrong: the invalid ones, each with the required and the stated value.

    Raises UnusableCapability on access to an invalid one, so that checks without it can run.
    """

    def __init__(self, stated: Values) -> None:
        super().__init__(stated)
        self.wrong: dict[str, tuple[str, int]] = {}
        for name, low, value, high in _ranges(stated):
            if not low <= value <= high:
                self.wrong.setdefault(name, (f"{low} to {high}", value))

    def __getitem__(self, name: str) -> Any:
        """Return a capability."""
        if name in self.wrong:
            required, value = self.wrong[name]
            raise UnusableCapability(f"its {name} must be {required}, got {value}")
        return super().__getitem__(name)


def _ranges(can: Values) -> Iterator[tuple[str, int, int, int]]:
    """Yield the name, minimum, value and maximum of each number."""
    for name, number, value in _numbers(can):
        yield name, number.quantity.minimum, value, number.quantity.maximum
    yield from capability_ranges(can)
    yield "features", 0, can["features"], (2 << max(FEATURES.values())) - 1
    for limits in can["limits"]:
        low, high = limits["frequency_min"], limits["frequency_max"]
        yield "limits", can["frequency_min"], low, high
        yield "limits", low, high, can["frequency_max"]
        yield "limits", 1, limits["level_max"], can["level_max"]


def _numbers(can: Values) -> Iterator[tuple[str, Number, int]]:
    """Yield each stated number with its capability's name and its field."""
    for field in _REPLY.fields:
        if isinstance(field, Number) and can[field.name] is not None:
            yield field.name, field, can[field.name]
    for limits in can["limits"]:
        for field in _LIMITS.fields:
            if isinstance(field, Number) and limits[field.name] is not None:
                yield "limits", field, limits[field.name]
