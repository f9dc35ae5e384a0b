"""Rows of a check: what is sent in turn, and what must be answered."""

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet


@dataclass(frozen=True, slots=True)
class Send:
    """A request by its values, the session that is held unless one is given, or by raw words.

    layers: of a set, which is sent in its parts. codes: one of which must be the answer, an empty
    one: carried out. channels: one of which a refusal must name.
    """

    name: str
    raw: Sequence[int] | None
    values: Values
    layers: tuple[LayerSet, ...]
    codes: tuple[str, ...]
    channels: tuple[int | None, ...]


Row: TypeAlias = "LayerSet | Send | float | Callable[[], Awaitable[object]] | Sequence[Row]"
"""A layer that plays, a request, a pause [s] in which the watchdog is fed, what is awaited, or a
course: rows that begin at rest, armed, and are followed until all is settled."""
Rows: TypeAlias = Sequence[Row]


def send(
    name: str,
    *,
    raw: Sequence[int] | None = None,
    code: str | tuple[str, ...] = "",
    channels: tuple[int | None, ...] = (None,),
    layers: tuple[LayerSet, ...] = (),
    **values: Any,
) -> Send:
    """Make a request that must be carried out, or refused with a code."""
    return Send(name, raw, values, layers, (code,) if isinstance(code, str) else code, channels)


def play(*layers: LayerSet, now: int = 1, **values: Any) -> Send:
    """Make a set that plays at once; values: token, session, code, as of `send`."""
    return send("Set", layers=layers, now=now, **values)


def stage(*layers: LayerSet, **values: Any) -> Send:
    """Make a set that is staged."""
    return play(*layers, now=0, **values)
