"""When the watchdog of an amplifier was fed, as far as its host can know; times [s] of a clock."""

import math
from dataclasses import dataclass

from drivers.protocol.table import REACTION

SILENCING = 0.005 + REACTION
"""From the expiry of a watchdog until the outputs are silent, at the most [s]."""


@dataclass
class Feeding:
    """Two times: the last that may have fed, and the last that surely did, and the watchdog [s].

    may: an upper bound of what is left follows from it, and how long the amplifier may play; since:
    when the last request went out that was confirmed.
    """

    watchdog: float = 0.0
    may: float = -math.inf
    since: float = -math.inf

    @property
    def may_play_until(self) -> float:
        """When the watchdog must have silenced the amplifier [s]."""
        return self.may + self.watchdog + SILENCING

    def problem(self, left: float, sent_at: float, now: float) -> str | None:
        """Describe an impossible time that is left [s] in a reply to a request; None if possible.

        sent_at: of the request, which is not one that feeds; now: of the reply.
        """
        lowest = self.watchdog - (now - self.since) - REACTION
        highest = min(self.watchdog, self.watchdog - (sent_at - self.may)) + REACTION
        if lowest <= left <= highest:
            return None
        return f"watchdog left must be {max(lowest, 0):.3f} to {highest:.3f} s, got {left:.3f} s"
