"""The ledger and the line below it.

What the ledger admits stays within the limits whenever it is played; the line decides which request
goes when and how often, and what callers learn.
"""

import asyncio
import math
import random
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import starmap
from types import EllipsisType
from unittest.mock import Mock

import pytest

from drivers.errors import CommandError, CommandRefused, LinkTimeout
from drivers.host.ledger import Ledger
from drivers.host.requests import Job, Priority
from drivers.host.set_admission import SetAdmission, StagedSet
from drivers.playing import AmplifierLayer, AmplifierTone, Playback
from drivers.protocol.sets import Envelope
from drivers.wires.can_frames import CanFrame, pack_frames
from drivers.wires.serial_frames import Frame, encode_frame
from kit.clock import MemoryLine, in_virtual_time, unaltered
from registry.limits import GuardLimits
from sim.amplifier.readings import capabilities

WIDE = GuardLimits(20.0, 1000.0, 1.0)
CAN = capabilities(3)


def tone(
    channel: int = 0, level: float = 0.5, frequency: float = 100.0, **other: object
) -> AmplifierTone:
    """A tone of 100 Hz at half level unless told otherwise."""
    return AmplifierTone(channel, frequency, level, **other)  # type: ignore[arg-type]


def play(ledger: Ledger, token: int, at: float, *layers: AmplifierLayer) -> None:
    """Admit, send and confirm a set without delay."""
    ledger.sent(token, ledger.admit(layers, at), at)
    ledger.resolve(token, at)


def refusal(ledger: Ledger, *layers: AmplifierLayer, at: float = 1.0) -> CommandRefused:
    """The error with which layers are refused."""
    with pytest.raises(CommandRefused) as raised:
        ledger.admit(layers, at)
    return raised.value


BAD = {
    "frequency": tone(1, frequency=1001.0),
    "frequency below": tone(1, frequency=19.9),
    "frequency nan": tone(1, frequency=math.nan),
    "level": tone(1, level=1.0001),
    "level nan": tone(1, level=math.nan),
    "level negative": tone(1, level=-0.1),
    "phase": replace(tone(1), phase=math.inf),
    "channel": tone(3),
    "knot": tone(1, onset=Envelope(100, ((10001, 9000),))),
    "step": tone(1, ending=Envelope(1, ((1000, 0),))),
    "phase of a knot": tone(1, ending=Envelope(100, ((1000, 0), (1000, 18001)))),
    "number of a knot": tone(1, onset=Envelope(100, ((1000.5, 0),))),  # type: ignore[arg-type]
    "knots": tone(1, onset=Envelope(100, ((1000, 0),) * 33)),
}


@pytest.mark.parametrize("case", BAD)
def test_tone_that_must_not_be_played_is_refused_with_its_channel(case: str) -> None:
    """Beside a good one, in the second layer."""
    bad = BAD[case]
    assert (
        refusal(Ledger(WIDE, CAN), AmplifierLayer(0, (tone(),)), AmplifierLayer(1, (bad,))).channel
        == bad.channel
    )


@pytest.mark.parametrize(
    "layer",
    [
        *(
            AmplifierLayer(8, (tone(),)),
            AmplifierLayer(-1, (tone(),)),
            AmplifierLayer(0, (tone(),), ramp=1.001),
        ),
        *(
            AmplifierLayer(0, (tone(),), ramp=math.nan),
            AmplifierLayer(0, (tone(),), valid_for=60.1),
        ),
        *(
            AmplifierLayer(0, (tone(),), renew=True),
            AmplifierLayer(0, (), after=True),
            AmplifierLayer(0, (tone(), tone())),
        ),
    ],
)
def test_layer_that_cannot_be_is_refused(layer: AmplifierLayer) -> None:
    """Numbers, times and flags of a layer, and a channel twice."""
    refusal(Ledger(WIDE, CAN), layer)


