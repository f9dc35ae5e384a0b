"""Layers of the amplifiers: the content in each one (its slot), and the layer for a new content.

A content keeps its layer while it plays. A content that changes takes the layer of its finger; one
that replaces a content of another frequency needs a second layer, in which it rises while the
former content falls (a cross-fade).
"""

import math
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import Self

from controller.play.intent import CLICK
from controller.play.routing import Drive
from controller.play.selected_contents import Content, ContentKey
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

STRENGTH_FADE = 0.100
"""Time [s] of the raised cosine along which a content changes its strength."""

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


class LayerAllocation:
    """The slots of all layers, by number; count: number of layers of the amplifiers."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.slots: Mapping[int, Slot] = {}
        """Slots by layer; empty while the playback is unknown."""
        self.may_play: frozenset[int] = frozenset()
        """Layers that may play; empty once all are silent for certain."""
        self._layer_of: Mapping[ContentKey, int] = {}
        """Layers by finger and voice, also while the playback is unknown."""

    def limit_to(self, count: int) -> None:
        """Use this number of layers from now on; fingers of other layers get a new one."""
        self.count = count
        layers = self._layer_of.items()
        self._layer_of = {key: layer for key, layer in layers if layer < count}

    def allocate(self, contents: Sequence[Content]) -> dict[int, Content]:
        """Return contents by layer: a content's present layer, its finger's, a free or ending one.

        A content that replaces one of another frequency gets a free layer. So does a short pulse if
        possible, since a content that ends in its layer would fade along its short ramp. Contents
        for which no layer is left are missing.
        """
        allocated = dict[int, Content]()
        for number, slot in self.slots.items():
            if slot.content in contents:  # an equal content, whose sensations may differ
                allocated[number] = contents[contents.index(slot.content)]
        continuing = [*allocated.values()]
        without_layer = list[Content]()
        for content in contents:
            if content in continuing:
                continue
            layer = self._layer_of.get(content.key)
            if self._needs_second_layer(content):
                free_layers = self._free_layers(allocated)
                if free_layers:
                    layer = free_layers[0]
            if layer is None:
                without_layer.append(content)
            else:
                allocated[layer] = content
        self._allocate_others(without_layer, allocated)
        return allocated

    def _allocate_others(self, contents: Sequence[Content], allocated: dict[int, Content]) -> None:
        """Add contents whose fingers have no layer to contents by layer, as long as layers last."""
        free = self._free_layers(allocated)
        leaving = sorted(self.may_play - allocated.keys())
        falling = [number for number in leaving if self._is_falling(number)]
        ending = [number for number in leaving if number not in falling]
        for content in contents:
            is_click = content.key.voice == CLICK
            preference = (free, ending, falling) if is_click else (ending, free, falling)
            for layers in preference:
                if layers:
                    allocated[layers.pop(0)] = content
                    break

    def _is_falling(self, number: int) -> bool:
        """Whether the content of a layer is being replaced in a cross-fade."""
        return number in self.slots and self.slots[number].phase is SlotPhase.FALLING

    def _free_layers(self, allocated: Collection[int]) -> list[int]:
        """Return the layers that do not play and are not allocated."""
        used = self.may_play.union(allocated)
        return [number for number in range(self.count) if number not in used]

    def can_crossfade_to(self, contents: Sequence[Content]) -> bool:
        """Whether each content replaces one that plays, and layers are free to cross-fade all."""
        playing_keys = {slot.content.key for slot in self.slots.values()}
        if not playing_keys.issuperset([content.key for content in contents]):
            return False
        second_layers = [content for content in contents if self._needs_second_layer(content)]
        return len(self.may_play) + len(second_layers) <= self.count

    def fade_time(self, number: int, content: Content) -> float:
        """Return the time [s] in which a content replaces another; 0 if it starts from silence."""
        slot = self.slots.get(number)
        if slot is not None and not _is_one_voice(slot.content, content):
            return 0.0
        if slot is not None and slot.content.gain_db != content.gain_db:
            return STRENGTH_FADE
        if self._replaced_by(content) is not None:
            return CROSSFADE
        return 0.0

    def falling_slot(self, number: int, contents: Sequence[Content], now: float) -> Slot | None:
        """Return a layer's slot while one of these contents replaces it; None if it just ends."""
        slot = self.slots.get(number)
        if slot is None:
            return None
        for content in contents:
            is_successor = content.is_led and content.key == slot.content.key
            if is_successor and slot.phase is SlotPhase.FALLING:
                return slot
            if self._replaced_by(content) is slot:
                return slot.falling(now)
        return None

    def _replaced_by(self, content: Content) -> Slot | None:
        """Return the slot that a content replaces in a cross-fade, if any."""
        number = self._layer_of.get(content.key)
        if number is None or not content.is_led:
            return None
        slot = self.slots.get(number)
        if slot is None or slot.content == content or slot.content.target.is_short:
            return None
        return slot

    def _needs_second_layer(self, content: Content) -> bool:
        """Whether a content replaces one of another frequency, so that both sound for a while."""
        slot = self._replaced_by(content)
        return slot is not None and slot.content.frequency != content.frequency

    def take(self, slots: Mapping[int, Slot], started: Set[int]) -> None:
        """Take slots as the playback from now on; started: layers that start another content."""
        self.slots = slots
        self.may_play |= started
        self._layer_of = _layers_by_key(slots)

    def confirm(self, changed: Set[int]) -> None:
        """Note that the amplifiers play changed layers as in their slots, or have ended them."""
        started = changed & self.slots.keys()
        self.may_play = self.may_play.difference(changed).union(started)

    def end(self, number: int) -> None:
        """Note that a layer is silent for certain."""
        self.may_play -= {number}
        remaining = {**self.slots}
        remaining.pop(number, None)
        self.reset(remaining)

    def reset(self, known: Mapping[int, Slot]) -> None:
        """Discard the playback except known slots; fingers keep their layers."""
        self.slots = known
        self._layer_of = {**self._layer_of, **_layers_by_key(known)}

    def start_silence(self) -> None:
        """Note that all layers are to fall silent; they may play until `confirm_silence`."""
        self.slots = {}
        self._layer_of = {}

    def confirm_silence(self) -> None:
        """Note that all layers are silent for certain."""
        self.may_play = frozenset()


def _layers_by_key(slots: Mapping[int, Slot]) -> dict[ContentKey, int]:
    """Return the layers of contents that no other content replaces, by finger and voice."""
    return {
        slot.content.key: number
        for number, slot in slots.items()
        if slot.phase is not SlotPhase.FALLING
    }


def _is_one_voice(content: Content, other: Content) -> bool:
    """Whether one content can fade to the other within a layer: same finger, tone and pulse."""
    is_one_tone = content.key == other.key and content.frequency == other.frequency
    return is_one_tone and content.target.pulse == other.target.pulse
