"""Two voices a channel, against the words of the wire protocol and a channel of two oscillators."""

import cmath
import math
from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.protocol.messages import (
    Achieved,
    Apply,
    Arm,
    Commit,
    Disarm,
    GetStatus,
    LoadEnvelope,
    Nak,
    NakCode,
    Ping,
    Request,
    Stage,
    Status,
    Stop,
)
from sim.amplifier.amplifier import SimulatedAmplifier

SESSION = 9
REFUSED = Nak(NakCode.FADING, 0)


def tone(token: int, frequency: float = 110.0, *, level: float = 0.5, ramp: float = 0.2, **how):
    """A set that drives channel 0."""
    command = DriveCommand(0, frequency, level, **how)
    return CommandSet(token, (command,), ramp=ramp, valid_for=0.0)


@pytest.fixture
def amplifier() -> SimulatedAmplifier:
    """Armed at 0 s; token 1 plays at 110 Hz, token 2 at 150 Hz since 0.1 s along 200 ms."""
    amplifier = SimulatedAmplifier("main", channels=2, voices=2)
    amplifier.handle(Arm(2.0, SESSION), 0.0)
    assert isinstance(amplifier.handle(Apply(tone(1, ramp=0.0), SESSION), 0.0), Achieved)
    assert isinstance(amplifier.handle(Apply(tone(2, 150.0), SESSION), 0.1), Achieved)
    return amplifier


def status(amplifier: SimulatedAmplifier, now: float) -> Status:
    """Its status."""
    reply = amplifier.handle(GetStatus(), now)
    assert isinstance(reply, Status)
    return reply


def test_third_voice_is_refused_and_the_fade_goes_on(amplifier: SimulatedAmplifier) -> None:
    """Applied or committed; its watchdog is not fed, and what is staged stays staged."""
    assert isinstance(amplifier.handle(Stage(tone(7), SESSION), 0.12), Achieved)
    assert amplifier.handle(Apply(tone(3, 190.0), SESSION), 0.15) == REFUSED
    assert amplifier.handle(Commit(7, SESSION), 0.2) == REFUSED
    now = status(amplifier, 0.2)
    assert (now.token, now.watchdog_left) == (2, pytest.approx(2.0 - 0.08))
    assert now.levels[0] == pytest.approx(0.5)  # halfway: a quarter each, added
    assert status(amplifier, 0.3).levels[0] == pytest.approx(0.5)
    assert isinstance(amplifier.handle(Commit(7, SESSION), 0.301), Achieved)


def test_level_of_two_voices_of_one_frequency_is_that_of_their_sum() -> None:
    """Opposite phases cancel halfway."""
    amplifier = SimulatedAmplifier("main", channels=1, voices=2)
    amplifier.handle(Arm(2.0, SESSION), 0.0)
    amplifier.handle(Apply(tone(1, 100.0, ramp=0.0), SESSION), 0.0)
    amplifier.handle(Apply(tone(2, 100.0, phase=-180.0), SESSION), 0.1)  # ten periods later
    assert status(amplifier, 0.2).levels[0] == pytest.approx(0.0, abs=1e-9)
    assert status(amplifier, 0.15).levels[0] == pytest.approx(0.5 * math.cos(math.pi / 4))


@pytest.mark.parametrize(
    "request_",
    [
        Apply(tone(3, 190.0, ramp=0.0), SESSION),
        Apply(CommandSet(3, (), ramp=0.2, valid_for=0.0), SESSION),
        Apply(tone(3, level=0.0), SESSION),
        Apply(CommandSet(3, (DriveCommand(1, 90.0, 0.5),), ramp=0.2, valid_for=0.0), SESSION),
        Stage(tone(3), SESSION),
        *(Stop(0.2), Disarm(0.2), Ping(SESSION)),
    ],
    ids=["no ramp", "empty", "silent", "another channel", "Stage", "Stop", "Disarm", "Ping"],
)
def test_what_needs_no_third_voice_is_never_refused(
    amplifier: SimulatedAmplifier, request_: Request
) -> None:
    """During the fade."""
    assert not isinstance(amplifier.handle(request_, 0.15), Nak)


