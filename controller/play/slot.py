"""Slot: a content in a layer of the amplifiers, its phase, and when its next events are due."""

import math
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import Self

from controller.play.intent import Content
from controller.play.routing import Drive
from drivers.playing import AmplifierTone
from model.answer import answer

MIN_LEFT = 0.001
"""Shortest remaining time [s] of a pulse."""

CROSSFADE = 0.300
"""Time [s] of the raised cosines along which one content replaces another.

Fingers on nulls feel shorter ones.
"""

FALL_AFTER = 0.27 * CROSSFADE
"""Delay [s] after which the replaced content falls, so that its finger feels no dip."""

MIN_VALID_FOR = 2.0
"""Shortest time [s] until a vibration ends by itself on the amplifier.

It is renewed at half its time, so that neither a slow wire nor a rate limit of one set a second
interrupts it.
"""

_SURELY_SETTLED = 0.005  # s; covers the delay from a set's last reply to its start, and clocks


class SlotPhase(Enum):
    """The progress of a content in its layer."""

    STARTING = auto()
    """The amplifiers have not confirmed its first set."""
    PLAYING = auto()
    """The amplifiers play it; it gets its ending or the pieces of its course, and is renewed."""
    FALLING = auto()
    """Another content replaces it in a cross-fade: it falls, is not renewed, and ends."""
    ENDED = auto()
    """It was not renewed, or its time was over; nothing is due any more."""


@dataclass
class Slot:
    """A content in its layer. `replace` makes a copy that does not change.

    A time is infinite while its event is not due at all.
    """

    content: Content
    layer: answer.Layer
    """With the ramp, onset and ending of its sets."""
    gets_ending: bool = False
    """Whether a shaped ending is sent once its onset has ended; until then it ends along a ramp."""
    phase: SlotPhase = SlotPhase.STARTING
    drive: Drive = field(default_factory=dict)
    """Tones by ERA, as confirmed; empty while it starts, and once it has ended."""
    settled_at: float = math.inf
    """When [s] its onset has ended."""
    ending_due: float = math.inf
    """When [s] to send its ending."""
    piece_due: float = math.inf
    """When [s] to send the next piece of its course."""
    piece_until: float = -math.inf
    """When [s] the last piece that was sent ends."""
    fall_due: float = math.inf
    """When [s] to let it fall."""
    renewal_due: float = math.inf
    """When [s] to renew it, if all targets have been confirmed since its set was sent and a margin
    is left until it ends."""
    confirmed_until: float = math.inf
    """When [s] its first target would have been lifted, as known when its set was sent."""
    ends_at: float = math.inf
    """When [s] it ends by itself unless it is renewed."""

    @property
    def update_due(self) -> float:
        """When [s] to send its ending, its next piece or its fall."""
        return min(self.ending_due, self.piece_due, self.fall_due)

    @property
    def due(self) -> float:
        """When [s] its next event is due: an update, its renewal or its end."""
        return min(self.update_due, self.renewal_due, self.ends_at)

    @property
    def tones(self) -> Drive:
        """The tones that play now, by ERA, at frequencies not rounded by wire and amplifier."""
        tones = dict[str, AmplifierTone]()
        excitation = self.layer.excitation
        for name, driven in self.drive.items():
            if name in excitation:
                tones[name] = replace(driven, frequency=excitation[name].frequency)
        return tones

    def can_end_shaped(self, now: float) -> bool:
        """Whether it has its ending and has settled, so that the ending starts from its tones."""
        return bool(self.layer.ending) and now >= self.settled_at

    def falling(self, now: float) -> Self:
        """Return the slot as it is while another content replaces it from a time [s] on."""
        return replace(
            self,
            phase=SlotPhase.FALLING,
            fall_due=now + FALL_AFTER,
            ending_due=math.inf,
            piece_due=math.inf,
            renewal_due=math.inf,
        )

    def confirm_start(self, drive: Drive, now: float, *, valid_for: float) -> None:
        """Note that it plays, since its first set was committed before now [s]."""
        self.phase = SlotPhase.PLAYING
        self.drive = drive
        self.settled_at = now + settling_time(self.layer)
        ending_due = self.settled_at + _SURELY_SETTLED
        if self.gets_ending and ending_due < now + valid_for:
            self.ending_due = ending_due

    def confirm_piece(
        self, piece: answer.Layer, drive: Drive, now: float, *, starts_at: float
    ) -> None:
        """Note that a piece of its course plays from a time [s] on, and when the next one is due.

        The second piece is sent immediately, each later one when half of the previous one has been
        played.
        """
        is_first = self.phase is SlotPhase.STARTING
        if is_first:
            self.phase = SlotPhase.PLAYING
        self.drive = drive
        starts_at = max(starts_at, self.piece_until)
        self.piece_until = starts_at + settling_time(piece)
        if self.piece_until > self.content.pulses[0].end - MIN_LEFT:  # the last piece
            self.piece_due = math.inf
        elif not piece.onset:  # a ramp, which the next one follows
            self.piece_due = self.piece_until
        elif is_first:
            self.piece_due = now + MIN_LEFT
        else:
            self.piece_due = (starts_at + self.piece_until) / 2

    def confirm_update(self, layer: answer.Layer) -> None:
        """Note that the amplifiers have its ending, or its fall; layer: with the ending."""
        self.layer = replace(self.layer, ending=layer.ending)
        self.ending_due = math.inf
        self.fall_due = math.inf

    def confirm_validity(self, valid_for: float, now: float, *, confirmed_until: float) -> None:
        """Note when it ends by itself, as its last set was committed before now [s].

        A piece waits for the previous one, so call this before `confirm_piece`. A content that a
        ledger has shortened is not renewed, which would circumvent its limit.
        """
        self.renewal_due = math.inf
        if valid_for >= MIN_VALID_FOR:
            self.renewal_due = now + valid_for / 2
        self.confirmed_until = confirmed_until
        self.ends_at = max(now, self.piece_until) + valid_for

    def put_off(self, until: float, *, is_update: bool) -> None:
        """Note that its renewal or update was refused until a time [s].

        A refused ending is not sent again.
        """
        if not is_update:
            self.renewal_due = until
            return
        self.ending_due = math.inf
        if self.fall_due < math.inf:
            self.fall_due = until
        if self.content.course is not None:
            self.piece_due = until

    def end(self) -> None:
        """Note that it has ended by itself."""
        self.phase = SlotPhase.ENDED
        self.drive = {}
        self.ending_due = math.inf
        self.piece_due = math.inf
        self.renewal_due = math.inf
        self.ends_at = math.inf


def settling_time(layer: answer.Layer) -> float:
    """Return how long [s] after the commit the ramp or onset of a layer has ended."""
    if not layer.onset:
        return layer.ramp
    envelope = next(iter(layer.onset.values()))
    return max(layer.ramp, envelope.duration)
