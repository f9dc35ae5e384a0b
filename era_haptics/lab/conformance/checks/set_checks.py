"""Checks of the contents of a set, which is accepted completely or not at all."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product

from drivers.protocol.definition import COMMAND, ENVELOPE, LAYER, QUANTITIES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, pack_layers
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.judge_client import in_batches
from era_haptics.lab.conformance.outcomes import expect_within, require
from era_haptics.lab.conformance.request_rows import (
    FULL,
    RequestRows,
    Row,
    Send,
    commit,
    layer,
    play_now,
    send,
    stage,
)
from era_haptics.lab.conformance.subject import Subject

_SCANNED = 8  # values within one step
_BATCH = 6  # sets that are rejected, before a look at the status
_MAX_LEVEL, _PHASE = QUANTITIES["level"].maximum, QUANTITIES["phase"]
_MAX_VALID_FOR = QUANTITIES["valid_for"].maximum
_ABOVE_PHASE = _PHASE.maximum + 1
_BELOW_PHASE = 0x10000 + _PHASE.minimum - 1  # as a word
_TONE = "frequency", "level", "phase"
_MAX_NUMBER = 16  # of channels and of layers that a word can name


@driving("protocol.md#layers")
def every_channel(subject: Subject) -> RequestRows:
    """Set for several channels: each at its own level, channels left out fall silent.

    Use the channel number of the command, not its position in the set, and release the voices of a
    named layer that get no new command.
    """
    tones = [subject.tone(channel, 1 - 0.05 * channel) for channel in subject.channels]
    reverse = []
    for channel in reversed(subject.channels):
        reverse.append(replace(tones[-1 - channel], channel=channel))
    all_but_one = reverse[: max(len(tones) - 1, 1)]
    single = [layer(0, tone) for tone in tones]
    several = [layer(0, *tones), layer(0, *reverse), layer(0, *all_but_one)]
    return [subject.arm, *single, *several, layer(0)]


@driving("protocol.md#readings")
def levels_of_every_frequency(subject: Subject) -> RequestRows:
    """Tone at the lowest and highest frequency of a channel: Status shows its level.

    Show the amplitude in full levels, whatever the frequency and the voltage that it takes, and
    accept both ends of the range.
    """
    rows: list[Row] = [subject.arm]
    for channel, limits in enumerate(subject.can["limits"]):
        for name in ("frequency_min", "frequency_max"):
            rows.append(layer(0, subject.tone(channel, frequency=limits[name])))
    return rows


@driving("protocol.md#readings")
async def achieved(subject: Subject) -> None:
    """GetAchieved: every value within half a step; Taken: exact only if nothing is rounded.

    Return the values that are really played with token, ramp and valid_for of their set, leave out
    released voices, and set exact only if nothing is rounded.
    """
    await subject.arm()
    shape = subject.envelope(0.0001)
    for number, level in product(subject.layers, (0.5, 0.98765)):
        tones = _uneven_tones(subject, number, level, shape)
        await subject.play(layer(number, *tones, ramp=number + 1, valid_for=50_000 + number))
        await subject.request("GetAchieved", layer=number)
    for number in subject.layers:
        await subject.request("GetAchieved", layer=number)
    # A fading voice is not listed, nor its layer after the fade, also of an onset to level 0.
    other_tone = subject.tone(frequency=subject.second_frequency)
    to_zero = subject.tone(0, 0.0, onset=shape)
    for content in (subject.layer_0(other_tone), layer(0), subject.layer_0(to_zero)):
        await subject.play(replace(content, ramp=subject.ramp))
        await subject.request("GetAchieved", layer=0)
    await subject.follow()
    await subject.request("GetAchieved", layer=0)


def _uneven_tones(subject: Subject, number: int, level: float, shape: Envelope) -> list[Command]:
    """Return tones for all channels of a layer whose values are likely to be rounded."""
    tones = []
    for channel in subject.channels:
        fraction = (level - 0.02 * channel) / len(subject.layers)
        phase = 20.0 * channel - 160.12 * level
        frequency = min(subject.frequency + 7 * channel + 40 * number, subject.highest)
        tone = subject.tone(
            channel, fraction, phase, frequency=frequency, keep=True, onset=shape, ending=shape
        )
        tones.append(tone)
    return tones


@driving("protocol.md#identity-and-capabilities")
async def steps_as_stated(subject: Subject) -> None:
    """Values within one step: rounded to at most two achieved values.

    State the frequency_step, level_step and phase_step with which you really play.
    """
    tone = subject.tone(0)
    names = [name for name in _TONE if subject.can[f"{name}_step"] > 3]
    reason = "the stated steps are about as fine as the steps of the wire"
    require(bool(names), reason)
    starts = {
        "frequency": tone.frequency,
        "level": tone.level - subject.can["level_step"],
        "phase": tone.phase,
    }
    limits = {
        "frequency": (subject.lowest, subject.highest),
        "level": (1, _MAX_LEVEL),
        "phase": (_PHASE.minimum, _PHASE.maximum),
    }
    await subject.arm()
    for name in names:
        achieved_values: set[int] = set()
        step = subject.can[f"{name}_step"]
        lowest, highest = limits[name]
        for number in range(_SCANNED):
            value = starts[name] + number * step // _SCANNED
            value = min(max(value, lowest), highest)
            await subject.play(layer(0, replace(tone, **{name: value})))
            reply = await subject.request("GetAchieved", layer=0)
            achieved_values.update(command[name] for command in reply["commands"])
        quantity = f"number of different achieved values within one {name}_step"
        expect_within(len(achieved_values), 0, 2, quantity)


@driving("protocol.md#identity-and-capabilities")
def accepts_its_ranges(subject: Subject) -> RequestRows:
    """Values at the ends of the stated ranges, and any frequency at level 0: accepted.

    Treat limits as inclusive, and check the frequency only of commands that drive.
    """
    rows: list[Row] = [subject.arm]
    ramp_max = subject.ramp_max
    for channel, limits in enumerate(subject.can["limits"]):
        for name in ("frequency_min", "frequency_max"):
            tone = Command(channel, limits[name], limits["level_max"], _PHASE.minimum)
            rows.append(stage(subject.layer_0(tone, ramp=ramp_max, valid_for=_MAX_VALID_FOR)))
    for envelope in _extreme_envelopes(subject):
        tone = subject.tone(onset=envelope, ending=envelope)
        rows.append(stage(subject.layer_0(tone)))
    last_layer = len(subject.layers) - 1
    rows.append(stage(layer(last_layer, subject.tone(), ramp=ramp_max)))
    rows += [layer(0, Command(0, frequency, 0, 0)) for frequency in (0, 0xFFFF)]
    return rows


def _extreme_envelopes(subject: Subject) -> Iterator[Envelope]:
    """Yield envelopes with the ends of the stated steps and numbers of knots."""
    can = subject.can
    knot = round(subject.level * FULL), _PHASE.maximum
    for step in (can["envelope_step_min"], can["envelope_step_max"]):
        for count in {0, min(1, can["knots"]), can["knots"]}:
            yield Envelope(step, (knot,) * count)


@driving("protocol.md#parts-of-a-set")
def all_or_nothing(subject: Subject) -> RequestRows:
    """Set with one error: rejected as a whole with code and channel, playback unchanged.

    Validate the whole stream before you change anything, in the order of the page: length, layers,
    then each command with its onset and its ending.
    """
    rejected_rows: list[Send] = []
    token = 1
    for flawed in _flawed_sets(subject):
        token += 1
        values = {**flawed.values, "token": token, "now": token % 2}
        rejected_rows.append(replace(flawed, values=values))
        if token % _BATCH == 0:
            rejected_rows.append(commit(token, "BAD_TOKEN"))
    batches = in_batches(rejected_rows, _BATCH)
    next_token = len(rejected_rows) + 2
    silent = pack_layers([layer(0)])
    return [
        subject.arm,
        subject.layer_0(),
        *(partial(subject.send_all, batch) for batch in batches),
        play_now(subject.layer_0(level=0.5), token=next_token),
        stage(subject.layer_0(level=0.25)),
        _rejected(silent, "BAD_TOKEN", token=next_token - 1, now=1),
        send("Set", raw=[subject.next_session, 0, 1 << 1, *silent], code="BAD_TOKEN"),
        commit(next_token + 1),
    ]


def _rejected(
    words: list[int], code: str = "BAD_VALUE", channel: int | None = None, **values: int
) -> Send:
    """Send words as a single-part set; expect a rejection that names a channel, if there is one."""
    part: Values = {"index": 0, "parts": 1, "stream": words, **values}
    return send("Set", code=code, channels=(channel,), **part)


def _flawed_sets(subject: Subject) -> Iterator[Send]:
    """Yield sets that must be rejected."""
    yield from _sets_beyond_limits(subject)
    yield from _sets_of_flawed_layers(subject)
    words = pack_layers([layer(0, subject.tone())])
    yield from _sets_of_flawed_words(words)
    for stream in _flawed_envelopes(subject):
        yield _rejected(stream, "BAD_VALUE", 0)
    yield _rejected([*words[:-2], 0, _ABOVE_PHASE], "BAD_VALUE", 0)
    too_many_commands = words[LAYER.places["count"]] + 1
    for stream in (words[:-1], [*words, 0], [too_many_commands, *words[1:]]):
        yield _rejected(stream, "BAD_LENGTH")
    yield from _sets_with_two_flaws(words)


def _sets_beyond_limits(subject: Subject) -> Iterator[Send]:
    """Yield sets with a valid layer, and a command beyond the capabilities."""
    tone = subject.tone()
    valid = layer(1, subject.tone(0, 0.5))
    for command in _flawed_tones(subject):
        yield _rejected(pack_layers([valid, layer(0, command)]), "BAD_VALUE", command.channel)
    yield _rejected(pack_layers([valid, layer(0, tone, tone)]), "BAD_CHANNEL", 0)
    channels = len(subject.channels)
    if channels < _MAX_NUMBER:
        beyond = layer(0, replace(tone, channel=channels))
        yield _rejected(pack_layers([valid, beyond]), "BAD_CHANNEL", channels)


def _flawed_tones(subject: Subject) -> Iterator[Command]:
    """Yield commands beyond the limits of their channel."""
    step = subject.can["envelope_step_min"]
    for channel, limits in enumerate(subject.can["limits"]):
        tone = subject.tone(channel)
        for frequency in (limits["frequency_min"] - 1, limits["frequency_max"] + 1):
            if 0 <= frequency <= 0xFFFF:
                wrong = replace(tone, frequency=frequency)
                yield wrong
                yield replace(wrong, level=0, onset=Envelope(step, ()))  # drives all the same
        level = limits["level_max"] + 1
        if level <= FULL:
            above = Envelope(step, ((level, 0),))
            yield replace(tone, level=level)
            yield replace(tone, onset=above)
            yield replace(tone, ending=above)


def _sets_of_flawed_layers(subject: Subject) -> Iterator[Send]:
    """Yield sets with a valid layer, and a layer with a flaw in its head."""
    tone = subject.tone()
    valid = layer(1, subject.tone(0, 0.5))
    layers = len(subject.layers)
    flawed_layers = [
        layer(1, tone),  # twice in the set
        layer(0, tone, renew=True),
        layer(0, after=True),
        layer(0, renew=True, after=True),
    ]
    if layers < _MAX_NUMBER:
        flawed_layers.append(layer(layers, tone))
    for flawed in flawed_layers:
        yield _rejected(pack_layers([valid, flawed]))
        yield _rejected(pack_layers([flawed, valid]))
    too_long = {"ramp": subject.ramp_max + 1, "valid_for": _MAX_VALID_FOR + 1}
    start = len(pack_layers([valid]))
    for flawed in (layer(0, tone, tone), layer(0), layer(0, renew=True)):
        for name, time in too_long.items():
            words = pack_layers([valid, flawed])
            words[start + LAYER.places[name]] = time
            yield _rejected(words)


def _sets_of_flawed_words(words: list[int]) -> Iterator[Send]:
    """Yield a valid set with one word that no set can have."""
    layer_place = LAYER.places["layer"]
    for bit in range(11, 16):
        yield _rejected(_changed(words, layer_place, words[layer_place] | 1 << bit))
    flawed_words = [("channel", 1 << bit) for bit in range(8, 16)]
    flawed_words += [
        ("level", _MAX_LEVEL + 1),
        ("phase", _ABOVE_PHASE),
        ("phase", _BELOW_PHASE),
    ]
    for name, word in flawed_words:
        place = LAYER.words + COMMAND.places[name]
        yield _rejected(_changed(words, place, word), "BAD_VALUE", 0)


def _changed(words: list[int], place: int, word: int) -> list[int]:
    """Return words with another word at a place."""
    return [*words[:place], word, *words[place + 1 :]]


def _flawed_envelopes(subject: Subject) -> Iterator[list[int]]:
    """Yield words of sets whose onset, or an ending that is never played, cannot be played."""
    step_min, step_max = subject.can["envelope_step_min"], subject.can["envelope_step_max"]
    max_knots = subject.can["knots"]
    knot = (100, 0)
    flawed_knots = (_MAX_LEVEL + 1, 0), (100, _ABOVE_PHASE), (100, _BELOW_PHASE)
    empty = Envelope(step_min, ())
    with_onset = subject.tone(0, 0.5, onset=empty)
    with_both = replace(with_onset, ending=empty)
    with_ending = subject.tone(0, 0.0, ending=empty)
    for tone in (with_onset, with_both, with_ending):
        head = pack_layers([layer(0, tone)])[: -ENVELOPE.words]
        for step in (step_min - 1, step_max + 1):
            yield [*head, 0, step]
        yield [*head, max_knots + 1, step_min, *knot * (max_knots + 1)]
        if max_knots > 1:
            for flawed_knot in flawed_knots:
                yield [*head, 2, step_min, *flawed_knot, *knot]
            yield [*head, 2, step_min, *knot, *flawed_knots[0]]


def _sets_with_two_flaws(words: list[int]) -> Iterator[Send]:
    """Yield sets whose first flaw must be named: length, layer, channel, the channel's words."""
    head, command = words[: LAYER.words], words[LAYER.words :]
    too_long = _changed(words, LAYER.places["ramp"], 1001)
    too_loud = [*command[:-2], _MAX_LEVEL + 1, command[-1]]
    two_commands = [words[0] + 1, *words[1 : LAYER.words]]
    yield _rejected(too_long[:-1], "BAD_LENGTH")
    yield _rejected([two_commands[0], *too_long[1:], *command], "BAD_VALUE")
    yield _rejected([*two_commands, *command, *too_loud], "BAD_CHANNEL", 0)
    yield _rejected([*two_commands, *too_loud, *command], "BAD_VALUE", 0)
    for second_layer in (words, words[:-1]):
        yield _rejected([*head, *too_loud, *second_layer], "BAD_VALUE", 0)
