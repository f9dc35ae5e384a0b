"""Identification of amplifiers at URLs; only identify requests are sent, no output is driven."""

from collections.abc import Iterable
from dataclasses import dataclass

from drivers.by_hand.reaching import identified
from drivers.errors import DriverError, FrameError, LinkTimeout
from drivers.protocol.records import Values


@dataclass(frozen=True)
class IdentifyResult:
    """Result of an identify request at a URL: the identity, or the problem.

    was_sent: whether the request was sent, so that the problem is a missing reply.
    """

    url: str
    identity: Values | None
    problem: str | None = None
    was_sent: bool = True


async def identify_all(urls: Iterable[str]) -> list[IdentifyResult]:
    """Identify the amplifiers at these URLs, one after the other."""
    return [await _identify(url) for url in urls]


async def _identify(url: str) -> IdentifyResult:
    try:
        async with identified(url) as amplifier:
            return IdentifyResult(url, amplifier.identity)
    except DriverError as problem:
        was_sent = isinstance(problem, LinkTimeout | FrameError)
        return IdentifyResult(url, None, str(problem), was_sent=was_sent)