def test_set_of_more_than_127_parts_is_refused() -> None:
    """127 parts of 117 words carry 14 859 words, fewer than an amplifier may accept."""
    shape = Envelope(100, ((100, 0),) * 32)
    tones = tuple(tone(channel, 0.01, onset=shape, ending=shape) for channel in range(16))
    layers = [AmplifierLayer(number, tones) for number in range(16)]
    can = {**capabilities(16), "layers": 16, "voices": 255, "set_words": 65535}
    admission = SetAdmission("a", Mock(is_complete=True))
    refused = admission.refusal_of(StagedSet(layers), Ledger(WIDE, can), 0.0, set_time=0.0)
    assert "a set must have at most 14859 words, got" in str(refused)


def test_values_are_rounded_to_the_safe_side() -> None:
    """Ramps upward, levels to the nearest, valid_for never to 0, which means without end.

    Full level in single precision, which may be 1 + 2^-22, is full level.
    """
    layer = AmplifierLayer(0, (tone(level=0.33336, frequency=99.99),), ramp=0.0101, valid_for=1e-5)
    (one,) = Ledger(WIDE, CAN).admit([layer], 0.0)
    assert (one.ramp, one.valid_for) == (11, 1)
    assert (one.commands[0].level, one.commands[0].frequency) == (3334, 2000)
    (full,) = Ledger(WIDE, CAN).admit([AmplifierLayer(0, (tone(level=1 + 2**-22),))], 0.0)
    assert full.commands[0].level == 10000


def test_least_limit_holds() -> None:
    """Of the rig (0.8), the amplifier (0.9) and a channel (0.7, for each)."""
    can = {**capabilities(2), "level_max": 9000}
    can["limits"][1]["level_max"] = 7000
    ledger = Ledger(replace(WIDE, level=0.8), can)
    assert refusal(ledger, AmplifierLayer(0, (tone(0, level=0.71),))).channel == 0
    assert ledger.admit([AmplifierLayer(0, (tone(0, level=0.7),))], 1.0)


@pytest.mark.parametrize("name", ["slew", "power", "on_time", "duty", "rate"])
def test_limits_that_leave_nothing_are_refused(name: str) -> None:
    """Zero and NaN of each."""
    for value in (0.0, math.nan):
        with pytest.raises(CommandError):
            Ledger(replace(WIDE, **{name: value}), CAN)


@dataclass(frozen=True)
class Asked:
    """A layer that is asked for at a time [s], and what becomes of it.

    It is admitted unless it is refused; then until is when it would be allowed, None for never and
    ... for anything. valid_for, longest [ms]: bounds of its time and of its ramp as admitted.
    plays: whether it is sent and confirmed, too.
    """

    at: float
    layer: AmplifierLayer
    plays: bool = False
    is_refused: bool = False
    until: float | EllipsisType | None = ...
    valid_for: tuple[int, int] = (0, 65_535)
    longest: int = 65_535


plays = partial(Asked, plays=True)
refused = partial(Asked, is_refused=True)
HIGH = partial(tone, frequency=200.0)
RISING = AmplifierLayer(0, (tone(),), ramp=0.1)
SHAPED = AmplifierLayer(0, (tone(level=0.2, onset=Envelope(100, ((1000, 0), (2000, 0)))),))
SWELLING = tone(level=0.05, onset=Envelope(500, ((500, 0),)))
ENDING = tone(level=0.1, ending=Envelope(100, ((8000, 0),)))

# Silent for 100 ms, at 0.9 after 120 and silent again after 140; such that it plays amid a ramp.
PULSE = tone(level=0.0, onset=Envelope(200, ((0, 0),) * 5 + ((9000, 0),)))

LOW_SOON = Envelope(200, ((9000, 0),) + ((500, 0),) * 6)


def sudden(level: float) -> AmplifierLayer:
    """A layer whose tone is there within 2 ms, while what it replaces fades for 60 ms."""
    shape = Envelope(10, ((round(10_000 * level), 0),))
    return AmplifierLayer(0, (HIGH(level=level, onset=shape),), ramp=0.06)


