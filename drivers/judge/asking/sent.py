"""A set that was sent, in words and in hexadecimal, for what went wrong after it."""

from collections.abc import Sequence

from drivers.protocol.records import Refusal
from drivers.protocol.sets import Command, LayerSet, unpack_layers
from drivers.protocol.table import MESSAGES, QUANTITIES

_FLAGS = "after", "renew", "keep_phase", "skip_ending", "onset", "ending"
_TONE = ("frequency", "{:g} Hz"), ("level", "{:g}"), ("phase", "at {:g} degrees")


def in_words(parts: Sequence[Sequence[int]]) -> str:
    """Return the meaning of a set by its parts, then their words; empty without any."""
    if not parts:
        return ""
    try:
        read = [MESSAGES["Set"].request.unpack(each, is_strict=True) for each in parts]
        stream = {each["index"]: each["stream"] for each in read}
        layers = unpack_layers([word for index in sorted(stream) for word in stream[index]])
        now = "at once" if read[0]["now"] else "staged"
        meaning = "; ".join([f"set {read[0]['token']}, {now}", *map(_layer, layers)])
    except Refusal as refusal:
        meaning = f"no whole set: {refusal}"
    return f"{meaning} = {' | '.join(' '.join(f'{word:04X}' for word in each) for each in parts)}"


def _flags(one: LayerSet | Command) -> str:
    """Return what is set of a layer or a command; an envelope with its step and knots."""
    found = [(name, value) for name in _FLAGS if (value := getattr(one, name, None))]
    return "".join(f" {name}" if value is True else f" {name} {value}" for name, value in found)


def _layer(one: LayerSet) -> str:
    head = f"layer {one.layer}{_flags(one)}, ramp {one.ramp} ms, valid for {one.valid_for} ms"
    return ": ".join([head, *filter(None, [", ".join(map(_tone, one.commands))])])


def _tone(one: Command) -> str:
    tone = [form.format(QUANTITIES[name].from_wire(getattr(one, name))) for name, form in _TONE]
    return f"channel {one.channel} {' '.join(tone)}{_flags(one)}"
