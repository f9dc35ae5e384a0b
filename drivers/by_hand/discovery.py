"""What this machine can reach; only identify requests are sent, no output is driven."""

import asyncio
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from drivers.by_hand.places import Candidate, candidates, with_slcan
from drivers.by_hand.reaching import identified
from drivers.errors import DriverError, FrameError, LinkTimeout
from drivers.protocol.records import Values

Found = Mapping[str, Values | DriverError]
"""By URL the identity of the amplifier there, or what is wrong."""


async def identify_all(urls: Iterable[str]) -> Found:
    """Identify the amplifiers at these URLs, one after the other."""
    found: dict[str, Values | DriverError] = {}
    for url in urls:
        try:
            async with identified(url) as amplifier:
                found[url] = amplifier.identity
        except DriverError as problem:
            found[url] = problem
    return found


async def discover(
    urls: Sequence[str], *, probes: bool, slcan: bool
) -> tuple[dict[str, Any], dict[str, DriverError]]:
    """List ports, interfaces and the amplifiers on them; returns that, and problems by URL.

    urls: identified too; probes: every port is sent identify requests; slcan: CAN adapters on
    serial ports are detected.
    """
    places = [with_slcan(place) if slcan else place for place in candidates()]
    probed = [
        place.urls for place in places if probes and place.remedy is None and not place.is_slcan
    ]
    found = await identify_all(urls)
    # Of mute places each URL takes the time in which a board may start.
    for identified_there in await asyncio.gather(*map(identify_all, probed)):
        found = {**found, **identified_there}
    amplifiers = [
        {"url": url, **{name: identity[name] for name in ("vendor", "product", "serial_number")}}
        for url, identity in found.items()
        if not isinstance(identity, DriverError)
    ]
    rows = [_row(place, found) for place in places]
    problems = {url: who for url in urls if isinstance(who := found[url], DriverError)}
    return {"places": rows, "amplifiers": amplifiers}, problems


def _row(place: Candidate, found: Found) -> dict[str, Any]:
    replies = {url: found[url] for url in place.urls if url in found}
    unusable = (
        str(reply)
        for reply in replies.values()
        # Others were sent a request, and did not reply to it.
        if isinstance(reply, DriverError) and not isinstance(reply, LinkTimeout | FrameError)
    )
    return {
        "place": place.name,
        "description": place.description,
        "urls": list(place.urls),
        "heard": list(place.urls) if place.is_slcan else [],
        "answers": [url for url, who in replies.items() if not isinstance(who, DriverError)],
        "remedy": place.remedy or next(unusable, None),
    }