PIECE = tone(level=0.9, keep_phase=True, onset=Envelope(1000, ((9000, 0),)))
LOUD_END = tone(0, 1.0, 200.0, ending=Envelope(100, ((10000, 0),) * 10))
LASTING = AmplifierLayer(0, (tone(),), ramp=0.0)


def achieves(level: float, token: int) -> Callable[[Ledger], None]:
    """What 0.45 has become in the set with this token."""

    def correct(ledger: Ledger) -> None:
        (sent,) = ledger.admit([AmplifierLayer(0, (tone(level=level),))], 0.5)
        ledger.playback.correct(sent, token)

    return correct


def reopened(ledger: Ledger) -> Ledger:
    """A ledger of other capabilities that goes on from one that had 0.1 of all time."""
    other = Ledger(replace(WIDE, duty=0.1), {**CAN, "level_max": 4000})
    other.go_on_from(ledger)
    return other


COURSES: Mapping[str, tuple[GuardLimits, Sequence[Asked | Callable[[Ledger], Ledger | None]]]] = {
    # 0.6 in one layer leaves 0.4 for another; once it has faded, 0.9 is admitted.
    "layers are bounded together": (
        WIDE,
        [
            plays(0.0, AmplifierLayer(0, (tone(level=0.6),))),
            refused(1.0, AmplifierLayer(1, (HIGH(level=0.41),))),
            Asked(1.0, AmplifierLayer(1, (HIGH(level=0.4),))),
            plays(1.0, AmplifierLayer(0, ())),
            refused(1.01, AmplifierLayer(1, (HIGH(level=0.9),))),
            Asked(1.03, AmplifierLayer(1, (HIGH(level=0.9),))),
        ],
    ),
    # 0.6 fades for 20 ms from 1.0 on; what is too loud at any time has no such moment.
    "a refusal says from when": (
        WIDE,
        [
            plays(0.0, AmplifierLayer(0, (tone(level=0.6),))),
            plays(1.0, AmplifierLayer(0, ())),
            refused(1.01, AmplifierLayer(1, (HIGH(level=0.9),)), until=1.02),
            Asked(1.02 + 1e-9, AmplifierLayer(1, (HIGH(level=0.9),))),
            plays(2.0, AmplifierLayer(0, (tone(level=0.6),))),
            refused(3.0, AmplifierLayer(1, (HIGH(level=0.9),)), until=None),
        ],
    ),
    # Level 0.1 with an ending through 0.8 waits: 0.3 beside it is refused, 0.15 is not.
    "a set that waits counts with its ending": (
        WIDE,
        [
            plays(0.0, AmplifierLayer(0, (SWELLING,))),
            plays(0.01, AmplifierLayer(0, (ENDING,), after=True)),
            refused(0.02, AmplifierLayer(1, (HIGH(level=0.3),))),
            Asked(0.02, AmplifierLayer(1, (HIGH(level=0.15),))),
        ],
    ),
    # 0.9 follows 0.9: one voice, unless its phase is new; 0.1 is left beside both.
    "what waits goes on as one voice": (
        WIDE,
        [
            plays(0.0, AmplifierLayer(0, (PIECE,))),
            refused(0.05, AmplifierLayer(0, (replace(PIECE, keep_phase=False),), after=True)),
            refused(0.05, AmplifierLayer(0, (replace(PIECE, frequency=200.0),), after=True)),
            plays(0.05, AmplifierLayer(0, (PIECE,), after=True)),
            refused(0.06, AmplifierLayer(1, (HIGH(level=0.11),))),
            Asked(0.06, AmplifierLayer(1, (HIGH(level=0.1),))),
        ],
    ),
    # Gains of a raised cosine add up to one, in power to less than one.
    "a cross-fade at full level": (
        replace(WIDE, power=1.0),
        [
            plays(0.0, AmplifierLayer(0, (tone(0, 1.0),))),
            Asked(1.0, AmplifierLayer(0, (tone(0, 1.0, 200.0),))),
            Asked(1.0, AmplifierLayer(0, (tone(1, 1.0, 200.0),))),
        ],
    ),
    # An ending at full level 1 ms after the commit, amid a ramp of 1 s: with the old tone nearly 2.
    "an ending amid a cross-fade": (
        WIDE,
        [
            plays(0.0, AmplifierLayer(0, (tone(0, 1.0),))),
            refused(1.0, AmplifierLayer(0, (LOUD_END,), ramp=1.0, valid_for=0.001)),
            Asked(1.0, AmplifierLayer(0, (tone(0, 1.0, 200.0),), ramp=1.0, valid_for=0.001)),
        ],
    ),
    # A set that comes after 80 ms or later lets a pulse go on, which ends before its ramp does.
    "a pulse that ends before a ramp": (
        WIDE,
        [
            plays(0.0, AmplifierLayer(0, (PULSE,))),
            refused(0.0, sudden(0.9)),
            Asked(0.0, sudden(0.1)),
            Asked(0.15, sudden(0.9)),
        ],
    ),
    # It goes on (0.9 in 20 ms) or fades (pi/2 · 0.9 in 60), beside pi/2 · 0.05 in 60: 69.9.
    "a pulse that beats with what follows": (
        replace(WIDE, slew=69.9),
        [
            plays(0.0, AmplifierLayer(0, (PULSE,))),
            Asked(0.0, AmplifierLayer(0, (tone(level=0.05),), ramp=0.06)),
        ],
    ),
    "a pulse that beats too fast": (
        replace(WIDE, slew=69.8),
        [
            plays(0.0, AmplifierLayer(0, (PULSE,))),
            refused(0.0, AmplifierLayer(0, (tone(level=0.05),), ramp=0.06)),
        ],
    ),
    # 0.5 in two layers of one channel: 1, in two channels: a half.
    "power of all layers and channels": (
        replace(WIDE, power=0.6),
        [
            plays(0.0, AmplifierLayer(0, (tone(0),))),
            refused(1.0, AmplifierLayer(1, (HIGH(0),))),
            Asked(1.0, AmplifierLayer(1, (HIGH(1),))),
        ],
    ),
    # pi/2 · 0.5 / 0.1 s = 7.85 per second along a ramp; 10 by a knot; a fade never rises.
    "a rise": (replace(WIDE, slew=7.86), [Asked(0.0, RISING)]),
    "a rise that is too fast": (
        replace(WIDE, slew=7.85),
        [refused(1.0, RISING), refused(1.0, SHAPED)],
    ),
    "a fade": (
        replace(WIDE, slew=10.01),
        [Asked(0.0, SHAPED), plays(0.0, RISING), Asked(1.0, AmplifierLayer(0, (), ramp=0.001))],
    ),
    # 2 s: 1.98 s and a ramp of 20 ms; after 1.5 s of it the rest less 100 ms of way.
    "on-time": (
        replace(WIDE, on_time=2.0),
        [
            plays(0.0, AmplifierLayer(0, (tone(),)), valid_for=(1980, 1980)),
            Asked(1.5, AmplifierLayer(1, (tone(1),)), valid_for=(380, 380)),
            refused(1.9, AmplifierLayer(0, renew=True)),
            Asked(1.9, AmplifierLayer(0, (), ramp=1.0), longest=100),
        ],
    ),
    # Nothing vibrates from 2 s on: one layer ends by itself, the other at 1 s by tones of level 0.
    "a layer that was ended by level zero": (
        replace(WIDE, on_time=5.0),
        [
            plays(0.0, AmplifierLayer(0, (tone(0, level=0.3),), valid_for=2.0)),
            plays(0.0, AmplifierLayer(1, (tone(1, level=0.3),), valid_for=2.0)),
            plays(1.0, AmplifierLayer(1, (tone(0, level=0.0), tone(1, level=0.0)))),
            Asked(6.0, AmplifierLayer(0, (tone(),), valid_for=1.0), valid_for=(1000, 1000)),
        ],
    ),
    # 2 s of 10 s: after two of 0.5 s and a ramp of 20 ms, 0.94 s and such a ramp are left; each may
    # have been played up to 0.1 s later.
    "duty": (
        replace(WIDE, duty=0.2),
        [
            plays(0.0, AmplifierLayer(0, (tone(),), valid_for=0.5)),
            plays(2.0, AmplifierLayer(0, (tone(),), valid_for=0.5)),
            Asked(4.0, AmplifierLayer(0, (tone(),)), valid_for=(740, 940)),
        ],
    ),
    # 0.9 of one second within ten; a lower level limit does not give it back, reopened or not.
    "other capabilities leave what was spent": (
        replace(WIDE, duty=0.1),
        [
            plays(0.0, LASTING),
            plays(0.9, AmplifierLayer(0, (), ramp=0.0)),
            lambda ledger: ledger.adopt({**CAN, "level_max": 5000}),
            refused(5.0, AmplifierLayer(0, (tone(level=0.51),))),
            Asked(5.0, LASTING, valid_for=(1, 100)),
            reopened,
            Asked(5.0, AmplifierLayer(0, (tone(level=0.3),), ramp=0.0), valid_for=(1, 100)),
        ],
    ),
    # 0.5 was sent, 0.45 plays: 0.54 beside it is admitted, 0.56 is not; of another set nothing is.
    "what was achieved counts from then on": (
        WIDE,
        [
            plays(0.0, AmplifierLayer(0, (tone(level=0.5),))),
            achieves(0.45, token=2),
            refused(1.0, AmplifierLayer(1, (HIGH(level=0.54),))),
            achieves(0.45, token=1),
            refused(1.0, AmplifierLayer(1, (HIGH(level=0.56),))),
            Asked(1.0, AmplifierLayer(1, (HIGH(level=0.54),))),
        ],
    ),
    # Of 2 s, 0.5 have gone by, ten steps of an onset last 0.5 more, and 0.1 may be on the way. A
    # ramp of 0.1 s is left for its end: it may last for 0.8 s from where it begins.
    "what waits for an onset ends within the longest vibration": (
        replace(WIDE, on_time=2.0),
        [
            plays(
                0.0,
                AmplifierLayer(
                    0,
                    (tone(onset=Envelope(1000, ((1000, 0),) * 9)),),
                    ramp=0.1,
                    valid_for=1.5,
                ),
            ),
            Asked(
                0.5,
                AmplifierLayer(0, (tone(keep_phase=True),), ramp=0.1, after=True),
                valid_for=(798, 802),
            ),
        ],
    ),
    # Three sets a second; silence is never refused.
    "rate": (
        replace(WIDE, rate=3.0),
        [
            *(plays(0.1 * number, AmplifierLayer(0, (tone(),))) for number in range(3)),
            refused(0.5, AmplifierLayer(0, (tone(),)), until=1.1),
            Asked(0.5, AmplifierLayer(0, ())),
            Asked(1.11, AmplifierLayer(0, (tone(),))),
        ],
    ),
}


