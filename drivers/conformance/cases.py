"""Cases of one check, each of which is tried again by itself."""

from collections.abc import Awaitable, Callable

from drivers.conformance.bench import Bench
from drivers.conformance.findings import Inconclusive

_TRIES = 3


async def settle(bench: Bench, case: Callable[[], Awaitable[None]]) -> None:
    """Run a case on an amplifier, again if what was seen did not suffice; bring it to rest.

    So that a delay in one case of a check costs no other. Raises Inconclusive after the last try.
    """
    for left in range(_TRIES - 1, -1, -1):
        try:
            await case()
            break
        except Inconclusive:
            if not left:
                raise
        await bench.rest()
    await bench.rest()
