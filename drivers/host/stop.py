"""One stop of one amplifier: its request goes out first, then its silence is confirmed.

Here alone is known what an amplifier may still play, for whoever stops it or asks for its status.
"""

import asyncio
import contextlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from drivers.host.jobs import Priority
from drivers.protocol.records import Values
from drivers.protocol.sets import is_newer_token
from drivers.protocol.table import ENABLED, LATCHED, QUANTITIES
from drivers.protocol.timing import ATTEMPTS
from registry import clock

if TYPE_CHECKING:
    from drivers.host.amplifier import Amplifier

_INTERVAL = 0.005  # s; between attempts to stop, in addition to the ramp
_RAMP = QUANTITIES["ramp"]


@dataclass(frozen=True, slots=True)
class Stopped:
    """What an amplifier may play: confirmed silent, or until when [s] it may play, and why.

    may_play_until: infinite where nothing is known to silence it.
    """

    is_confirmed: bool
    may_play_until: float
    cause: str = ""

    def rows(self, now: float) -> dict[str, Any]:
        """Return it in words at a time [s]: `silence`, `may_play_for_s` and `cause`."""
        left = self.may_play_until - now
        silence = "may_play" if left > 0 else "watchdog_elapsed"
        is_bounded = not self.is_confirmed and left < math.inf
        return {
            "silence": "confirmed_silent" if self.is_confirmed else silence,
            "may_play_for_s": round(max(left, 0.0), 3) if is_bounded else None,
            "cause": self.cause,
        }


UNREACHED = Stopped(False, math.inf, "it has not replied since the start")
"""What is known of an amplifier before its first reply."""


def what_may_play(amplifier: "Amplifier", cause: str = "") -> Stopped:
    """Return until when an amplifier may play by all that is known of it.

    cause: why no more is known, by default what ails its line. Over is what confirmed a stop, and
    was sent neither Clear nor Arm since. Else the watchdog ends what was fed, and what was never
    fed is over once it has shown that it is silent. One that shows more after it was confirmed, or
    its watchdog must have silenced it, is fed by another, or broken. A status after the stop alone
    confirms it.
    """
    known, status, at = amplifier.known, amplifier.status, amplifier.status_at
    cause = cause or amplifier.line.loss or amplifier.silence_cause or ""
    until = known.may_play_until
    if not known.is_confirmed:
        until = max(until, amplifier.feeding.may_play_until)
    if status is not None and at is not None:
        is_armed = status["state"] == ENABLED
        if amplifier.is_silent(status) and not is_armed:  # and identified
            until = at if until == math.inf else max(until, at)
        elif (is_armed or any(status["levels"])) and at >= until:
            until = math.inf
    return Stopped(False, math.inf if until == -math.inf else until, cause)


class Stop:
    """A stop along a ramp [s], begun when it is made; the first request is queued by then.

    Repeated until it is confirmed, or for a time [s] from when the first request goes out.
    Confirmed by a status in a latched state whose latch is newer than every one seen before, with
    the levels of all channels at zero: another one may be old, kept on its way.
    """

    def __init__(self, amplifier: "Amplifier", ramp: float, timeout: float) -> None:
        self.is_sent = False
        """Whether its first request has gone out: what comes later needs a stop of its own."""
        self._amplifier = amplifier
        self._values = {"ramp": amplifier.wire_ramp(ramp)}
        self._latch: int | None = None
        self._limit: asyncio.Timeout | None = None
        self._first: asyncio.Future[Values] | None = None
        members = len(amplifier.line.members)
        # On a line that others share each has three exchanges: a stop and two statuses.
        exchanges = ATTEMPTS * members * amplifier.exchange_time("GetStatus")
        self._timeout = timeout + ramp + exchanges
        self._ends = clock.now() + self._timeout * (members + 1)  # on a line that others keep busy
        self.result = asyncio.ensure_future(self._confirm())
        with contextlib.suppress(Exception):  # then it is requested in `_confirm`
            self._first = self._request()

    def _request(self) -> "asyncio.Future[Values]":
        amplifier = self._amplifier
        self._latch = amplifier.latch
        return amplifier.line.submit(
            amplifier, Priority.STOP, "Stop", self._values, make=self._sent
        )

    def _sent(self) -> Values:
        """Return the values of the request, which goes out now."""
        if not self.is_sent:
            self.is_sent = True
            self._ends = clock.now() + self._timeout
            if self._limit is not None:
                self._limit.reschedule(self._ends)
        return self._values

    async def _confirm(self) -> Stopped:
        amplifier, cause = self._amplifier, ""
        pause = _RAMP.from_wire(self._values["ramp"]) + _INTERVAL
        try:
            async with asyncio.timeout_at(self._ends) as self._limit:
                while amplifier.line.loss is None:
                    try:
                        stopping, self._first = self._first or self._request(), None
                        status = await stopping
                        while is_stopping(status, self._latch):
                            if amplifier.is_silent(status):
                                amplifier.known = Stopped(True, clock.now())
                                return amplifier.known
                            await asyncio.sleep(_INTERVAL)
                            status = await amplifier.line.submit(
                                amplifier, Priority.STOP, "GetStatus", {}
                            )
                    except Exception as error:  # whatever it is, the stop goes on
                        cause = str(error) or type(error).__name__
                    await asyncio.sleep(pause)
        except TimeoutError:
            cause = cause or f"silence was not reported within {self._timeout:g} s"
        return what_may_play(amplifier, amplifier.line.loss or cause)


def is_stopping(status: Values, before: int | None) -> bool:
    """Whether a status shows that a stop was carried out since a latch was the newest."""
    if before is None or status["state"] not in LATCHED:
        return False
    return status["latch"] > 0 and is_newer_token(status["latch"], before)
