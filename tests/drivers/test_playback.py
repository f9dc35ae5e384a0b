"""Playback of layers against curves calculated by hand, and its bounds.

The bounds of an uncertain playback must contain every amplifier that committed each set at some
moment of its interval.
"""

import math
import random
from itertools import product

import pytest

from drivers.playing import Playback
from drivers.protocol.sets import Command, Envelope, LayerSet
from drivers.voices import Voice, along
from era_haptics.lab.expectations.expected_outputs import ExpectedOutputs
from era_haptics.lab.expectations.tolerances import Interval
from era_haptics.lab.expectations.uncertain_playback import UncertainPlayback

FOREVER = 0.0
"""A layer with this `valid_for` [s] plays until it is replaced."""


def tone(
    frequency: float,
    level: float,
    *,
    channel: int = 0,
    phase: float = 0.0,
    keep_phase: bool = False,
    onset: Envelope | None = None,
    ending: Envelope | None = None,
) -> Command:
    """Return a tone with its frequency [Hz], level [1 is full] and phase [degrees]."""
    return Command(
        channel,
        round(frequency * 20),
        round(level * 10_000),
        round(phase * 100),
        keep_phase,
        onset=onset,
        ending=ending,
    )


def layer(
    *tones: Command,
    number: int = 0,
    ramp: float = 0.0,
    valid_for: float = FOREVER,
    after: bool = False,
) -> LayerSet:
    """Return a layer with its ramp and its time of validity [s]."""
    return LayerSet(number, round(ramp * 1000), round(valid_for * 1000), tones, after)


def at(moment: float) -> Interval:
    """Return an interval that is one moment [s]."""
    return Interval(moment, moment)


class OutputObserver:
    """Expected outputs of an amplifier that is silent at 0 s, and the rules that it breaks."""

    def __init__(self) -> None:
        self.broken_rules: list[str] = []
        self.expected = ExpectedOutputs(
            {},
            report=self._note,
            unclear=None,
            slack=0.0,
            cause="",
            began=at(0.0),
        )

    def _note(self, rule: str, *_: object, **__: object) -> None:
        self.broken_rules.append(rule)

    def play(self, layer_set: LayerSet, token: int, start: Interval) -> None:
        """Expect a layer that starts, exactly as it was sent, at some moment of an interval."""
        self.expected.play([layer_set], token, start, is_exact=True)

    def knows_layer_0(self, moment: float) -> bool:
        """Whether the output of layer 0 is known at a moment [s]."""
        return 0 in self.expected.sure(at(moment))

    def show_level(self, level: float, moment: float) -> None:
        """Compare a level of the first channel, reported at a moment [s], with what is expected."""
        self.expected.check_levels([level], at(moment), self._note)


def test_slope_counts_the_whole_onset_before_it_starts() -> None:
    """By hand: from 0 to 0.4 in 4 ms, then flat for 16 ms: 100 full levels/s are still to come."""
    onset = Envelope(40, ((4000, 0),) * 4)
    transition = along(onset, 1.0, 0.0, 0j, 0.4 + 0j)
    for time in (0.9, 0.994, 1.0, 1.003):
        assert transition.slope(time) == pytest.approx(100.0)
    assert transition.slope(1.005) == 0.0


@pytest.mark.parametrize(("valid_for", "end"), [(1000, 1.4), (0, 0.008)])
def test_layer_at_level_zero_is_silent_once_its_ending_is_over(valid_for: int, end: float) -> None:
    """By hand: after 1 s its ending takes four steps of 0.1 s; without end, an onset takes 8 ms."""
    onset = Envelope(40, ((5000, 0),))
    ending = Envelope(1000, ((8000, 0),) * 3)
    playback = Playback(1, 8)
    tone = Command(0, 4000, 0, 0, onset=onset, ending=ending)
    playback.commit([LayerSet(0, 0, valid_for, (tone,))], 1, 0.0)
    assert playback.ends_by == pytest.approx(end)


def test_playback_phase_of_a_command_is_a_lead_on_every_channel() -> None:
    """By hand: 0.5 at 90 degrees is 0.5i; 0.2 at -30 degrees is 0.1732 - 0.1i."""
    playback = Playback(2, 8)
    first = tone(100.0, 0.5, phase=90.0)
    second = tone(100.0, 0.2, channel=1, phase=-30.0)

    playback.commit([layer(first, second)], 1, 0.0)

    amplitudes = [voice.transition.last for (voice,) in playback.all_voices]
    assert amplitudes == pytest.approx([0.5j, 0.2 * math.sqrt(0.75) - 0.1j])


