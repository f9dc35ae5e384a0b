"""The watchdog of an amplifier: when it was fed, and when it must have silenced the amplifier.

All times [s] refer to one arbitrary clock.
"""

import math
from dataclasses import dataclass

from drivers.protocol.definition import REACTION

SILENCING_TIME = 0.005 + REACTION
"""Longest time from the expiry of a watchdog until the outputs are silent [s]."""


@dataclass
class Feeding:
    """When the watchdog of an amplifier was fed: by requests that may have, and that surely have.

    Times are in s.
    """

    delay: float = 0.0
    """How late a request may arrive on the wire."""
    is_kept: bool = False
    """Whether an adapter on the wire may keep requests and deliver them later."""
    watchdog: float = 0.0
    """Time of the watchdog."""
    maybe_fed_at: float = -math.inf
    """When the last request that may have fed the watchdog went out."""
    kept_playing_at: float = -math.inf
    """When the last such request went out that does not also silence the amplifier."""
    arrives_at: float = -math.inf
    """When that request arrives, unless it is delayed."""
    fade: float = 0.0
    """Longest ramp of a stop, a disarm or an unanswered silence since then."""
    fed_at: float = -math.inf
    """When the last request that surely fed the watchdog went out."""
    confirmed_at: float = -math.inf
    """When the reply to that request came."""

    def note_sent(self, now: float, arrives: float) -> None:
        """Note a request that feeds the watchdog and lets playback continue, sent now."""
        self.maybe_fed_at = now
        self.kept_playing_at = now
        self.arrives_at = arrives
        self.fade = 0.0

    def note_repeated_silence(self, now: float, ramp: float) -> None:
        """Note a silence that is sent now although earlier requests had no reply; ramp [s].

        It does not put off when the amplifier must be silent: if it arrives, it does so within the
        time of the watchdog, and its ramp follows.
        """
        self.maybe_fed_at = now
        self.note_ramp(ramp)

    def note_ramp(self, ramp: float) -> None:
        """Note a request along whose ramp [s] the amplifier may still play."""
        self.fade = max(self.fade, ramp)

    def note_reply(self, sent_at: float, now: float) -> None:
        """Note a reply, received now, to a request that has surely fed the watchdog."""
        self.fed_at = sent_at
        self.confirmed_at = now
        if sent_at > self.kept_playing_at:
            self.kept_playing_at = sent_at
            self.fade = 0.0

    @property
    def lost_from(self) -> float:
        """Time [s] when a mute amplifier must be silent due to its watchdog, and is lost.

        A request without reply may still be under way. A request with a reply arrived before that
        reply, but possibly later than the line takes, because a busy machine may have delayed it.
        """
        is_confirmed = self.kept_playing_at <= self.fed_at
        arrival = self.confirmed_at if is_confirmed else self.arrives_at + self.delay
        return arrival + self.watchdog + self.fade + SILENCING_TIME

    @property
    def may_play_until(self) -> float:
        """Time [s] when the watchdog must have silenced it, even after a buffered request.

        An adapter may deliver buffered requests at any time; after the watchdog has expired, they
        have no effect. Of several attempts without reply, one may have arrived and the next one may
        be buffered.
        """
        may_be_fed_again = self.is_kept and self.kept_playing_at > self.fed_at
        return self.lost_from + (self.watchdog if may_be_fed_again else 0.0)

    def is_shown_by(self, sent_at: float) -> bool:
        """Whether a status requested at a time [s] shows if the watchdog is running down."""
        return self.maybe_fed_at <= self.fed_at and sent_at - self.confirmed_at > REACTION

    def problem(self, left: float, sent_at: float, now: float) -> str | None:
        """Describe an impossible remaining watchdog time [s] in a status; None if it is possible.

        sent_at: when the request for the status went out, which does not feed; now: when the status
        came.
        """
        lowest = self.watchdog - (now - self.fed_at) - REACTION
        # An unconfirmed request that may have fed may have arrived just before this one.
        last_fed_at = self.confirmed_at if self.maybe_fed_at <= self.fed_at else sent_at
        highest = min(self.watchdog, self.watchdog - (sent_at - last_fed_at)) + REACTION
        if lowest <= left <= highest:
            return None
        return f"watchdog left must be {max(lowest, 0):.3f} to {highest:.3f} s, got {left:.3f} s"
