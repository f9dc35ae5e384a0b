"""Building of sets for the amplifier under test, in one part or several."""

import math
from collections.abc import Sequence
from dataclasses import replace

from drivers.protocol.definition import MESSAGES
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, pack_layers, parts
from era_haptics.lab.conformance.capabilities import Capabilities


class ConformanceSets:
    """Builds sets within an amplifier's capabilities, with consecutive tokens."""

    def __init__(self, can: Capabilities) -> None:
        self._can = can
        self.token = 0
        """Token of the last set built or carried out; 0 after an Arm."""
        self.sent: list[Sequence[int]] = []
        """Words of the parts of the last set sent, which the report of a failure shows."""

    def parts(
        self, *layers: LayerSet, token: int = 0, now: int = 1, count: int = 1
    ) -> list[Values]:
        """Make the parts of a set but for their session; token: 0 for the next; count: at least."""
        if not token:
            token = self.token % 0xFFFF + 1
            self.token = token
        ramp_max = self._can["ramp_max"]
        limited = [replace(layer_set, ramp=min(layer_set.ramp, ramp_max)) for layer_set in layers]
        stream = pack_layers(tuple(limited))
        max_words = math.ceil(len(stream) / count)
        set_parts = []
        for part in parts(stream, session=1, token=token, now=bool(now), max_words=max_words):
            del part["session"]
            set_parts.append(part)
        return set_parts

    def note_sent(self, words: Sequence[int]) -> None:
        """Record the words of a part, with the earlier parts of its set."""
        head = MESSAGES["Set"].request.places["index"]  # session and token
        if self.sent and list(self.sent[-1][:head]) != list(words[:head]):
            self.sent = []
        self.sent = [*self.sent, words]