def test_silenced_voices_leave_room_once_they_have_ended(amplifier: SimulatedAmplifier) -> None:
    """The older along its own ramp, sooner than that of the silence."""
    amplifier.handle(Apply(CommandSet(3, (), ramp=0.5, valid_for=0.0), SESSION), 0.2)
    assert amplifier.handle(Apply(tone(4), SESSION), 0.299) == REFUSED
    assert isinstance(amplifier.handle(Apply(tone(5), SESSION), 0.301), Achieved)
    assert amplifier.handle(Apply(tone(6), SESSION), 0.302) == REFUSED


def test_onset_that_continues_a_voice_takes_its_place(amplifier: SimulatedAmplifier) -> None:
    """With keep phase and its frequency; another one would be a third voice."""
    amplifier.handle(LoadEnvelope(Envelope(1, 0.01, (Knot(0.2, 0.0),))), 0.15)
    new = tone(3, 150.0, onset=1)
    assert amplifier.handle(Apply(new, SESSION), 0.2) == REFUSED
    same = tone(4, 150.0, onset=1, keep_phase=True)
    assert isinstance(amplifier.handle(Apply(same, SESSION), 0.2), Achieved)
    assert [len(output) for output in amplifier.outputs] == [2, 0]


def test_channel_that_falls_silent_keeps_no_phase(amplifier: SimulatedAmplifier) -> None:
    """Its next voice counts t from its own commit, while the one before still fades."""
    amplifier.handle(Apply(CommandSet(3, (), ramp=0.5, valid_for=0.0), SESSION), 0.31)
    amplifier.handle(Apply(tone(4, 150.0, keep_phase=True), SESSION), 0.4)
    assert [one.origin for one in amplifier.outputs[0]] == [0.1, 0.4]


@pytest.mark.parametrize("others", [(), (DriveCommand(1, 90.0, 0.5),)], ids=["silent", "driving"])
def test_interrupted_ending_ends_when_it_would(others: tuple[DriveCommand, ...]) -> None:
    """By a set with a longer ramp, halfway; a silent one plays no ending again."""
    amplifier = SimulatedAmplifier("main", channels=2)
    amplifier.handle(Arm(2.0, SESSION), 0.0)
    amplifier.handle(LoadEnvelope(Envelope(1, 0.05, (Knot(0.5, 0.0),))), 0.0)
    amplifier.handle(Apply(tone(1, ramp=0.0, ending=1), SESSION), 0.0)
    amplifier.handle(Apply(CommandSet(2, (), ramp=0.0, valid_for=0.0), SESSION), 0.1)
    amplifier.handle(Apply(CommandSet(3, others, ramp=0.2, valid_for=0.0), SESSION), 0.15)
    assert status(amplifier, 0.175).levels[0] == pytest.approx(0.25)  # 0.5 (1 + cos(pi / 2)) / 2
    assert status(amplifier, 0.201).levels[0] == 0.0


def test_same_commands_in_another_order_are_another_set() -> None:
    """An Apply with active_token is refused then, and confirmed otherwise."""
    amplifier = SimulatedAmplifier("main", channels=2)
    amplifier.handle(Arm(2.0, SESSION), 0.0)
    commands = (DriveCommand(0, 110.0, 0.5), DriveCommand(1, 150.0, 0.4))
    first = CommandSet(1, commands, ramp=0.0, valid_for=0.0)
    other = CommandSet(1, commands[::-1], ramp=0.0, valid_for=0.0)
    assert isinstance(amplifier.handle(Apply(first, SESSION), 0.0), Achieved)
    assert isinstance(amplifier.handle(Apply(first, SESSION), 0.1), Achieved)
    assert amplifier.handle(Apply(other, SESSION), 0.2) == Nak(NakCode.BAD_TOKEN)


