"""Rows of a check: requests with their allowed outcomes, layers to play, and waits."""

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

from drivers.protocol.definition import QUANTITIES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet

FULL = QUANTITIES["level"].per_unit
"""Steps of a full level."""


@dataclass(frozen=True, slots=True)
class Send:
    """Request from values (with the held session unless another is given) or from raw words.

    layers: of a set, which is sent in parts. codes: allowed outcomes, "" meaning carried out.
    channels: channels that a rejection can name, None for no channel.
    """

    name: str
    raw: Sequence[int] | None
    values: Values
    layers: tuple[LayerSet, ...]
    codes: tuple[str, ...]
    channels: tuple[int | None, ...]


@dataclass(frozen=True, slots=True)
class Wait:
    """Wait for a time [s] with a fed watchdog."""

    duration: float


Step: TypeAlias = LayerSet | Send | Wait | Callable[[], Awaitable[object] | None]
"""A layer to play, a request, a wait, or a function to call and await."""
Row: TypeAlias = "Step | Sequence[Row]"
"""A step, or a sequence of rows.

A sequence starts at rest and armed, and is followed until all outputs have settled.
"""
RequestRows: TypeAlias = Sequence[Row]


def send(
    name: str,
    *,
    raw: Sequence[int] | None = None,
    code: str | tuple[str, ...] = "",
    channels: tuple[int | None, ...] = (None,),
    layers: tuple[LayerSet, ...] = (),
    **values: Any,
) -> Send:
    """Build a request that must be carried out, or rejected with a code."""
    codes = (code,) if isinstance(code, str) else code
    return Send(name, raw, values, layers, codes, channels)


STOP_NOW = send("Stop", ramp=0)
DISARM_NOW = send("Disarm", ramp=0)
SILENCE_NOW = send("Silence", ramp=0)


def commit(token: int, code: str = "") -> Send:
    """Build a Commit that must be carried out, or rejected with a code."""
    return send("Commit", token=token, code=code)


def play_now(*layers: LayerSet, now: int = 1, **values: Any) -> Send:
    """Build a set that plays immediately; values: token, session and code for `send`."""
    return send("Set", layers=layers, now=now, **values)


stage = partial(play_now, now=0)
"""Build a set that is staged."""


def layer(
    number: int,
    *commands: Command,
    ramp: int = 0,
    valid_for: int = 0,
    after: bool = False,
    renew: bool = False,
) -> LayerSet:
    """Build the content of a layer; ramp, valid_for in ms."""
    return LayerSet(number, ramp, valid_for, commands, after, renew)
