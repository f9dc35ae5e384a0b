"""How long a vibration lasts by itself on the amplifiers, and when it is renewed.

It ends if the host or a touch source falls silent, so it is renewed only while sources confirm the
contacts that it is for.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from controller.loop.intent import Pulse, Target
from controller.sources.contacts import MAX_CONTACT_TIMEOUT, Contact

# Shortest time [s] until a vibration ends by itself on the amplifier, so that a slow wire or a rate
# limit of one set a second does not interrupt it. It is renewed at half its time.
_MIN_VALID_FOR = 2.0
_MARGIN = 0.2  # s; after the contact is lifted, for late frames
_MIN_LEFT = 0.001  # s; of a pulse that is about to end

Targets = Sequence[tuple[Contact, Target]]


@dataclass(frozen=True)
class Validity:
    """When a vibration may be renewed [s].

    confirmed_until: when its first target would have been lifted, as known when it was sent;
    renewal_due, renewable_until: between these it is renewed if all targets have been confirmed
    since. ends_at: when it has ended by itself unless it was renewed.
    """

    confirmed_until: float = math.inf
    renewal_due: float = math.inf
    renewable_until: float = math.inf
    ends_at: float = math.inf

    @classmethod
    def started(cls, valid_for: float, *, confirmed_until: float, now: float) -> "Validity":
        """Return the validity of sets committed by now that last `valid_for` [s].

        What a guard has shortened is not renewed, since that would circumvent its limit.
        """
        is_shortened = valid_for < _MIN_VALID_FOR
        return cls(
            confirmed_until=confirmed_until,
            renewal_due=math.inf if is_shortened else now + valid_for / 2,
            renewable_until=now + valid_for - _MARGIN / 2,
            ends_at=now + valid_for,
        )

    def is_renewal_due(self, now: float, *, confirmed_until: float) -> bool:
        """Whether to renew at a time [s], with targets that are confirmed until another."""
        is_due = self.renewal_due <= now < self.renewable_until
        return is_due and confirmed_until > self.confirmed_until


def valid_for(targets: Targets, *, confirmed_until: float, now: float) -> float:
    """Return for how long [s] the vibration of targets at a time [s] may last by itself.

    The amplifiers end a pulse; the last one, where several play.
    """
    unlimited = min(max(confirmed_until - now + _MARGIN, _MIN_VALID_FOR), MAX_CONTACT_TIMEOUT)
    return min(unlimited, max(_all_left(targets, now), default=math.inf))


def first_lasts(targets: Targets, now: float) -> float:
    """Return how long [s] from a time [s] the first pulse lasts; infinite without any."""
    return min(_all_left(targets, now), default=math.inf)


def _all_left(targets: Targets, now: float) -> list[float]:
    """Return how long [s] each target is driven from a time [s]."""
    return [_left(target.pulse, now) for _, target in targets]


def _left(pulse: Pulse | None, now: float) -> float:
    """Return how long [s] a pulse lasts from a time [s]; infinite for none."""
    if pulse is None:
        return math.inf
    if pulse.started_at is None:
        return pulse.duration
    return max(pulse.end - now, _MIN_LEFT)
