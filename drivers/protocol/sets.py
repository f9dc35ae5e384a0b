"""Sets as streams of words: layers, parts and tokens.

All numbers are wire integers. A stream contains the layers changed by a set, one after the other; a
part contains the values of a Set message, and the far end collects parts in an `Assembly`.
"""

import math
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

from drivers.protocol.definition import (
    COMMAND,
    ENVELOPE,
    KNOT,
    LAYER,
    MAX_WORDS,
    MESSAGES,
    QUANTITIES,
    STAGED_LIFE,
)
from drivers.protocol.records import Refusal, Values

_SPAN = 1 << 16
_LAST_TOKEN = QUANTITIES["token"].maximum
_PHASE = QUANTITIES["phase"]
_SET = MESSAGES["Set"]
PART_WORDS = MAX_WORDS - _SET.request.words
MAX_PARTS = 127
_LAYER, _AFTER, _RENEW, _COUNT = LAYER.shifts
_HEAD_FORM, _COMMAND_FORM = LAYER.form, COMMAND.form
_ENVELOPE_FORM, _KNOT_FORM = ENVELOPE.form, KNOT.form
_CHANNEL, _KEEP_PHASE, _SKIP_ENDING, _ONSET, _ENDING = COMMAND.shifts
_INDEX, _PARTS, _ = _SET.request.shifts
_COUNTS = 1 << _RENEW - _COUNT
_CHANNELS = QUANTITIES["channel"].maximum + 1
_WIDEST: Values = {
    "layers": QUANTITIES["layer"].maximum + 1,
    "channels": _CHANNELS,
    "knots": QUANTITIES["knots"].maximum,
    "ramp_max": QUANTITIES["ramp"].maximum,
    "envelope_step_min": QUANTITIES["envelope_step"].minimum,
    "envelope_step_max": QUANTITIES["envelope_step"].maximum,
    "limits": _CHANNELS
    * [
        {
            "frequency_min": QUANTITIES["frequency"].minimum,
            "frequency_max": QUANTITIES["frequency"].maximum,
            "level_max": QUANTITIES["level"].maximum,
        }
    ],
}
"""Capabilities of an amplifier limited only by the table, for sets."""


def command_words(knot_counts: Iterable[int] = ()) -> int:
    """Return how many words a command has with envelopes of these numbers of knots."""
    words = COMMAND.words
    for count in knot_counts:
        words += ENVELOPE.words + KNOT.words * count
    return words


def token_after(number: int) -> int:
    """Return the token or latch after this one, 0 before the first: 1..65535, then 1 again."""
    return number % _LAST_TOKEN + 1


def is_newer_token(number: int, than: int) -> bool:
    """Whether one follows another by less than half of 2^16 (RFC 1982); any follows 0, none."""
    return than == 0 or 0 < (number - than) % _SPAN < _SPAN // 2


@dataclass(frozen=True, slots=True)
class Envelope:
    """A transition: knots (level, phase), a step apart; the last step leads to the final level."""

    step: int
    knots: tuple[tuple[int, ...], ...]

    @property
    def peak(self) -> int:
        """The highest level of a knot, 0 without any."""
        return max(self.knots)[0] if self.knots else 0

    def scaled(self, factor: float) -> "Envelope":
        """Return it with the levels of all knots times a factor."""
        return Envelope(
            self.step, tuple((round(level * factor), phase) for level, phase in self.knots)
        )


@dataclass(frozen=True, slots=True)
class Command:
    """The tone of a channel in one layer; onset, ending: None for the ramp of the layer."""

    channel: int
    frequency: int
    level: int
    phase: int
    keep_phase: bool = False
    skip_ending: bool = False
    onset: Envelope | None = None
    ending: Envelope | None = None

    @property
    def is_driven(self) -> bool:
        """Whether it starts or continues a tone; an onset may lead to level 0."""
        return self.level > 0 or self.onset is not None

    @property
    def peak(self) -> int:
        """Highest level, including onset and ending."""
        peak = self.level
        for envelope in (self.onset, self.ending):
            if envelope is not None:
                peak = max(peak, envelope.peak)
        return peak

    def scaled(self, factor: float) -> "Command":
        """Return it with its level, and the levels of all knots, times a factor."""
        onset = self.onset and self.onset.scaled(factor)
        ending = self.ending and self.ending.scaled(factor)
        return replace(self, level=round(self.level * factor), onset=onset, ending=ending)


@dataclass(frozen=True, slots=True)
class LayerSet:
    """Content of a layer: without commands it is silenced, or with renew prolonged.

    after: the commands start when the current onsets of the layer have ended.
    """

    layer: int
    ramp: int
    valid_for: int
    commands: tuple[Command, ...] = ()
    after: bool = False
    renew: bool = False

    def scaled(self, factor: float) -> "LayerSet":
        """Return it with all levels, also of knots, times a factor."""
        commands = [command.scaled(factor) for command in self.commands]
        return replace(self, commands=tuple(commands))


