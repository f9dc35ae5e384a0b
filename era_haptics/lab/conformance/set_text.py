"""A set in words, for the report of a failure."""

from collections.abc import Sequence

from drivers.protocol.achieved import FLAGS
from drivers.protocol.definition import MESSAGES, QUANTITIES
from drivers.protocol.records import Refusal
from drivers.protocol.sets import Command, Envelope, LayerSet, unpack_layers

_TONE_FORMATS = {"frequency": "{:g} Hz", "level": "{:g}", "phase": "at {:g} degrees"}


def set_text(parts: Sequence[Sequence[int]]) -> str:
    """Return a set in words, then the words of its parts in hexadecimal; empty without parts."""
    if not parts:
        return ""
    words = " | ".join(" ".join(f"{word:04X}" for word in part) for part in parts)
    try:
        return f"{_meaning(parts)} = {words}"
    except Refusal as refusal:
        return f"incomplete set: {refusal} = {words}"


def _meaning(parts: Sequence[Sequence[int]]) -> str:
    """Return the layers of a set in words; raises Refusal if the set is incomplete."""
    unpack = MESSAGES["Set"].request.unpack
    values = [unpack(part, is_strict=True) for part in parts]
    streams = {part["index"]: part["stream"] for part in values}
    words = [word for index in sorted(streams) for word in streams[index]]
    start = "played immediately" if values[0]["now"] else "staged"
    head = f"set {values[0]['token']}, {start}"
    return "; ".join([head, *map(_layer_text, unpack_layers(words))])


def _layer_text(layer_set: LayerSet) -> str:
    flags = _flags_text(layer_set)
    times = f"ramp {layer_set.ramp} ms, valid for {layer_set.valid_for} ms"
    head = f"layer {layer_set.layer}{flags}, {times}"
    tones = ", ".join(map(_tone_text, layer_set.commands))
    return f"{head}: {tones}" if tones else head


def _tone_text(command: Command) -> str:
    texts = []
    for name, form in _TONE_FORMATS.items():
        value = QUANTITIES[name].from_wire(getattr(command, name))
        texts.append(form.format(value))
    return f"channel {command.channel} {' '.join(texts)}{_flags_text(command)}"


def _flags_text(record: LayerSet | Command) -> str:
    """Return the flags and envelopes of a layer or a command."""
    texts = []
    for name in FLAGS:
        value = getattr(record, name, None)
        if isinstance(value, Envelope):
            step = 1e3 * QUANTITIES["envelope_step"].from_wire(value.step)
            texts.append(f" {name} of {len(value.knots)} knots, {step:g} ms apart")
        elif value:
            texts.append(f" {name}")
    return "".join(texts)