def test_uncertain_playback_is_ambiguous_while_another_layer_may_end() -> None:
    """A layer that began within 0 to 60 ms and is valid for 100 ms ends within 100 to 160 ms."""
    playback = UncertainPlayback(Playback(2, 8))
    playback.commit([layer(tone(110.0, 0.5), valid_for=0.1)], 1, Interval(0.0, 0.06))
    new_layer = layer(tone(20.0, 0.5, channel=1), number=1)

    assert not playback.is_ambiguous(Interval(0.09, 0.099), [new_layer])
    assert playback.is_ambiguous(Interval(0.09, 0.101), [new_layer])
    assert playback.is_ambiguous(Interval(0.131, 0.133), [new_layer])
    assert playback.is_ambiguous(Interval(0.159, 0.17), [new_layer])
    assert not playback.is_ambiguous(Interval(0.161, 0.17), [new_layer])


def test_uncertain_playback_bounds_are_no_wider_than_a_ramp_requires() -> None:
    """A rise to 0.5 in 100 ms, begun within 2 ms, is at 0.25 +/- 0.00786 after half of the time.

    The steepest change of a raised cosine is pi/2 of its height in its duration.
    """
    playback = UncertainPlayback(Playback(2, 8))
    playback.commit([layer(tone(110.0, 0.5), ramp=0.1)], 1, Interval(0.0, 0.002))

    lowest, highest = playback.bounds(0, 0.051, 0.051)
    steepest_change = math.pi / 2 * 0.5 * 0.001 / 0.1
    assert 0.25 - 1.001 * steepest_change <= lowest < 0.25
    assert 0.25 < highest <= 0.25 + 1.001 * steepest_change

    playback.commit([layer(tone(110.0, 0.5, keep_phase=True))], 2, Interval(0.2, 0.21))
    assert playback.bounds(0, 0.22, 0.23) == pytest.approx((0.5, 0.5))


FLAT_40_MS = Envelope(100, ((5000, 0),) * 3)
"""Four steps of 10 ms, the first three of which keep the level."""


@pytest.mark.parametrize(("arrival", "is_known"), [(1.01, True), (1.02, False), (1.03, True)])
def test_expected_outputs_are_unknown_while_a_silence_may_overtake_an_ending(
    arrival: float, is_known: bool
) -> None:
    """An ending begins at 1.000 to 1.002 s and takes 40 ms; the ramp of the silence takes 20 ms.

    A silence that arrives at 1.01 s ends first, and one at 1.03 s ends last. One at 1.02 s ends at
    1.0400 to 1.0425 s, and the ending at 1.040 to 1.042 s: either may be the first.
    """
    amplifier = OutputObserver()
    amplifier.play(layer(tone(110.0, 0.5, ending=FLAT_40_MS)), 1, at(0.0))
    amplifier.play(layer(ramp=0.02), 2, at(1.0))

    amplifier.expected.silence(Interval(arrival, arrival + 0.0005), 0.02, "Silence")

    assert amplifier.knows_layer_0(arrival + 0.003) == is_known
    assert amplifier.knows_layer_0(1.06)
    amplifier.show_level(0.1, 1.06)
    assert amplifier.broken_rules == ["silent"]


def test_playback_of_random_sets_never_jumps_and_stays_below_its_peak() -> None:
    """Amplitudes change no faster than `slope` and never exceed `peak`, whatever is committed."""
    chance = random.Random(4)
    for _ in range(60):
        playback = Playback(1, 8)
        time = 0.0
        token = 0
        for _ in range(12):
            time += chance.choice((0.0007, 0.004, 0.013, 0.03))
            if chance.random() < 0.1:
                playback.silence(time, chance.choice((0.005, 0.05)))
            else:
                token += 1
                playback.commit([random_layer(chance)], token, time)
            voices = playback.all_voices[0]
            peak = sum(voice.transition.peak(time) for voice in voices)
            slope = sum(voice.transition.slope(time) for voice in voices)
            amplitude = total_amplitude(voices, time)
            for _ in range(12):
                elapsed = chance.random() * 5e-4
                later_amplitude = total_amplitude(voices, time + elapsed)
                assert playback.level(0, time + elapsed) <= peak + 1e-9
                assert abs(later_amplitude - amplitude) <= slope * elapsed + 1e-9


