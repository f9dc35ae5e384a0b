"""When the watchdog of an amplifier was fed, as far as its host can know; times [s] of a clock."""

import math
from dataclasses import dataclass

from drivers.protocol.table import REACTION

SILENCING = 0.005 + REACTION
"""From the expiry of a watchdog until the outputs are silent, at the most [s]."""


@dataclass
class Feeding:
    """What may have fed and what surely did, and the watchdog [s]; delay [s]: of the line.

    may: when the last request that may have fed went out: how long the amplifier may play follows
    from it. since, confirmed_at: when the last request that surely did went out, and its reply
    came.
    """

    delay: float = 0.0
    watchdog: float = 0.0
    may: float = -math.inf
    since: float = -math.inf
    confirmed_at: float = -math.inf

    @property
    def latest(self) -> float:
        """When the watchdog may have been fed last [s].

        A request without reply may still be under way; what is confirmed has arrived.
        """
        latest = self.may + self.delay
        return min(latest, self.confirmed_at) if self.may <= self.since else latest

    @property
    def may_play_until(self) -> float:
        """When the watchdog must have silenced the amplifier [s]."""
        return self.latest + self.watchdog + SILENCING

    def problem(self, left: float, sent_at: float, now: float) -> str | None:
        """Describe an impossible time that is left [s] in a reply to a request; None if possible.

        sent_at: of the request, which is not one that feeds; now: of the reply.
        """
        lowest = self.watchdog - (now - self.since) - REACTION
        highest = min(self.watchdog, self.watchdog - (sent_at - self.latest)) + REACTION
        if lowest <= left <= highest:
            return None
        return f"watchdog left must be {max(lowest, 0):.3f} to {highest:.3f} s, got {left:.3f} s"