@dataclass
class Oscillator:
    """A tone whose complex amplitude moves along a raised cosine; silent if it ends at zero."""

    frequency: float = 0.0
    origin: float = 0.0
    start: float = 0.0
    ramp: float = 0.0
    here: complex = 0j
    there: complex = 0j

    def at(self, time: float) -> complex:
        s = min((time - self.start) / self.ramp, 1.0) if self.ramp else 1.0
        return self.here + (self.there - self.here) * (1 - math.cos(math.pi * s)) / 2

    def is_free(self, time: float) -> bool:
        return self.there == 0 and time >= self.start + self.ramp

    def value(self, time: float) -> float:
        turn = cmath.exp(2j * math.pi * self.frequency * (time - self.origin))
        return 0.0 if self.is_free(time) else (self.at(time) * turn).imag

    def fade(self, time: float, ramp: float) -> None:
        if self.there != 0 or self.start + self.ramp > time + ramp:
            self.here, self.there, self.start, self.ramp = self.at(time), 0j, time, ramp


class Channel:
    """A channel as a small microcontroller plays it: two oscillators."""

    def __init__(self) -> None:
        self.oscillators = [Oscillator(), Oscillator()]

    def play(self, time: float, frequency: float, level: complex, ramp: float, keep: bool) -> bool:
        """Play a set, unless no oscillator is free for it."""
        busy = [one for one in self.oscillators if not one.is_free(time)]
        if level and ramp > 0 and len(busy) == 2:
            return False
        lasting = [one for one in busy if one.there != 0 and one.frequency == frequency]
        origin = lasting[0].origin if keep and lasting else time
        for one in busy:
            one.fade(time, ramp)
        if level:
            free = next(n for n, one in enumerate(self.oscillators) if one.is_free(time))
            self.oscillators[free] = Oscillator(frequency, origin, time, ramp, 0j, level)
        return True

    def value(self, time: float) -> float:
        return sum(one.value(time) for one in self.oscillators)


SETS = st.tuples(
    st.sampled_from([0.0002, 0.003, 0.011, 0.2]),  # s; since the last
    st.sampled_from([90.0, 150.0, 210.0]),
    st.sampled_from([0.0, 0.3, 1.0]),
    st.sampled_from([0.0, 90.0]),  # degrees
    st.sampled_from([0.0, 0.005, 0.04, 1.0]),
    st.booleans(),
)


@given(st.lists(SETS, min_size=3, max_size=14))
@settings(max_examples=80, deadline=None)
def test_output_is_that_of_two_oscillators(sets) -> None:
    """Whatever sets come how soon: the same are refused, and what is played has no jump."""
    small, now = Channel(), 0.0
    amplifier = SimulatedAmplifier("main", channels=1, voices=2)
    amplifier.handle(Arm(2.0, SESSION), now)

    def played(time: float) -> float:
        (output,) = amplifier.outputs
        turns = (
            one.amplitude(time) * cmath.exp(2j * math.pi * one.frequency * (time - one.origin))
            for one in output
        )
        return sum(turn.imag for turn in turns)

    for token, (pause, frequency, level, phase, ramp, keep) in enumerate(sets, start=1):
        now += pause
        before = played(now)
        wanted = tone(token, frequency, level=level, phase=phase, ramp=ramp, keep_phase=keep)
        reply = amplifier.handle(Apply(wanted, SESSION), now)
        amplitude = cmath.rect(level, math.radians(phase))
        assert isinstance(reply, Achieved) == small.play(now, frequency, amplitude, ramp, keep)
        if ramp > 0:
            assert played(now) == pytest.approx(before, abs=1e-9)
        for later in (0.0, 0.0011, 0.0027):
            assert played(now + later) == pytest.approx(small.value(now + later), abs=1e-9)