@pytest.mark.parametrize("name", COURSES)
def test_ledger_admits_what_is_within_the_limits(name: str) -> None:
    """Each set of a course, with what was played before; a refusal names the first channel.

    In between it may learn of something else.
    """
    limits, course = COURSES[name]
    ledger = Ledger(limits, CAN)
    for token, asked in enumerate(course, start=1):
        if not isinstance(asked, Asked):
            ledger = asked(ledger) or ledger
            continue
        if asked.is_refused:
            error = refusal(ledger, asked.layer, at=asked.at)
            assert error.channel in (0, None)
            assert asked.until in (..., error.until and pytest.approx(error.until)), asked
            continue
        (one,) = ledger.admit([asked.layer], asked.at)
        assert asked.valid_for[0] <= one.valid_for <= asked.valid_for[1]
        assert one.ramp <= asked.longest
        if asked.plays:
            play(ledger, token, asked.at, asked.layer)


# Each played up to 10 ms after it was sent; None: silence. 0.9 beside what may go on is too much.
LATE: Mapping[str, Sequence[tuple[float, AmplifierLayer | None]]] = {
    # Silence from 85 ms on along 60 ms leaves a pulse that is over after 140; from 75 ms on not.
    "a pulse that silence lets go on": [(0.0, AmplifierLayer(0, (PULSE,))), (0.075, None)],
    # 0.9 at 20 ms and little more until 160: if it plays late, it fades at 31 ms from nearly there.
    "a fade where a pulse is low": [
        (0.0, AmplifierLayer(0, (tone(level=0.0, onset=LOW_SOON),))),
        (0.031, AmplifierLayer(0, (), ramp=0.13)),
    ],
    # Of eight voices, at 1.1 all sound and 0.5 is cut short for a ninth; at 1.11 one is over.
    "a fade that is not cut short": [
        (0.0, AmplifierLayer(0, (tone(level=0.5),))),
        *((0.1 * number, AmplifierLayer(number, (tone(level=0.01),))) for number in range(1, 8)),
        (1.0, AmplifierLayer(0, (), ramp=1.0)),
        (1.055, AmplifierLayer(1, (), ramp=0.05)),
        (1.1, AmplifierLayer(0, (tone(level=0.01),))),
    ],
}


