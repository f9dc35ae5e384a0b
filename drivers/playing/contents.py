"""What the layers of an amplifier are to play: tones in physical units, and layers of them.

The ledger of an amplifier (`drivers.host.ledger`) checks them and makes the integers of the wire.
Envelopes are in these from the start: all knots of a set are made at once.
"""

from dataclasses import dataclass

from drivers.protocol.sets import Envelope


@dataclass(frozen=True, slots=True)
class Tone:
    """What a channel plays in a layer: frequency [Hz], level 0..1 of full level, phase [degrees].

    keep_phase: continue the phase of the same frequency in this layer; skip_ending: fall silent
    along the ramp of the layer, not along the ending of before. onset, ending: None for the ramp.
    """

    channel: int
    frequency: float
    level: float
    phase: float = 0.0
    keep_phase: bool = False
    skip_ending: bool = False
    onset: Envelope | None = None
    ending: Envelope | None = None


@dataclass(frozen=True, slots=True)
class Layer:
    """What one layer is to play; without tones it falls silent, or with renew is prolonged.

    Channels without a tone are silent in this layer. ramp [s] of all changes; valid_for [s]: the
    layer ends by itself then, 0 for never; after: the tones start when the onsets that the layer
    plays have ended.
    """

    number: int
    tones: tuple[Tone, ...] = ()
    ramp: float = 0.02
    valid_for: float = 0.0
    after: bool = False
    renew: bool = False