def is_vibrating(*layers: LayerSet) -> bool:
    """Whether any layer plays after its set, so that it spends time and rate."""
    for layer in layers:
        if layer.renew:
            return True
        for command in layer.commands:  # as `Command.is_driven`, without a call
            if command.level > 0 or command.onset is not None:
                return True
    return False


def pack_layers(layers: Iterable[LayerSet]) -> list[int]:
    """Return the stream of a set; struct.error for a number that is no word.

    In one call: every touch has hundreds of words.
    """
    form, numbers = "=", list[int]()
    for layer in layers:
        form += _HEAD_FORM
        flags = layer.after << _AFTER | layer.renew << _RENEW
        bits = layer.layer << _LAYER | flags | len(layer.commands) << _COUNT
        numbers += (bits, layer.ramp, layer.valid_for)
        for command in layer.commands:
            form += _COMMAND_FORM
            onset, ending = command.onset, command.ending
            flags = command.keep_phase << _KEEP_PHASE | command.skip_ending << _SKIP_ENDING
            flags |= (onset is not None) << _ONSET | (ending is not None) << _ENDING
            bits = command.channel << _CHANNEL | flags
            numbers += (bits, command.frequency, command.level, command.phase)
            for shape in (onset, ending):
                if shape is not None:
                    form += _ENVELOPE_FORM + _KNOT_FORM * len(shape.knots)
                    numbers += (len(shape.knots), shape.step)
                    numbers += chain.from_iterable(shape.knots)
    return list(memoryview(struct.pack(form, *numbers)).cast("H"))


def unpack_layers(words: Sequence[int], capabilities: Values = _WIDEST) -> tuple[LayerSet, ...]:
    """Return the layers of a stream; raises Refusal for the first error.

    capabilities: limit the layers; by default the limits of the table.
    """
    layers: list[LayerSet] = []
    at = 0
    while at < len(words):
        _check_length(words, at)
        head, at = LAYER.read(words, at)
        count = head.pop("count")
        head["after"] = bool(head["after"])
        head["renew"] = bool(head["renew"])
        if head["renew"] if count else head["after"]:
            raise Refusal("renew must be without commands, after with some")
        if any(head["layer"] == layer.layer for layer in layers):
            raise Refusal(f"layer {head['layer']} must occur once in a set")
        highest_layer = capabilities["layers"] - 1
        for name, highest in (("layer", highest_layer), ("ramp", capabilities["ramp_max"])):
            if head[name] > highest:
                raise Refusal(f"{name} must be at most {highest}, got {head[name]}")
        commands, at = _commands(words, at, count, capabilities)
        layers.append(LayerSet(commands=commands, **head))
    return tuple(layers)


def _commands(
    words: Sequence[int], at: int, count: int, capabilities: Values
) -> tuple[tuple[Command, ...], int]:
    """Return the commands of a layer, which begin at an index, and the index after them."""
    channels = capabilities["channels"]
    commands: list[Command] = []
    for _ in range(count):
        channel = words[at] >> _CHANNEL & _CHANNELS - 1
        if channel >= channels or any(channel == command.channel for command in commands):
            text = f"channel must be 0 to {channels - 1}, once in a layer, got {channel}"
            raise Refusal(text, "BAD_CHANNEL", channel)
        try:
            command, at = _command(words, at, capabilities)
        except Refusal as refusal:
            raise Refusal(str(refusal), refusal.code, channel) from None
        commands.append(command)
    return tuple(commands), at


def _check_length(words: Sequence[int], at: int) -> None:
    """Raise Refusal if the stream ends within the layer that begins at an index."""
    try:
        count = words[at] & _COUNTS - 1
        at += LAYER.words
        for _ in range(count):
            envelopes = words[at] >> _ENDING & 3  # onset and ending
            at += COMMAND.words
            for _ in range(envelopes.bit_count()):
                at += ENVELOPE.words + KNOT.words * words[at]
        is_cut = at > len(words)
    except IndexError:
        is_cut = True
    if is_cut:
        raise Refusal("the stream must not end amid a layer", "BAD_LENGTH")


