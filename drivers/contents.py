"""What the layers of an amplifier are to play, in physical units: tones, their shapes, layers.

The ledger of an amplifier (`drivers.host.ledger`) checks them and makes the integers of the wire.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Shape:
    """How a level begins or ends: complex levels in full levels, a step [s] apart.

    Straight lines lead through them from the present amplitude to the final one, which comes one
    step after the last.
    """

    step: float
    knots: tuple[complex, ...]


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
    onset: Shape | None = None
    ending: Shape | None = None


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
