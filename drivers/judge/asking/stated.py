"""Capabilities as they are stated, beyond their ranges too, and which of them cannot be so."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, TypeAlias

from drivers.judge.asking.client import Unusable
from drivers.protocol.records import Field, Number, Record, Rows, Values
from drivers.protocol.table import FEATURES, MESSAGES

_WORD = 0xFFFF
_Range: TypeAlias = tuple[str, int, int, int]


def _unlimited(field: Field) -> Field:
    """Return a field whose numbers, but that of channels, may be any."""
    if isinstance(field, Rows):
        return replace(field, record=Record(*map(_unlimited, field.record.fields)))
    if isinstance(field, Number) and field.name != "channels":
        return replace(field, quantity=replace(field.quantity, minimum=0, maximum=_WORD))
    return field


_REPLY = MESSAGES["GetCaps"].reply
(_LIMITS,) = (field.record for field in _REPLY.fields if isinstance(field, Rows))
STATED = Record(*map(_unlimited, _REPLY.fields))
"""The reply to GetCaps; a number may be any word, of which those that are wrong are found."""


def _ranges(can: Values) -> Iterator[_Range]:
    """Yield each number with its name, between the least and the most that it may be."""
    rows = [(_REPLY, can), *((_LIMITS, one) for one in can["limits"])]
    for record, row in rows:
        for field in record.fields:
            if isinstance(field, Number):
                name = field.name if record is _REPLY else "limits"
                yield name, field.quantity.minimum, row[field.name], field.quantity.maximum
    for name in ("frequency_step", "level_step", "phase_step", "level_max"):
        yield name, 1, can[name], _WORD
    yield "voices", can["layers"], can["voices"], _WORD
    yield "features", 0, can["features"], (1 << len(FEATURES)) - 1
    for name in ("frequency", "watchdog", "envelope_step"):
        yield f"{name}_max", can[f"{name}_min"], can[f"{name}_max"], _WORD
    for one in can["limits"]:
        low, high = one["frequency_min"], one["frequency_max"]
        yield "limits", can["frequency_min"], low, high
        yield "limits", low, high, can["frequency_max"]
        yield "limits", 1, one["level_max"], can["level_max"]


class Capabilities(dict[str, Any]):
    """Capabilities by name; wrong: what each must be that cannot be so, and what is stated.

    Raises Unusable for one of those, so that what does not ask for it goes on.
    """

    def __init__(self, stated: Values) -> None:
        super().__init__(stated)
        self.wrong: dict[str, tuple[str, int]] = {}
        for name, low, seen, high in _ranges(stated):
            if not low <= seen <= high:
                self.wrong.setdefault(name, (f"{low} to {high}", seen))

    def __getitem__(self, name: str) -> Any:
        """Return a capability."""
        if name in self.wrong:
            must, seen = self.wrong[name]
            raise Unusable(f"its {name} must be {must}, got {seen}")
        return super().__getitem__(name)
