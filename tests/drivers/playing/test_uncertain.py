"""Bounds of what plays contain what every amplifier plays that committed within the intervals."""

import random

import pytest

from drivers.playing import Playback
from drivers.protocol.sets import Command, Envelope, LayerSet
from era_haptics.lab.expected_output import ExpectedOutputs, UncertainPlayback

CHANNELS, LAYERS = 2, 3
FREQUENCIES = (400, 2200)  # 20 and 110 Hz
AMPLIFIERS = 12  # of each course
ROUNDING = 1e-9


def random_envelope(chance: random.Random) -> Envelope | None:
    """None, or up to three knots."""
    if chance.random() < 0.6:
        return None
    knots = [
        (chance.randrange(3000), chance.randrange(-9000, 9000)) for _ in range(chance.randrange(4))
    ]
    return Envelope(chance.choice((50, 200, 500)), tuple(knots))


def random_layer(chance: random.Random) -> LayerSet:
    """What a layer may be sent: tones, silence, a renewal, or a set that waits."""
    number, ramp = chance.randrange(LAYERS), chance.choice((0, 5, 40, 120))
    valid_for = chance.choice((0, 0, 30, 90))
    kind = chance.random()
    if kind < 0.15:
        return LayerSet(number, 0, valid_for, (), False, True)
    commands = tuple(
        Command(
            channel,
            chance.choice(FREQUENCIES),
            chance.choice((0, 1500, 3000)),
            chance.randrange(-18000, 18000, 500),
            chance.random() < 0.4,
            chance.random() < 0.2,
            random_envelope(chance),
            random_envelope(chance),
        )
        for channel in range(CHANNELS)
        if chance.random() < 0.8
    )
    return LayerSet(number, ramp, valid_for, commands, bool(commands) and kind > 0.85, False)


def check_course(seed: int) -> None:
    """Send sets to amplifiers that each commit them at times of their own; compare levels."""
    chance = random.Random(seed)
    bounds = UncertainPlayback(Playback(CHANNELS, 64))
    amplifiers = [Playback(CHANNELS, 64) for _ in range(AMPLIFIERS)]
    now, last_token = 0.0, 0
    for _ in range(8):
        begin = now + chance.choice((0.0, 0.001, 0.02, 0.1))
        end = begin + chance.choice((0.0, 0.002, 0.01))
        moments = [
            chance.choice((begin, end, chance.uniform(begin, end))) for _ in range(AMPLIFIERS)
        ]
        one = random_layer(chance)
        layers, ramp = (None if chance.random() < 0.1 else [one]), chance.choice((0.0, 0.03))
        if bounds.is_ambiguous((begin, end), layers, ramp):
            continue
        if layers is None:
            bounds.silence((begin, end), ramp)
            for each, moment in zip(amplifiers, moments, strict=True):
                each.silence(moment, ramp)
        else:
            last_token += 1
            bounds.commit([one], last_token, (begin, end))
            for each, moment in zip(amplifiers, moments, strict=True):
                each.commit([one], last_token, moment)
        now = end
        for _ in range(3):
            begin = now + chance.choice((0.0, 0.004, 0.03))
            now = begin + chance.choice((0.0, 0.003))
            for each in amplifiers:
                moment = chance.uniform(begin, now)
                each.advance(moment)
                expect_bounded(each, moment, bounds, (begin, now))


def expect_bounded(
    one: Playback, moment: float, bounds: UncertainPlayback, when: tuple[float, float]
) -> None:
    """Require that each channel's level is within the bounds of what may play."""
    for channel in range(CHANNELS):
        for is_exact in (True, False):
            low, high = bounds.bounds(channel, *when, is_exact=is_exact)
            level = one.level(channel, moment)
            assert low - ROUNDING <= level <= high + ROUNDING, (channel, is_exact, moment)


@pytest.mark.parametrize("seed", [*range(40), 68, 508, 771, 1284])
def test_bounds_contain_every_amplifier(seed: int) -> None:
    """Whenever within its interval it carried each set out, early, late, or in between."""
    check_course(seed)


def test_set_that_comes_as_another_layer_may_end_is_ambiguous() -> None:
    """By hand: what began within 0 to 60 ms and is valid for 100 ends within 100 to 160 ms."""
    bounds = UncertainPlayback(Playback(2, 8))
    first = LayerSet(0, 0, 100, (Command(0, 2200, 5000, 0),))
    bounds.commit([first], 1, (0.0, 0.06))
    other = LayerSet(1, 0, 0, (Command(1, 400, 5000, 0),))
    cases = (0.09, 0.099), (0.09, 0.101), (0.131, 0.133), (0.159, 0.17), (0.161, 0.17)
    found = [bounds.is_ambiguous(when, [other]) for when in cases]
    assert found == [False, True, True, True, False]
    bounds.commit([other], 2, (0.131, 0.133))  # for whoever cannot wait for another moment
    assert bounds.bounds(0, 0.134, 0.136) == pytest.approx((0.0, 0.5))
    assert bounds.bounds(0, 0.161, 0.162) == (0.0, 0.0)