def total_amplitude(voices: tuple[Voice, ...], time: float) -> complex:
    """Return the sum of all amplitudes, as if all tones had the same frequency."""
    return sum((voice.transition.at(time) for voice in voices), 0j)


@pytest.mark.parametrize(
    ("slew", "duration"), [(math.inf, 0.002), (10.0, math.pi / 20)], ids=["any", "10 levels/s"]
)
def test_playback_cuts_a_fade_short_as_fast_as_the_amplifier_can(
    slew: float, duration: float
) -> None:
    """A raised cosine from 1 is steepest at pi/2 over its length: 157 ms at 10 full levels/s."""
    playback = Playback(1, 8, slew)
    playback.commit([layer(tone(100.0, 1.0), ramp=0.02)], 1, 0.0)

    for number in range(9):
        next_layer = layer(tone(150.0 + 0.05 * number, 0.5), ramp=1.0)
        playback.commit([next_layer], 2 + number, 1.0 + 1e-6 * number)

    fade = playback.all_voices[0][0].transition
    assert fade.end - fade.start == pytest.approx(duration, rel=1e-3)


CHANNELS = 2
LAYERS = 3
AMPLIFIERS = 12


def random_envelope(chance: random.Random) -> Envelope | None:
    """Return None or an envelope of up to three knots."""
    if chance.random() < 0.6:
        return None
    knots = []
    for _ in range(chance.randrange(4)):
        knots.append((chance.randrange(3000), chance.randrange(-9000, 9000)))
    return Envelope(chance.choice((50, 200, 500)), tuple(knots))


def random_layer(chance: random.Random) -> LayerSet:
    """Return a layer as a host may send it: tones, silence, a renewal, or a set that waits."""
    number = chance.randrange(LAYERS)
    ramp = chance.choice((0, 5, 40, 120))
    valid_for = chance.choice((0, 0, 30, 90))
    kind = chance.random()
    if kind < 0.15:
        return LayerSet(number, 0, valid_for, (), renew=True)
    commands = []
    for channel in range(CHANNELS):
        if chance.random() < 0.2:
            continue
        command = Command(
            channel,
            frequency=chance.choice((400, 2200)),
            level=chance.choice((0, 1500, 3000)),
            phase=chance.randrange(-18000, 18000, 500),
            keep_phase=chance.random() < 0.4,
            skip_ending=chance.random() < 0.2,
            onset=random_envelope(chance),
            ending=random_envelope(chance),
        )
        commands.append(command)
    waits = bool(commands) and kind > 0.85
    return LayerSet(number, ramp, valid_for, tuple(commands), after=waits)


@pytest.mark.parametrize("seed", [*range(40), 68, 508, 771, 1284])
def test_uncertain_playback_bounds_contain_every_amplifier(seed: int) -> None:
    """Each amplifier carries out each set at the start, at the end, or within its interval."""
    chance = random.Random(seed)
    bounds = UncertainPlayback(Playback(CHANNELS, 64))
    amplifiers = [Playback(CHANNELS, 64) for _ in range(AMPLIFIERS)]
    now = 0.0
    for token in range(1, 9):
        begin = now + chance.choice((0.0, 0.001, 0.02, 0.1))
        end = begin + chance.choice((0.0, 0.002, 0.01))
        is_silence = chance.random() < 0.1
        layers = None if is_silence else [random_layer(chance)]
        ramp = chance.choice((0.0, 0.03))
        if bounds.is_ambiguous(Interval(begin, end), layers, ramp):
            continue
        if layers is None:
            bounds.silence(Interval(begin, end), ramp)
        else:
            bounds.commit(layers, token, Interval(begin, end))
        for amplifier in amplifiers:
            moment = chance.choice((begin, end, chance.uniform(begin, end)))
            if layers is None:
                amplifier.silence(moment, ramp)
            else:
                amplifier.commit(layers, token, moment)
        now = end
        for _ in range(3):
            begin = now + chance.choice((0.0, 0.004, 0.03))
            now = begin + chance.choice((0.0, 0.003))
            for amplifier in amplifiers:
                moment = chance.uniform(begin, now)
                amplifier.advance(moment)
                for channel, is_exact in product(range(CHANNELS), (True, False)):
                    low, high = bounds.bounds(channel, begin, now, is_exact=is_exact)
                    level = amplifier.level(channel, moment)
                    assert low - 1e-9 <= level <= high + 1e-9, (channel, is_exact, moment)
