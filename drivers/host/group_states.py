"""The states of a group of amplifiers, its failures, and the table of reactions to them.

Only `Group` changes its state. A dash means that the state stays the same:

              open      arm    disarm    stop     clear     close   loss
    CLOSED    DISARMED  error  -         -        -         -       -
    DISARMED  -         ARMED  -         STOPPED  -         CLOSED  LOST
    STOPPED   -         error  -         -        DISARMED  CLOSED  LOST
    ARMED     -         -      DISARMED  STOPPED  -         CLOSED  LOST
    LOST      DISARMED  error  -         -        -         CLOSED  -

If a stop comes while amplifiers are opened, they are STOPPED once open.

The state does not follow from the amplifiers' statuses, because a stop must end playback before any
reply. It does not follow from the daemon's state, because the control loop stops amplifiers before
the daemon is notified, and programs without a daemon drive amplifiers too. Nor can it replace the
daemon's state, which is kept while all lines are closed. docs/architecture.md shows which states of
the daemon and the group belong together.

`Group` classifies an error as a `Failure` once, and then follows `REACTIONS`.
"""

from collections.abc import Mapping
from enum import Enum, auto
from typing import NamedTuple

from drivers.errors import DriverError, LinkDegraded, Preempted


class GroupState(Enum):
    """State of all amplifiers together."""

    CLOSED = auto()
    """Not opened yet, or closed again."""
    DISARMED = auto()
    STOPPED = auto()
    """Disarmed by a stop, which must be cleared before they can be armed."""
    ARMED = auto()
    """The only state in which anything is played or fed."""
    LOST = auto()
    """A LinkError has shown that an amplifier is lost."""


class Failure(Enum):
    """Why a set or another exchange of the control loop has failed."""

    REFUSED = auto()
    """A ledger refused the set before any amplifier played it."""
    OVERTAKEN = auto()
    """Something more urgent came before any amplifier played the set."""
    SILENCED = auto()
    """A request of the set was too late to be repeated, so all layers were silenced."""
    ABORTED = auto()
    """The control loop ended the exchange, because it sends silence next."""
    PREEMPTED = auto()
    """A stop, disarm or close came first."""
    DEGRADED = auto()
    """An amplifier does not reply, but may play its last set until its watchdog has expired."""
    LOST = auto()
    """An amplifier cannot be reached, or its watchdog has expired without a reply."""
    FAULT = auto()
    """Anything else: it is unknown which amplifiers play what."""


class Reaction(NamedTuple):
    """The reaction of a group to a failure."""

    stops: bool
    """Whether all amplifiers are stopped."""
    is_loss: bool = False
    """Whether the group enters the state LOST; otherwise only a stop changes its state."""
    error: type[DriverError] | None = None
    """Class of the error that the control loop receives; None: the original error."""
    message: str | None = None
    """Message of that error; None: the original message."""


REACTIONS: Mapping[Failure, Reaction] = {
    # The last set continues, and the control loop plans the next one.
    Failure.REFUSED: Reaction(stops=False),
    Failure.OVERTAKEN: Reaction(stops=False),
    # The amplifiers stay armed. The control loop plans from silence, or sends silence next.
    Failure.SILENCED: Reaction(stops=False, error=Preempted),
    Failure.ABORTED: Reaction(
        stops=False, error=Preempted, message="given up, since silence comes first"
    ),
    # The stop, disarm or close has set the state.
    Failure.PREEMPTED: Reaction(
        stops=False, error=Preempted, message="a stop or disarm came first"
    ),
    # Nothing new starts. The other amplifiers are fed, and play their last set.
    Failure.DEGRADED: Reaction(stops=False, error=LinkDegraded),
    Failure.LOST: Reaction(stops=True, is_loss=True),
    Failure.FAULT: Reaction(stops=True),
}
"""What follows each failure. The daemon then enters COMM_LOST after LOST, and FAULT after FAULT."""