def test_layer_may_have_ended_just_before_all_falls_silent() -> None:
    """By hand: it ends at once within 100 to 112 ms, and all fades for 50 ms from 110 ms on."""
    found: list[str] = []

    def report(rule: str, *_: object, **__: object) -> None:
        found.append(rule)

    began = 0.0, 0.0
    outputs = ExpectedOutputs({}, report=report, unclear=None, slack=0.0, cause="", began=began)
    ended = Command(0, 2200, 5000, 0, ending=Envelope(10, ()))
    outputs.play([LayerSet(0, 0, 100, (ended,))], 1, (0.0, 0.01), is_exact=True)
    outputs.silence((0.11, 0.112), 0.05, "Disarm")
    assert not outputs.sure((0.113, 0.113))
    assert outputs.sure((0.17, 0.17))
    outputs.check_levels([0.1], (0.17, 0.17), report)
    assert found == ["silent"]


@pytest.mark.parametrize("by_a_set", [False, True])
@pytest.mark.parametrize(("begins", "is_known"), [(1.01, True), (1.02, False), (1.03, True)])
def test_way_to_silence_that_a_ramp_may_shorten_or_not_is_unknown_until_both_are_over(
    begins: float, is_known: bool, by_a_set: bool
) -> None:
    """By hand: an ending or an onset to 0 of 40 ms begins within 1.000 to 1.002 s.

    A ramp of 20 ms begins within 2.5 ms, of a silence or of a set. From 1.01 s on it arrives before
    the way, from 1.03 s on behind it; from 1.02 s on within 1.0400 to 1.0425 s, and the way within
    1.040 to 1.042 s.
    """
    found: list[str] = []

    def report(rule: str, *_: object, **__: object) -> None:
        found.append(rule)

    began = 0.0, 0.0
    outputs = ExpectedOutputs({}, report=report, unclear=None, slack=0.0, cause="", began=began)
    way, when = Envelope(100, ((5000, 0),) * 3), (begins, begins + 0.0005)
    if by_a_set:
        rises = Command(0, 2200, 0, 0, onset=way)
        outputs.play([LayerSet(0, 0, 0, (rises,))], 1, (1.0, 1.0), is_exact=True)
        outputs.play([LayerSet(0, 20, 0, ())], 2, when, is_exact=True)
    else:
        ends = Command(0, 2200, 5000, 0, ending=way)
        outputs.play([LayerSet(0, 0, 0, (ends,))], 1, (0.0, 0.0), is_exact=True)
        outputs.play([LayerSet(0, 20, 0, ())], 2, (1.0, 1.0), is_exact=True)
        outputs.silence(when, 0.02, "Silence")
    assert bool(outputs.sure((begins + 0.003, begins + 0.003))) is is_known
    assert outputs.sure((1.06, 1.06))
    outputs.check_levels([0.1], (1.06, 1.06), report)
    assert found == ["plays" if by_a_set else "silent"]


def test_tones_that_may_cancel_leave_those_of_other_frequencies_what_they_play() -> None:
    """By hand: 0.5 at 20 Hz lasts; three tones of 0.3 at 110 Hz cancel, or are added up to 0.9."""
    bounds = UncertainPlayback(Playback(1, 8))
    thirds = [(2200, 3000, degrees) for degrees in (0, 12000, -12000)]
    for number, (frequency, level, phase) in enumerate([(400, 5000, 0), *thirds]):
        one = LayerSet(number, 0, 0, (Command(0, frequency, level, phase),))
        bounds.commit([one], number + 1, (0.1 * number, 0.1 * number + 0.001))
    assert bounds.bounds(0, 1.0, 1.01) == pytest.approx((0.5, 1.4))
    assert bounds.bounds(0, 1.0, 1.01, is_exact=True) == pytest.approx((0.5, 0.5))


def test_bounds_are_no_wider_than_need_be() -> None:
    """By hand: a rise to 0.5 along 100 ms that began within 2 ms is at 0.25 at half, +/- 0.008."""
    bounds = UncertainPlayback(Playback(1, 8))
    bounds.commit([LayerSet(0, 100, 0, (Command(0, 2200, 5000, 0),))], 1, (0.0, 0.002))
    low, high = bounds.bounds(0, 0.051, 0.051)
    # The steepest change of a raised cosine is pi/2 of its height in its duration.
    steepest = 0.5 * 3.1416 / 2 / 0.1 * 0.001
    assert 0.25 - 1.001 * steepest <= low < 0.25 < high <= 0.25 + 1.001 * steepest
    bounds.commit([LayerSet(0, 0, 0, (Command(0, 2200, 5000, 0, True),))], 2, (0.2, 0.21))
    assert bounds.bounds(0, 0.22, 0.23) == pytest.approx((0.5, 0.5))
