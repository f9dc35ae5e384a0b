"""Layers of the amplifiers: the slot in each one, and the layer that a content may use.

A content keeps its layer while it plays. A content that changes takes the layer of its finger; one
that replaces a content of another frequency needs a second layer, in which it rises while the
former content falls (a cross-fade).
"""

from collections.abc import Collection, Mapping, Sequence, Set

from controller.play.intent import CLICK, Content, ContentKey
from controller.play.slot import CROSSFADE, Slot, SlotPhase

STRENGTH_FADE = 0.100
"""Time [s] of the raised cosine along which a content changes its strength."""


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
        self.resume(self.slots, without=(number,))

    def forget(self) -> None:
        """Discard the playback, which is unknown; fingers keep their layers."""
        self.slots = {}

    def resume(self, slots: Mapping[int, Slot], *, without: Collection[int]) -> None:
        """Take former slots as the playback again, except those of some layers."""
        self.slots = {number: slot for number, slot in slots.items() if number not in without}
        self._layer_of = {**self._layer_of, **_layers_by_key(self.slots)}

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
