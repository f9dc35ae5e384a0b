"""When the watchdog of an amplifier was fed, as far as its host can know; times [s] of a clock."""

import math
from dataclasses import dataclass

from drivers.protocol.table import REACTION

SILENCING = 0.005 + REACTION
"""From the expiry of a watchdog until the outputs are silent, at the most [s]."""


@dataclass
class Feeding:
    """What may have fed and what surely did, and the watchdog [s]; delay, is_kept: of the wire.

    may: when the last request that may have fed went out. plays: the last such that does not also
    silence it, arrives: when it arrives unless it is delayed: how long the amplifier may play
    follows from it. fade [s]: longest ramp since, of a silence without reply, a stop or a disarm.
    since, confirmed_at: when the last request that surely did went out, and its reply came.
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

    def sent(self, now: float, arrives: float) -> None:
        """Note a request that may feed and let it play on: when it was sent, and arrives [s]."""
        self.may = self.plays = now
        self.arrives = arrives
        self.fade = 0.0

    def unheard(self, ramp: float, now: float) -> None:
        """Note a silence along a ramp [s], sent at a time [s] to one that does not reply.

        If it is heard that is within the time of the watchdog, and the ramp follows: repeated for
        as long as there is no reply, it does not put off when the amplifier must be silent.
        """
        self.may = now
        self.fades(ramp)

    def fades(self, ramp: float) -> None:
        """Note that what plays may fade along a ramp [s] from when its watchdog has not passed."""
        self.fade = max(self.fade, ramp)

    def confirmed(self, sent_at: float, now: float) -> None:
        """Note at a time [s] the reply to a request that fed, sent at another [s]."""
        self.since, self.confirmed_at = sent_at, now
        if sent_at > self.plays:
            self.plays, self.fade = sent_at, 0.0

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
