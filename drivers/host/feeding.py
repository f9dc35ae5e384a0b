"""Until when an amplifier may play: when its watchdog was fed, and what confirms its silence."""

import math
from dataclasses import dataclass
from typing import Any

from drivers.protocol.definition import REACTION

SILENCING = 0.005 + REACTION
"""From the expiry of a watchdog until the outputs are silent, at the most [s]."""


@dataclass
class Feeding:
    """When its watchdog was fed, as far as the host knows: what may have, and what surely did.

    delay, is_kept: of the wire; watchdog [s]. may: when [s] the last request that may have fed went
    out. plays: the last such that does not also silence it, arrives: when it arrives unless it is
    delayed: how long the amplifier may play follows from it. fade [s]: longest ramp since, of a
    silence without reply, a stop or a disarm. since, confirmed_at: when the last request that
    surely did went out, and its reply came.
    """

    delay: float = 0.0
    is_kept: bool = False
    watchdog: float = 0.0
    may: float = -math.inf
    plays: float = -math.inf
    arrives: float = -math.inf
    fade: float = 0.0
    since: float = -math.inf
    confirmed_at: float = -math.inf

    @property
    def lost_from(self) -> float:
        """When the watchdog has silenced it, and one that does not reply is lost [s].

        A request without reply may still be under way; what is confirmed came before its reply, and
        not always in the time of the line: a busy machine may have kept it.
        """
        is_confirmed = self.plays <= self.since
        arrival = self.confirmed_at if is_confirmed else self.arrives + self.delay
        return arrival + self.watchdog + self.fade + SILENCING

    @property
    def may_play_until(self) -> float:
        """When the watchdog must have silenced it, even where it is fed once more [s].

        What an adapter has kept comes at any time, all at once: after the watchdog without effect.
        Of several attempts without reply one may have arrived, and the next been kept.
        """
        may_be_fed_again = self.is_kept and self.plays > self.since
        return self.lost_from + (self.watchdog if may_be_fed_again else 0.0)

    def tells(self, sent_at: float) -> bool:
        """Whether a status asked for at a time [s] would show a watchdog that stands still."""
        return self.may <= self.since and sent_at - self.confirmed_at > REACTION

    def problem(self, left: float, sent_at: float, now: float) -> str | None:
        """Describe an impossible time that is left [s] in a reply to a request; None if possible.

        sent_at: of the request, which is not one that feeds; now: of the reply.
        """
        lowest = self.watchdog - (now - self.since) - REACTION
        # One that may have fed and was not confirmed may have come just before this request.
        fed_at = self.confirmed_at if self.may <= self.since else sent_at
        highest = min(self.watchdog, self.watchdog - (sent_at - fed_at)) + REACTION
        if lowest <= left <= highest:
            return None
        return f"watchdog left must be {max(lowest, 0):.3f} to {highest:.3f} s, got {left:.3f} s"


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
