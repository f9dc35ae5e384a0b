"""A set that was sent, in words and in hexadecimal, for what went wrong after it."""

from collections.abc import Sequence

from drivers.protocol.records import Refusal
from drivers.protocol.sets import Command, Envelope, LayerSet, unpack_layers
from drivers.protocol.table import MESSAGES, QUANTITIES

_SHAPES = "onset", "ending"


def in_words(parts: Sequence[Sequence[int]]) -> str:
    """Return the meaning of a set by its parts, then their words; empty without any."""
    if not parts:
        return ""
    try:
        read = [MESSAGES["Set"].request.unpack(each, is_strict=True) for each in parts]
        stream = {each["index"]: each["stream"] for each in read}
        words = [word for index in sorted(stream) for word in stream[index]]
        now = "at once" if read[0]["now"] else "staged"
        meaning = "; ".join([f"set {read[0]['token']}, {now}", *map(_layer, unpack_layers(words))])
    except Refusal as refusal:
        meaning = f"no whole set: {refusal}"
    return f"{meaning} = {' | '.join(' '.join(f'{word:04X}' for word in each) for each in parts)}"


def _layer(one: LayerSet) -> str:
    flags = "".join(f", {name}" for name in ("after", "renew") if getattr(one, name))
    head = f"layer {one.layer}{flags}, ramp {one.ramp} ms, valid for {one.valid_for} ms"
    return ": ".join([head, *filter(None, [", ".join(map(_tone, one.commands))])])


def _tone(one: Command) -> str:
    frequency, level, phase = (
        QUANTITIES[name].from_wire(getattr(one, name)) for name in ("frequency", "level", "phase")
    )
    flags = "".join(f" {name}" for name in ("keep_phase", "skip_ending") if getattr(one, name))
    shapes = "".join(
        f" {name} {_shape(getattr(one, name))}" for name in _SHAPES if getattr(one, name)
    )
    return f"channel {one.channel} {frequency:g} Hz {level:g} at {phase:g} degrees{flags}{shapes}"


def _shape(one: Envelope) -> str:
    return f"of {len(one.knots)} knots, {QUANTITIES['envelope_step'].from_wire(one.step):g} s apart"
