"""Silence of an amplifier after a stop: confirmed, or how long it may still play.

Confirmed silent means that a Status read after the Stop was sent reports the levels of all channels
as zero, in a state in which Arm is refused until Clear, under a latch newer than every one seen
before the Stop was sent: one that is not may be an old Status, kept by a converter on the way. In
another state a late Clear has come after the Stop, and a late Arm might follow: the Stop is
repeated, also after the first Status of an amplifier of which nothing was read before. Everything
else is unconfirmed: the amplifier may play until its watchdog expires, which only bounds the time
while nothing feeds it.
"""

import asyncio
import logging
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum

from drivers import clock
from drivers.amplifier import STOP_RAMP, WATCHDOG_REACTION, Amplifier
from drivers.protocol.definition import is_newer_latch
from drivers.protocol.messages import AmplifierState, Status

CONFIRM_TIMEOUT = 0.3  # s; three replies of the slowest wire

_INTERVAL = 0.005  # s; between attempts, in addition to the ramp

_LATCHED = (
    AmplifierState.QUICK_STOP_ACTIVE,
    AmplifierState.FAULT_REACTION_ACTIVE,
    AmplifierState.FAULT,
)

_logger = logging.getLogger(__name__)


class SilenceStatus(StrEnum):
    """Whether an amplifier is silent; MAY_PLAY: until its watchdog expires, if it has one."""

    CONFIRMED = "confirmed_silent"
    MAY_PLAY = "may_play"
    WATCHDOG_ELAPSED = "watchdog_elapsed"


@dataclass(frozen=True, slots=True)
class StopOutcome:
    """Outcome of a stop on one amplifier.

    may_play_until [s]: by the event loop's clock, for MAY_PLAY; None if no watchdog ends it.
    cause: why silence is not confirmed; empty if it is.
    """

    silence: SilenceStatus
    may_play_until: float | None = None
    cause: str = ""

    @property
    def is_confirmed(self) -> bool:
        """Whether silence is confirmed."""
        return self.silence is SilenceStatus.CONFIRMED

    def to_json(self, now: float) -> dict[str, str | float | None]:
        """Return the outcome as JSON at a time [s], with the time left that it may play."""
        until = self.may_play_until
        return {
            "silence": self.silence.value,
            "may_play_for_s": None if until is None else round(max(0.0, until - now), 3),
            "cause": self.cause,
        }


def is_silent(status: Status) -> bool:
    """Whether an amplifier reports that nothing plays, and nothing can before it is armed."""
    return status.state is not AmplifierState.OPERATION_ENABLED and not any(status.levels)


def is_latched(status: Status, latch_before: int | None) -> bool:
    """Whether a status shows that a Stop has been carried out, and not been cleared since.

    latch_before: the newest latch seen before the Stop was sent; without one no status shows it.
    """
    is_new = latch_before is not None and is_newer_latch(status.latch, latch_before)
    return is_new and status.state in _LATCHED


def is_stopped(status: Status, latch_before: int | None) -> bool:
    """Whether an amplifier is silent and stays so until it is cleared, whatever else reaches it."""
    return is_latched(status, latch_before) and not any(status.levels)


def stop_outcome(
    status: Status | None,
    *,
    latch_before: int | None,
    last_fed_at: float | None,
    watchdog: float | None,
    now: float,
    cause: str = "",
) -> StopOutcome:
    """Derive the outcome of a stop at a time [s].

    status: read after the Stop was sent, or None; latch_before: see `is_latched`; last_fed_at [s]:
    when a request that feeds the watchdog may have reached the amplifier for the last time, None if
    unknown; watchdog [s]: None without one; cause: why there is no status.
    """
    if status is not None:
        if is_stopped(status, latch_before):
            return StopOutcome(SilenceStatus.CONFIRMED)
        cause = (
            f"status after the stop: state {status.state.name}, highest level "
            f"{max(status.levels, default=0.0):g}, latch {status.latch}"
        ) + ("" if latch_before is None else f" (must be newer than {latch_before})")
    cause = cause or "no status was read after the stop"
    if watchdog is None:
        return StopOutcome(
            SilenceStatus.MAY_PLAY, None, f"{cause}; no watchdog is known to end it: switch it off"
        )
    if last_fed_at is None:
        return StopOutcome(
            SilenceStatus.MAY_PLAY, None, f"{cause}; it is unknown when its watchdog was fed last"
        )
    until = last_fed_at + watchdog + WATCHDOG_REACTION
    if now < until:
        return StopOutcome(SilenceStatus.MAY_PLAY, until, cause)
    if status is not None:  # something else feeds it
        return StopOutcome(
            SilenceStatus.MAY_PLAY, None, f"{cause}; its watchdog has not ended it: switch it off"
        )
    return StopOutcome(SilenceStatus.WATCHDOG_ELAPSED, None, cause)


async def stop_and_confirm(
    amplifier: Amplifier,
    *,
    ramp: float = STOP_RAMP,
    timeout: float = CONFIRM_TIMEOUT,
    requested: asyncio.Event | None = None,
) -> StopOutcome:
    """Stop an amplifier along a ramp [s] until its silence is confirmed, for at most a time [s].

    Every failure becomes the cause of the outcome. A Stop without a confirming reply is repeated,
    also on a lost link, as long as its wire is open. requested: set by a further request for a
    stop, which is sent at once; cleared here.
    """
    requested = requested or asyncio.Event()
    status, latch_before, cause = None, None, ""
    try:
        async with asyncio.timeout(timeout):
            while True:
                may_read = (
                    status is not None
                    and is_latched(status, latch_before)
                    and not (amplifier.is_lost or requested.is_set())
                )
                status = None
                requested.clear()
                try:
                    if may_read:
                        status = await amplifier.status()
                    else:
                        latch_before = amplifier.latch
                        status = await amplifier.stop(ramp)
                    if not amplifier.is_identified:  # its channels are unknown
                        status = None
                        await amplifier.identify()
                        continue
                except Exception as error:
                    _logger.debug("stop: not confirmed: %s", error)
                    cause = str(error) or type(error).__name__
                if status is not None and is_stopped(status, latch_before):
                    break
                with suppress(TimeoutError):
                    await asyncio.wait_for(requested.wait(), ramp + _INTERVAL)
    except TimeoutError:
        cause = cause or f"silence was not reported within {timeout:g} s"
    return stop_outcome(
        status,
        latch_before=latch_before,
        last_fed_at=amplifier.last_fed_at,
        watchdog=amplifier.watchdog,
        now=clock.now(),
        cause=cause,
    )
