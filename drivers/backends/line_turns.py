"""Whose turn it is on a line that several amplifiers share, where only one may be asked at a time.

Each amplifier has turns of its own (`drivers.link`); these are between amplifiers. What silences
one of them goes before all that others wait for, and what was on the line meanwhile is sent again.
"""

from collections.abc import Awaitable, Callable
from typing import TypeVar

from drivers.errors import CommandRefused
from drivers.protocol.messages import Apply, Disarm, Request, Stop
from drivers.turns import Kind, Turns

_T = TypeVar("_T")


def kind_on_line(request: Request) -> Kind:
    """How a request stands to those for others; no set takes the place of another's."""
    is_silent_set = isinstance(request, Apply) and request.command_set.is_silent
    return Kind.SILENCE if is_silent_set or isinstance(request, Stop | Disarm) else Kind.ORDINARY


async def in_turn(turns: Turns, kind: Kind, exchange: Callable[[], Awaitable[_T]]) -> _T:
    """Do an exchange when it has its turn, and again where it had to give way.

    Repeating is safe: a token is played once, and the other requests may be repeated anyway.
    """
    while True:
        try:
            async with turns.take(kind):
                return await exchange()
        except CommandRefused:  # no backend raises it by itself: an amplifier's refusal is a reply
            continue
