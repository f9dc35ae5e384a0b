"""Sets as streams of words: layers, parts and tokens, and the achieved playback.

All numbers are wire integers. A stream contains the layers changed by a set, one after the other; a
part contains the values of a Set message, and the far end collects parts in an `Assembly`.
`achieved_problem` compares the reply to GetAchieved with the required playback of a layer.
"""

import math
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TypeAlias

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
PART_WORDS = MAX_WORDS - MESSAGES["Set"].request.words
MAX_PARTS = 127
_LAYER, _AFTER, _RENEW, _COUNT = LAYER.shifts
_HEAD_FORM, _COMMAND_FORM = LAYER.form, COMMAND.form
_ENVELOPE_FORM, _KNOT_FORM = ENVELOPE.form, KNOT.form
_CHANNEL, _KEEP_PHASE, _SKIP_ENDING, _ONSET, _ENDING = COMMAND.shifts
_COUNTS = 1 << _RENEW - _COUNT
_CHANNELS, _Q = QUANTITIES["channel"].maximum + 1, QUANTITIES
_LOW, _HIGH = _Q["phase"].minimum, _Q["phase"].maximum
_WIDEST: Values = {
    "layers": _Q["layer"].maximum + 1,
    "channels": _CHANNELS,
    "knots": _Q["knots"].maximum,
    "ramp_max": _Q["ramp"].maximum,
    "envelope_step_min": _Q["envelope_step"].minimum,
    "envelope_step_max": _Q["envelope_step"].maximum,
    "limits": _CHANNELS
    * [
        {
            "frequency_min": _Q["frequency"].minimum,
            "frequency_max": _Q["frequency"].maximum,
            "level_max": _Q["level"].maximum,
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


def unpack_layers(words: Sequence[int], can: Values = _WIDEST) -> tuple[LayerSet, ...]:
    """Return the layers of a stream; raises Refusal for the first error.

    can: capabilities that limit the layers; by default the limits of the table.
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
        for name, highest in (("layer", can["layers"] - 1), ("ramp", can["ramp_max"])):
            if head[name] > highest:
                raise Refusal(f"{name} must be at most {highest}, got {head[name]}")
        commands: list[Command] = []
        for _ in range(count):
            channel = words[at] >> _CHANNEL & _CHANNELS - 1
            if channel >= can["channels"] or any(channel == each.channel for each in commands):
                text = f"channel must be 0 to {can['channels'] - 1}, once in a layer, got {channel}"
                raise Refusal(text, "BAD_CHANNEL", channel)
            try:
                command, at = _command(words, at, can)
            except Refusal as refusal:
                raise Refusal(str(refusal), refusal.code, channel) from None
            commands.append(command)
        layers.append(LayerSet(commands=tuple(commands), **head))
    return tuple(layers)


def _check_length(words: Sequence[int], at: int) -> None:
    """Raise Refusal where the stream ends amid the layer that begins at an index."""
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


def _command(words: Sequence[int], at: int, can: Values) -> tuple[Command, int]:
    values, at = COMMAND.read(words, at)
    for name in ("keep_phase", "skip_ending"):
        values[name] = bool(values[name])
    limits = can["limits"][values["channel"]]
    is_driven = values["level"] > 0 or values["onset"]
    low, high = limits["frequency_min"], limits["frequency_max"]
    if is_driven and not low <= values["frequency"] <= high:
        raise Refusal(f"frequency must be {low} to {high}, got {values['frequency']}")
    peaks = [values["level"]]
    for name in ("onset", "ending"):
        values[name], at = _envelope(words, at, can) if values[name] else (None, at)
        if values[name] is not None:
            peaks.append(values[name].peak)
    if max(peaks) > limits["level_max"]:
        raise Refusal(f"level must be at most {limits['level_max']}, got {max(peaks)}")
    return Command(**values), at


def _envelope(words: Sequence[int], at: int, can: Values) -> tuple[Envelope, int]:
    head, at = ENVELOPE.read(words, at)
    low, high = can["envelope_step_min"], can["envelope_step_max"]
    if not low <= head["step"] <= high:
        raise Refusal(f"step must be {low} to {high}, got {head['step']}")
    if head["knots"] > can["knots"]:
        raise Refusal(f"knots must be at most {can['knots']}, got {head['knots']}")
    end = at + KNOT.words * head["knots"]
    raw = struct.pack(f"={end - at}H", *words[at:end])
    knots = tuple(struct.iter_unpack("=" + _KNOT_FORM, raw))
    phases = [phase for _, phase in knots]  # levels are compared with the limits of the channel
    if phases and not _LOW <= min(phases) <= max(phases) <= _HIGH:
        raise Refusal(f"phase must be {_LOW} to {_HIGH}, got {min(phases)} to {max(phases)}")
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
    message = MESSAGES["Set"]
    at = message.request.places["index"]
    is_headed = number == message.number and len(words) > at
    return is_headed and words[at] >> 8 < (words[at] >> 1) % 128 - 1


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
        """Keep a part but the last at a time [s]; False where `parts` is not as before."""
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

    def whole(self, last: Values) -> list[int] | int:
        """Return the stream of the set with this last part, or the first missing part."""
        collected = self.collected if last["token"] == self.token else {}
        indices = range(last["parts"] - 1)
        missing = next((index for index in indices if index not in collected), None)
        if missing is not None:
            return missing
        return [*chain.from_iterable(collected[index] for index in indices), *last["stream"]]


TONE = "frequency", "level", "phase"
FLAGS = "after", "renew", "keep_phase", "skip_ending", "onset", "ending"
"""Fields of layers and commands that GetAchieved does not have."""
Problem: TypeAlias = tuple[str, str, object, object]
"""A broken rule: subject, property, required value and received value."""
_TURN = 36_000  # wire units; phases are modulo this
_DERATED = 0.01  # tolerance of the ratios in a derated set


def achieved_problem(
    layer: LayerSet,
    reply: Values,
    can: Values,
    *,
    is_exact: bool,
    can_scale: bool = False,
    slack: float = 0.0,
) -> Problem | None:
    """Describe an error in a layer's achieved playback; None if it is within half a step.

    can: capabilities. is_exact: equal to the word; can_scale: all levels can be lower by a common
    factor; slack: in steps of the wire, in addition to the steps of the amplifier.
    """
    achieved = {command["channel"]: command for command in reply["commands"]}
    levels: list[int] = []
    shares: list[float] = []
    beyond = achieved.keys() - {tone.channel for tone in layer.commands}
    if beyond:
        return "commit", "channels that are not driven", "none", sorted(beyond)
    names = ("layer", "ramp") if achieved else ("layer",)
    must = [getattr(layer, name) for name in names]
    got_values = [reply[name] for name in names]
    if must != got_values:
        return "plays", ", ".join(names), must, got_values
    for tone in layer.commands:
        requested = {name: getattr(tone, name) for name in TONE}
        got = achieved.get(tone.channel, {**requested, "level": 0})
        for name in TONE if tone.level else ("level",):  # silence has no phase
            error = abs(got[name] - requested[name])
            error = min(error, _TURN - error) if name == "phase" else error
            allowed = 0.0 if is_exact or not tone.level else _rounding(name, tone, can) + slack
            is_scaled = can_scale and name == "level" and got[name] <= requested[name]
            if error > allowed and not is_scaled:
                quantity = f"error of achieved {name} of channel {tone.channel}"
                rule = "plays" if tone.channel in achieved else "commit"
                return rule, quantity, f"0 to {allowed:g}", error
        if tone.level and can_scale:
            levels.append(tone.level)
            shares.append(got["level"] / tone.level)
    difference = max(shares, default=0.0) - min(shares, default=0.0)
    if difference > _DERATED + can.get("level_step", 1) / min(levels, default=1):
        return "commit", "shares of its channels", "alike", sorted(shares)
    return None


def achieved_layer(layer: LayerSet, reply: Values, can: Values) -> LayerSet:
    """Return a layer with the levels, frequencies and phases of a reply.

    can: capabilities. A tone at level 0, possibly the target of an onset, stays unchanged if the
    reported frequency is not its rounded value: an amplifier can report any.
    """
    achieved = {}
    for command in reply["commands"]:
        achieved[command["channel"]] = {name: command[name] for name in TONE}
    commands = []
    for tone in layer.commands:
        got = achieved.get(tone.channel, {"level": 0})
        error = abs(got.get("frequency", tone.frequency) - tone.frequency)
        is_any = not tone.level and error > can["frequency_step"]
        commands.append(tone if is_any else replace(tone, **got))
    return replace(layer, commands=tuple(commands))


def _rounding(name: str, tone: Command, can: Values) -> float:
    """Return by how much a part of a tone may be rounded: inwards at the limits."""
    step = can.get(f"{name}_step", 1)
    if name != "phase" and can:
        value = getattr(tone, name)
        limits = can["limits"][tone.channel]
        low = limits.get(f"{name}_min", 0)
        high = limits[f"{name}_max"]
        if not low <= value - step / 2 <= value + step / 2 <= high:
            return float(step)
    return float(step / 2)