@pytest.mark.parametrize("name", LATE)
def test_what_a_commit_may_leave_playing_if_it_comes_late_counts(name: str) -> None:
    """Each set may have been played when it was sent or 10 ms later; all is over a second later."""
    ledger, at = Ledger(WIDE, {**CAN, "voices": 8}), 0.0
    for token, (at, layer) in enumerate(LATE[name], 1):
        if layer is None:
            ledger.note_ended(0.06, at, at + 0.01)
        else:
            ledger.sent(token, ledger.admit([layer], at), at)
            ledger.resolve(token, at + 0.01)
    loud = AmplifierLayer(2, (HIGH(level=0.9),))
    refusal(ledger, loud, at=at + 0.025)
    assert ledger.admit([loud], at + 1.0)


def test_check_that_fails_refuses_and_leaves_silence_possible() -> None:
    """Whatever goes wrong in checking: refused, nothing is noted, and a silent set is admitted."""
    ledger = Ledger(WIDE, CAN)
    play(ledger, 1, 0.0, AmplifierLayer(0, (tone(),)))
    broken = replace(tone(1), onset=object())  # type: ignore[arg-type]
    refusal(ledger, AmplifierLayer(1, (broken,)))
    assert ledger.doubt is None
    assert ledger.playback.tokens == {0: 1}
    assert ledger.admit([AmplifierLayer(0, ())], 1.0)