def _command(words: Sequence[int], at: int, capabilities: Values) -> tuple[Command, int]:
    """Return the command that begins at an index, and the index after it."""
    values, at = COMMAND.read(words, at)
    for name in ("keep_phase", "skip_ending"):
        values[name] = bool(values[name])
    limits = capabilities["limits"][values["channel"]]
    is_driven = values["level"] > 0 or values["onset"]
    low, high = limits["frequency_min"], limits["frequency_max"]
    if is_driven and not low <= values["frequency"] <= high:
        raise Refusal(f"frequency must be {low} to {high}, got {values['frequency']}")
    peaks = [values["level"]]
    for name in ("onset", "ending"):
        envelope = None
        if values[name]:
            envelope, at = _envelope(words, at, capabilities)
            peaks.append(envelope.peak)
        values[name] = envelope
    if max(peaks) > limits["level_max"]:
        raise Refusal(f"level must be at most {limits['level_max']}, got {max(peaks)}")
    return Command(**values), at


def _envelope(words: Sequence[int], at: int, capabilities: Values) -> tuple[Envelope, int]:
    """Return the envelope that begins at an index, and the index after it."""
    head, at = ENVELOPE.read(words, at)
    low, high = capabilities["envelope_step_min"], capabilities["envelope_step_max"]
    if not low <= head["step"] <= high:
        raise Refusal(f"step must be {low} to {high}, got {head['step']}")
    if head["knots"] > capabilities["knots"]:
        raise Refusal(f"knots must be at most {capabilities['knots']}, got {head['knots']}")
    end = at + KNOT.words * head["knots"]
    raw = struct.pack(f"={end - at}H", *words[at:end])
    knots = tuple(struct.iter_unpack("=" + _KNOT_FORM, raw))
    phases = [phase for _, phase in knots]  # levels are compared with the limits of the channel
    if phases and not _PHASE.minimum <= min(phases) <= max(phases) <= _PHASE.maximum:
        allowed = f"{_PHASE.minimum} to {_PHASE.maximum}"
        raise Refusal(f"phase must be {allowed}, got {min(phases)} to {max(phases)}")
    return Envelope(head["step"], knots), end


def parts(
    stream: Sequence[int], *, session: int, token: int, now: bool, max_words: int = PART_WORDS
) -> list[Values]:
    """Return the Set messages of a stream, of at most so many words each.

    now: it plays when it is complete.
    """
    max_words = min(max(max_words, 1), PART_WORDS)
    cuts = range(0, max(len(stream), 1), max_words)
    if len(cuts) > MAX_PARTS:
        raise ValueError(f"a set must have at most {MAX_PARTS} parts, got {len(cuts)}")
    messages: list[Values] = []
    for index, at in enumerate(cuts):
        values = {"session": session, "token": token, "index": index, "parts": len(cuts)}
        messages.append({**values, "now": int(now), "stream": list(stream[at : at + max_words])})
    return messages


def is_last(part: Values) -> bool:
    """Whether a part is the last of its set, the only one with a reply."""
    return bool(part["index"] >= part["parts"] - 1)


def is_earlier_part(number: int, words: Sequence[int]) -> bool:
    """Whether words of a message are an earlier part of a set, even if they are invalid."""
    at = _SET.request.places["index"]
    if number != _SET.number or len(words) <= at:
        return False
    index = words[at] >> _INDEX
    part_count = words[at] >> _PARTS & MAX_PARTS
    return index < part_count - 1


@dataclass
class Assembly:
    """Earlier parts of a set, received in any order and possibly repeatedly.

    began: arrival of the first part [s]. It is discarded `STAGED_LIFE` later, or for another token.
    """

    token: int = 0
    count: int = 0
    began: float = -math.inf
    collected: dict[int, list[int]] = field(default_factory=dict)

    def is_expired(self, now: float) -> bool:
        """Whether the first part came too long before a time [s]."""
        return now - self.began > STAGED_LIFE

    def keep(self, part: Values, now: float) -> bool:
        """Keep a part other than the last at a time [s]; False if `parts` is not as before."""
        token = part["token"]
        count = part["parts"]
        if token != self.token or self.is_expired(now):
            self.token = token
            self.count = count
            self.began = now
            self.collected = {}
        if count == self.count:
            self.collected[part["index"]] = part["stream"]
        return bool(count == self.count)

    def first_missing(self, last: Values) -> int | None:
        """Return the index of the first missing part of the set with this last part, if any."""
        collected = self._collected_of(last)
        for index in range(last["parts"] - 1):
            if index not in collected:
                return index
        return None

    def stream(self, last: Values) -> list[int]:
        """Return the stream of the set with this last part; no part may be missing."""
        collected = self._collected_of(last)
        stream: list[int] = []
        for index in range(last["parts"] - 1):
            stream += collected[index]
        stream += last["stream"]
        return stream

    def _collected_of(self, last: Values) -> dict[int, list[int]]:
        """Return the collected parts of the set with this last part, by index."""
        return self.collected if last["token"] == self.token else {}
