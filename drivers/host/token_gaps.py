"""Tokens of amplifiers that are sent nothing for long, while a group counts on.

A token is newer than another by less than half of 2^16 (RFC 1982): an amplifier that was left out
of 40 000 sets would take the next one for an older one.
"""

import asyncio
from collections.abc import Iterable

from drivers.contents import Layer
from drivers.host.amplifier import Amplifier
from drivers.protocol.tokens import token_after

INTERVAL = 1 << 12
"""Tokens after which the gaps are looked at again."""
_MAX_GAP = 1 << 14
_SPAN = 1 << 16


async def close_gaps(amplifiers: Iterable[Amplifier], token: int) -> int:
    """Have amplifiers whose token is far behind one commit a set that changes nothing.

    Returns the token of that set, or the one that was given. Raises what `Amplifier.stage` raises.
    """
    behind = [each for each in amplifiers if _is_behind(each, token)]
    unchanged = [(each, layer) for each in behind if (layer := _unchanged(each)) is not None]
    if not unchanged:
        return token
    token = token_after(token)
    await asyncio.gather(*(each.stage(token, [layer], now=True) for each, layer in unchanged))
    return token


def _is_behind(amplifier: Amplifier, token: int) -> bool:
    committed = amplifier.committed  # 0: any is newer
    return committed > 0 and (token - committed) % _SPAN > _MAX_GAP


def _unchanged(amplifier: Amplifier) -> Layer | None:
    """Return a layer that is silent, or renewed without end; None if all end soon by themselves."""
    playback = amplifier.ledger.playback
    playing = playback.tokens
    for number in range(amplifier.capabilities["layers"]):
        if number not in playing:
            return Layer(number)
        if playback.is_endless(number):
            return Layer(number, renew=True)
    return None