def test_doubt_admits_silence_only_until_it_is_resolved() -> None:
    """By confirmation, or by a status with another token; nothing is kept of refused sets."""
    ledger = Ledger(WIDE, CAN)
    layer = AmplifierLayer(0, (tone(),))
    ledger.sent(7, ledger.admit([layer], 0.0), 0.0)
    assert ledger.doubt.token == 7
    refusal(ledger, layer)
    assert ledger.admit([AmplifierLayer(0, ())], 1.0)
    ledger.resolve(6, 1.0)
    assert (ledger.doubt, ledger.playback.level(0, 1.0)) == (None, 0.0)
    ledger.sent(8, ledger.admit([layer], 1.0), 1.0)
    ledger.resolve(8, 1.01)
    assert ledger.playback.level(0, 2.0) == pytest.approx(0.5)


def random_layer(random_: random.Random, number: int) -> AmplifierLayer:
    """A layer of up to three tones of three frequencies, with shapes, fades and ends."""

    def shape() -> Envelope | None:
        if random_.random() < 0.6:
            return None
        knots = [(random_.randrange(5000), random_.randrange(-18000, 18000)) for _ in range(3)]
        return Envelope(random_.choice((20, 100)), tuple(knots[: random_.randrange(4)]))

    tones = tuple(
        AmplifierTone(
            channel,
            random_.choice((100.0, 150.0, 200.0)),
            random_.choice((0.0, 0.2, 0.4, 0.7)),
            random_.uniform(-180, 180),
            keep_phase=random_.random() < 0.5,
            skip_ending=random_.random() < 0.3,
            onset=shape(),
            ending=shape(),
        )
        for channel in random_.sample(range(3), random_.randrange(4))
    )
    ramp = random_.choice((0.005, 0.02, 0.08)) if tones else 0.08  # silence is never refused
    valid_for = random_.choice((0.0, 0.05, 0.2))
    if valid_for and random_.random() < 0.1:
        return AmplifierLayer(number, renew=True, valid_for=valid_for)
    return AmplifierLayer(
        number, tones, ramp, valid_for, after=bool(tones) and random_.random() < 0.2
    )


