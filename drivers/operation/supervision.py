"""Coming back after a loss: the same amplifier, identified again, and disarmed.

Nothing here arms anything. Until an amplifier that was lost has been silent for its watchdog time,
`assume_energised` says that it may still play.
"""

import asyncio
import logging
from collections.abc import Callable, Iterator

from drivers.amplifier import Amplifier
from drivers.errors import LinkError
from drivers.protocol.messages import State

FIRST_PAUSE = 0.1  # s; a cable that was only knocked is back by then
LONGEST_PAUSE = 5.0  # s; nobody waits longer for an adapter that was plugged in again
_MARGIN = 0.1  # s; beyond the watchdog, for the clocks and the last ramp

_logger = logging.getLogger(__name__)


def pauses(first: float = FIRST_PAUSE, longest: float = LONGEST_PAUSE) -> Iterator[float]:
    """Pauses [s] between attempts, each twice the one before."""
    pause = first
    while True:
        yield pause
        pause = min(2 * pause, longest)


def assume_energised(lost_at: float, now: float, *, watchdog: float) -> bool:
    """Whether an amplifier that was lost at a time [s] may still be playing now [s]."""
    return now - lost_at < watchdog + _MARGIN


async def reopen(
    amplifier: Amplifier,
    *,
    waits: Iterator[float] | None = None,
    on_failure: Callable[[LinkError], None] | None = None,
) -> int:
    """Open a lost amplifier again, however long that takes; it is disarmed then.

    waits: pauses [s] between attempts, growing unless given; when they run out the last LinkError
    is raised. on_failure is told of every attempt that failed. Another serial number than before is
    such a failure. Returns how many attempts it took. Ended by cancelling.
    """
    attempt = 0
    waits = pauses() if waits is None else waits
    while True:
        attempt += 1
        try:
            await amplifier.close()
            await amplifier.open()
            if (await amplifier.status()).state is State.OPERATION_ENABLED:
                await amplifier.disarm()  # it was lost for less than its watchdog
        except LinkError as problem:
            _logger.info("attempt %d to reopen an amplifier: %s", attempt, problem)
            if on_failure is not None:
                on_failure(problem)
            pause = next(waits, None)
            if pause is None:
                raise
        else:
            return attempt
        await asyncio.sleep(pause)
