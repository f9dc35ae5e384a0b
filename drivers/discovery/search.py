"""Identification of amplifiers at URLs; only identify requests are sent, no output is driven."""

from collections.abc import Iterable
from dataclasses import dataclass

from drivers.amplifier import Amplifier
from drivers.errors import DriverError, FrameError, LinkTimeout
from drivers.protocol.messages import Identity
from drivers.registry import open_backend


@dataclass(frozen=True)
class IdentifyResult:
    """Result of an identify request at a URL: the identity, or the problem.

    was_asked: whether the request was sent, so that the problem is a missing reply.
    """

    url: str
    identity: Identity | None
    problem: str | None = None
    was_sent: bool = True


async def identify_all(urls: Iterable[str]) -> list[IdentifyResult]:
    """Identify the amplifiers at these URLs, one after the other."""
    return [await _identify(url) for url in urls]


async def _identify(url: str) -> IdentifyResult:
    try:
        amplifier = Amplifier(open_backend(url))
        await amplifier.open(take_over=False)
    except DriverError as problem:
        was_sent = isinstance(problem, LinkTimeout | FrameError)
        return IdentifyResult(url, None, str(problem), was_sent=was_sent)
    identity = amplifier.identity
    await amplifier.close()
    return IdentifyResult(url, identity)