@pytest.mark.parametrize("seed", range(12))
def test_what_is_admitted_stays_within_the_limits_whenever_it_is_played(seed: int) -> None:
    """Random sets, each played up to 90 ms after it was sent: level, power and rise every 0.5 ms.

    A jump of a ramp counts within one step of the sampling.
    """
    random_ = random.Random(seed)
    limits = replace(WIDE, level=0.9, power=1.2, slew=random_.choice((60.0, 150.0, math.inf)))
    ledger, plays = Ledger(limits, CAN), Playback(3, 16)
    now, step, admitted = 0.0, 0.0005, 0
    before = [0.0] * 3
    for token in range(1, 120):
        numbers = random_.sample(range(3), random_.choice((1, 1, 2)))
        try:
            layers = ledger.admit([random_layer(random_, number) for number in numbers], now)
        except CommandRefused:
            layers = ()
        commit = now + random_.choice((0.0, 0.001, 0.01, 0.09))
        until = max(commit + 0.002, now + random_.choice((0.012, 0.03, 0.1)))
        if layers:
            admitted += 1
            ledger.sent(token, layers, now)
        while now < until:
            now += step
            if layers and now >= commit:
                plays.commit(layers, token, commit)
                layers = ()
            plays.advance(now)
            levels = [plays.level(channel, now) for channel in range(3)]
            assert max(levels) <= 0.9 * (1 + 1e-6)
            assert sum(level**2 for level in levels) <= 1.2 * (1 + 1e-6)
            rises = [(new - old) / step for new, old in zip(levels, before, strict=True)]
            assert max(rises) <= limits.slew * (1 + 1e-6)
            before = levels
        ledger.resolve(token, min(commit + 0.001, until))
    assert admitted > 20


@in_virtual_time
async def test_read_behind_a_write_whose_response_was_found_late_is_awaited() -> None:
    """Modbus: only the last look at the port finds that response; the status comes 20 ms on."""
    end = MemoryLine("tcp", "a")
    (host,) = end.hosts.values()
    await host.open()
    unread: list[bytes] = []

    def poll() -> None:
        end.outward = lambda name, data: [(0.02, data)]
        while unread:
            end.line.received(unread.pop())

    end.poll = poll  # type: ignore[method-assign]
    end.outward = lambda name, data: unread.append(data) or []  # type: ignore[func-returns-value]
    await host.read_status()
    assert host.counts.retries == 0


IN_PLACE: Mapping[str, tuple[str, Callable[[bytes], bytes], str]] = {
    # What stands in place of each reply, by hand, and what the error must name.
    "serial, wrong speed": ("serial", lambda data: b"\xf8\x80" * 9, "bytes .*f8 80.*baud rate"),
    "serial, damaged": (
        "serial",
        lambda data: data[:-5] + b"\1" + data[-4:],
        "no valid frame.*cable",
    ),
    "serial, echo": (
        "serial",
        lambda data: encode_frame(Frame(9, 1, 4, b"", 3)),
        "request itself came back",
    ),
    "serial, late": (
        "serial",
        lambda data: encode_frame(Frame(0x89, 1, 3, b"", 3)),
        "address 1 to another request.*delays",
    ),
    "rtu, wrong speed": ("rtu", lambda data: b"\xf8\x80" * 9, "18 bytes .*f8 80.*parity"),
    "can, text that is none": ("can", lambda data: frames((0x800, b"\xf8")), r"\(f8\).*baud rate"),
    "rtu, other unit": (
        "rtu",
        lambda data: bytes.fromhex("02 90 01 7d c0"),
        "unit 2.*check the unit",
    ),
    "tcp, transaction 0": (
        "tcp",
        lambda data: b"\0\0" + data[2:],
        "transaction 0, unit 1.*gateway",
    ),
    "tcp, unit 255": (
        "tcp",
        lambda data: data[:6] + b"\xff" + data[7:],
        "unit 255.*check the unit",
    ),
    "tcp, exception 10": ("tcp", lambda data: data[:5] + b"\3\1\x90\x0a", "no path to unit 1"),
    "tcp, exception 11": ("tcp", lambda data: data[:5] + b"\3\1\x90\x0b", "no response of unit 1"),
    "tcp, RTU in it": ("tcp", lambda data: b"\1\x10\x09\0\0\1\2\x55", r"Modbus TCP.*modbus\+rtu"),
    "can, other node": ("can", lambda data: frames((0x705, b"\5")), "node 5 came .* of node 1:"),
    "can, heartbeat": (
        "can",
        lambda data: frames((0x701, b"\5"), (0x702, b"\5")),
        "node 1 came in place of .* of node 1:",
    ),
    "can, BEL": ("can", lambda data: frames((0x800, b"\7")), r"adapter .*\(07\).*termination"),
}


def frames(*given: tuple[int, bytes]) -> bytes:
    """Frames by identifier and data, as a port of frames has them."""
    return pack_frames(starmap(CanFrame, given))


@pytest.mark.parametrize("case", IN_PLACE)
@in_virtual_time
async def test_error_of_no_reply_names_what_came_in_its_place(case: str) -> None:
    """And what to check, which differs; as does the reason why nothing new is played."""
    wire, in_place, named = IN_PLACE[case]
    end = MemoryLine(wire, "a")
    (host,) = end.hosts.values()
    await host.open()
    end.outward = lambda name, data: [(0.0002, in_place(data))]
    with pytest.raises(LinkTimeout, match=f"no reply within 30 ms, but .*{named}"):
        await host.read_status()
    assert re.search(named, host.no_reply_cause or "")
    end.outward = unaltered
    await host.read_status()
    end.outward = lambda name, data: []
    with pytest.raises(LinkTimeout, match="30 ms; check that the amplifier is switched on"):
        await host.read_status()
    end = MemoryLine("serial", "a")  # its replies to Hello, of type 81, alone arrive
    end.outward = lambda name, data: unaltered(name, data) * (data[2:3] == b"\x81")
    with pytest.raises(LinkTimeout, match="; it answered Hello, but not GetCaps"):
        await end.hosts["a"].open()


@pytest.mark.parametrize(("wire", "named"), [("serial", "flow control"), ("can", "acknowledges")])
@in_virtual_time
async def test_error_of_a_port_that_takes_nothing_names_what_to_check(
    wire: str, named: str
) -> None:
    """A bus on which no node acknowledges fills the queue of its adapter."""
    end = MemoryLine(wire, "a")
    end.is_blocked = True
    end.inward = lambda name, data: []
    with pytest.raises(LinkTimeout, match=named):
        await end.hosts["a"].open()


async def test_stop_supersedes_what_feeds_plays_arms_or_acknowledges() -> None:
    """Of requests that wait; what reads goes on waiting."""
    result = asyncio.get_running_loop().create_future()
    waiting = [Job(None, priority, "", 0.03, 0.0, result=result) for priority in Priority]
    obsolete = {job.priority for job in waiting if job.is_superseded_by(Priority.STOP, None)}
    assert obsolete == {Priority.HEARTBEAT, Priority.SET, Priority.ARM, Priority.CLEAR}
