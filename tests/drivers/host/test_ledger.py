"""Sets that the ledger admits stay within the limits whenever an amplifier plays them."""

import math
import random
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import pytest

from drivers.errors import CommandError, CommandRefused
from drivers.host.ledger import Ledger
from drivers.host.set_admission import SetAdmission, StagedSet
from drivers.playing import AmplifierLayer, AmplifierTone, Playback
from drivers.protocol.sets import Envelope, LayerSet
from registry.limits import GuardLimits
from sim.amplifier.readings import capabilities

WIDE = GuardLimits(20.0, 1000.0, 1.0)
"""Limits that bound frequencies and the full level only."""
CAPABILITIES = capabilities(3)


def tone(
    level: float = 0.5, frequency: float = 100.0, channel: int = 0, **options: Any
) -> AmplifierTone:
    """Return a tone; options: of `AmplifierTone`."""
    return AmplifierTone(channel, frequency, level, **options)


def layer(number: int, *tones: AmplifierTone, **options: Any) -> AmplifierLayer:
    """Return a layer; options: of `AmplifierLayer`."""
    return AmplifierLayer(number, tones, **options)


class Account:
    """A ledger, and the sets that are played on its amplifier."""

    def __init__(self, capabilities: dict[str, Any] = CAPABILITIES, **limits: float) -> None:
        self.ledger = Ledger(replace(WIDE, **limits), capabilities)
        self.token = 0

    def admit(self, time: float, *layers: AmplifierLayer) -> LayerSet:
        """Return the first layer of a set as the ledger admits it at a time [s]."""
        return self.ledger.admit(layers, time)[0]

    def play(self, time: float, *layers: AmplifierLayer, delay: float = 0.0) -> LayerSet:
        """Admit a set, send it, and confirm that it plays after a delay [s]."""
        admitted = self.send(time, *layers)
        self.ledger.resolve(self.token, time + delay)
        return admitted

    def send(self, time: float, *layers: AmplifierLayer) -> LayerSet:
        """Admit a set and send it, without a reply."""
        admitted = self.ledger.admit(layers, time)
        self.token += 1
        self.ledger.sent(self.token, admitted, time)
        return admitted[0]

    def refuse(self, time: float, *layers: AmplifierLayer) -> CommandRefused:
        """Return the error with which a set is refused at a time [s]."""
        with pytest.raises(CommandRefused) as refusal:
            self.ledger.admit(layers, time)
        return refusal.value


INVALID_TONES = {
    "frequency": tone(frequency=1001.0, channel=1),
    "frequency below": tone(frequency=19.9, channel=1),
    "frequency nan": tone(frequency=math.nan, channel=1),
    "level": tone(1.0001, channel=1),
    "level nan": tone(math.nan, channel=1),
    "level negative": tone(-0.1, channel=1),
    "phase": tone(phase=math.inf, channel=1),
    "channel": tone(channel=3),
    "knot": tone(channel=1, onset=Envelope(100, ((10001, 9000),))),
    "step": tone(channel=1, ending=Envelope(1, ((1000, 0),))),
    "phase of a knot": tone(channel=1, ending=Envelope(100, ((1000, 0), (1000, 18001)))),
    "number of a knot": tone(channel=1, onset=Envelope(100, ((1000.5, 0),))),  # type: ignore[arg-type]
    "knots": tone(channel=1, onset=Envelope(100, ((1000, 0),) * 33)),
}


@pytest.mark.parametrize("case", INVALID_TONES)
def test_invalid_tone_is_refused_with_its_channel(case: str) -> None:
    """It is in the second layer; the first one is valid."""
    invalid_tone = INVALID_TONES[case]

    refusal = Account().refuse(1.0, layer(0, tone()), layer(1, invalid_tone))

    assert refusal.channel == invalid_tone.channel


@pytest.mark.parametrize(
    "invalid_layer",
    [
        layer(8, tone()),
        layer(-1, tone()),
        layer(0, tone(), ramp=1.001),
        layer(0, tone(), ramp=math.nan),
        layer(0, tone(), valid_for=60.1),
        layer(0, tone(), renew=True),
        layer(0, after=True),
        layer(0, tone(), tone()),
    ],
)
def test_invalid_layer_is_refused(invalid_layer: AmplifierLayer) -> None:
    """Numbers, times and flags of a layer, and a channel that occurs twice."""
    Account().refuse(1.0, invalid_layer)


def test_set_of_more_than_127_parts_is_refused() -> None:
    """127 parts of 117 words carry 14 859 words, fewer than an amplifier may accept."""
    shape = Envelope(100, ((100, 0),) * 32)
    tones = [tone(0.01, channel=channel, onset=shape, ending=shape) for channel in range(16)]
    layers = [layer(number, *tones) for number in range(16)]
    large = {**capabilities(16), "layers": 16, "voices": 255, "set_words": 65535}
    admission = SetAdmission("a", Mock(is_complete=True))

    refusal = admission.refusal_of(StagedSet(layers), Ledger(WIDE, large), 0.0, set_time=0.0)

    assert "14859 words" in str(refusal)


def test_values_are_rounded_to_the_safe_side() -> None:
    """Ramps upward, levels and frequencies to the nearest, and valid_for never to 0 (endless).

    A full level in single precision may be 1 + 2^-22.
    """
    account = Account()
    admitted = account.admit(0.0, layer(0, tone(0.33336, 99.99), ramp=0.0101, valid_for=1e-5))
    full = account.admit(0.0, layer(0, tone(1 + 2**-22)))

    assert admitted.ramp == 11
    assert admitted.valid_for == 1
    assert admitted.commands[0].level == 3334
    assert admitted.commands[0].frequency == 2000
    assert full.commands[0].level == 10000


def test_lowest_level_limit_applies() -> None:
    """The rig allows 0.8, the amplifier 0.9 and the channel 0.7."""
    limited = {**capabilities(2), "level_max": 9000}
    limited["limits"][0]["level_max"] = 7000  # all channels share this record
    account = Account(limited, level=0.8)

    assert account.refuse(1.0, layer(0, tone(0.71))).channel == 0
    account.admit(1.0, layer(0, tone(0.7)))


@pytest.mark.parametrize("value", [0.0, math.nan])
@pytest.mark.parametrize("name", ["slew", "power", "on_time", "duty", "rate"])
def test_limit_that_allows_nothing_is_rejected(name: str, value: float) -> None:
    """A limit of zero or NaN is an error of the caller."""
    with pytest.raises(CommandError):
        Account(**{name: value})


def test_levels_of_layers_add_up_until_a_layer_has_faded() -> None:
    """0.6 leaves 0.4 for another layer; it fades for 20 ms from 1.0 s on, and then leaves 0.9."""
    account = Account()
    loud = layer(1, tone(0.9, 200.0))
    account.play(0.0, layer(0, tone(0.6)))
    assert account.refuse(1.0, layer(1, tone(0.41, 200.0))).channel == 0
    account.admit(1.0, layer(1, tone(0.4, 200.0)))
    assert account.refuse(1.0, loud).until is None

    account.play(1.0, layer(0))

    assert account.refuse(1.01, loud).until == pytest.approx(1.02)
    account.admit(1.02 + 1e-9, loud)


def test_waiting_set_counts_with_its_ending() -> None:
    """Level 0.1 with an ending through 0.8 waits: another 0.3 is refused, 0.15 is not."""
    account = Account()
    onset = Envelope(500, ((500, 0),))
    ending = Envelope(100, ((8000, 0),))
    account.play(0.0, layer(0, tone(0.05, onset=onset)))
    account.play(0.01, layer(0, tone(0.1, ending=ending), after=True))

    account.refuse(0.02, layer(1, tone(0.3, 200.0)))
    account.admit(0.02, layer(1, tone(0.15, 200.0)))


def test_waiting_tone_continues_one_voice_only_with_its_phase_and_frequency() -> None:
    """0.9 follows 0.9 as one voice, which leaves 0.1; as two voices it is refused."""
    account = Account()
    onset = Envelope(1000, ((9000, 0),))
    continued = tone(0.9, keep_phase=True, onset=onset)
    account.play(0.0, layer(0, continued))
    account.refuse(0.05, layer(0, replace(continued, keep_phase=False), after=True))
    account.refuse(0.05, layer(0, replace(continued, frequency=200.0), after=True))

    account.play(0.05, layer(0, continued, after=True))

    account.refuse(0.06, layer(1, tone(0.11, 200.0)))
    account.admit(0.06, layer(1, tone(0.1, 200.0)))


def test_ending_during_a_cross_fade_is_refused() -> None:
    """An ending at full level starts 1 ms after the commit: with the old tone, nearly 2."""
    account = Account()
    account.play(0.0, layer(0, tone(1.0)))
    ending = Envelope(100, ((10000, 0),) * 10)

    account.refuse(1.0, layer(0, tone(1.0, 200.0, ending=ending), ramp=1.0, valid_for=0.001))
    account.admit(1.0, layer(0, tone(1.0, 200.0), ramp=1.0, valid_for=0.001))


LATE_PULSE = tone(0.0, onset=Envelope(200, ((0, 0),) * 5 + ((9000, 0),)))
"""Silent for 100 ms, at 0.9 after 120 ms and silent again after 140 ms."""


def test_pulse_that_outlives_its_replacement_counts() -> None:
    """A set that may arrive after 80 ms lets the pulse finish within the set's ramp of 60 ms."""
    account = Account()
    account.play(0.0, layer(0, LATE_PULSE))

    def sudden(level: float) -> AmplifierLayer:
        onset = Envelope(10, ((round(10_000 * level), 0),))
        return layer(0, tone(level, 200.0, onset=onset), ramp=0.06)

    account.refuse(0.0, sudden(0.9))
    account.admit(0.0, sudden(0.1))
    account.admit(0.15, sudden(0.9))


def test_pulse_adds_to_the_rise_of_its_replacement() -> None:
    """By hand: 0.9 in 20 ms, or pi/2 * 0.9 in 60 ms, and pi/2 * 0.05 in 60 ms: 69.9 per second."""
    replacement = layer(0, tone(0.05), ramp=0.06)
    account = Account(slew=69.9)
    account.play(0.0, layer(0, LATE_PULSE))
    account.admit(0.0, replacement)

    account = Account(slew=69.8)
    account.play(0.0, layer(0, LATE_PULSE))
    account.refuse(0.0, replacement)


def test_power_counts_all_layers_and_channels() -> None:
    """Twice 0.5 is a power of 1 on one channel, and of 0.5 on two channels."""
    account = Account(power=0.6)
    account.play(0.0, layer(0, tone(0.5)))

    account.refuse(1.0, layer(1, tone(0.5, 200.0)))
    account.admit(1.0, layer(1, tone(0.5, 200.0, channel=1)))


def test_rises_are_limited_but_fades_are_not() -> None:
    """A ramp of 0.1 s to 0.5 rises at most by pi/2 * 0.5 / 0.1 = 7.85 per second, a knot by 10."""
    rising = layer(0, tone(0.5), ramp=0.1)
    onset = Envelope(100, ((1000, 0), (2000, 0)))
    shaped = layer(0, tone(0.2, onset=onset))
    Account(slew=7.86).admit(0.0, rising)
    slow = Account(slew=7.85)
    slow.refuse(0.0, rising)
    slow.refuse(0.0, shaped)

    account = Account(slew=10.01)
    account.admit(0.0, shaped)
    account.play(0.0, rising)
    account.admit(1.0, layer(0, ramp=0.001))


def test_on_time_limits_validity_and_ramps() -> None:
    """Of 2 s, a ramp takes 20 ms; after 1.5 s, the rest less 100 ms for the way is left."""
    account = Account(on_time=2.0)
    assert account.play(0.0, layer(0, tone())).valid_for == 1980
    assert account.admit(1.5, layer(1, tone(channel=1))).valid_for == 380
    account.refuse(1.9, layer(0, renew=True))
    assert account.admit(1.9, layer(0, ramp=1.0)).ramp <= 100


def test_on_time_includes_the_onset_that_a_set_waits_for() -> None:
    """Of 2 s, 0.5 are over, the onset lasts 0.5 more, 0.1 may be on the way and 0.1 is the ramp.

    The waiting set may last for 0.8 s from where it starts.
    """
    account = Account(on_time=2.0)
    onset = Envelope(1000, ((1000, 0),) * 9)
    account.play(0.0, layer(0, tone(onset=onset), ramp=0.1, valid_for=1.5))

    waiting = account.admit(0.5, layer(0, tone(keep_phase=True), ramp=0.1, after=True))

    assert waiting.valid_for == pytest.approx(800, abs=2)


def test_on_time_ends_with_a_set_that_has_waited_for_an_onset() -> None:
    """After 0.2 s from the onset's end at 0.03 s, and a pause of ten seconds, 1 s is free again."""
    account = Account(on_time=1.0, duty=0.5)
    onset = Envelope(100, ((2000, 0),) * 2)
    account.play(0.0, layer(0, tone(onset=onset), valid_for=0.2))
    account.play(0.01, layer(0, tone(keep_phase=True), valid_for=0.2, after=True))

    admitted = account.admit(20.0, layer(1, tone(channel=1), valid_for=0.5))

    assert admitted.valid_for == 500


def test_duty_cycle_counts_vibration_within_ten_seconds() -> None:
    """Of 2 s, two of 0.5 s and three ramps of 20 ms leave 0.94 s, less 0.1 s for each delay."""
    account = Account(duty=0.2)
    account.play(0.0, layer(0, tone(), valid_for=0.5))
    account.play(2.0, layer(0, tone(), valid_for=0.5))

    assert 740 <= account.admit(4.0, layer(0, tone())).valid_for <= 940


def test_silence_counts_a_set_in_doubt_as_played() -> None:
    """0.9 of one second in ten passes until a silence, although no reply confirmed the set."""
    account = Account(duty=0.1)
    lasting = layer(0, tone(), ramp=0.0)

    account.send(0.0, lasting)
    account.ledger.note_ended(ramp=0.0, sent_at=0.9, now=0.9)

    assert 1 <= account.admit(5.0, lasting).valid_for <= 100


def test_new_capabilities_do_not_restore_the_duty_cycle() -> None:
    """0.9 of one second in ten is spent; a lower level limit leaves 0.1 s, reopened or not."""
    account = Account(duty=0.1)
    lasting = layer(0, tone(), ramp=0.0)
    account.play(0.0, lasting)
    account.play(0.9, layer(0, ramp=0.0))

    account.ledger.adopt({**CAPABILITIES, "level_max": 5000})
    account.refuse(5.0, layer(0, tone(0.51)))
    assert 1 <= account.admit(5.0, lasting).valid_for <= 100

    reopened = Account({**CAPABILITIES, "level_max": 4000}, duty=0.1)
    reopened.ledger.go_on_from(account.ledger)
    assert 1 <= reopened.admit(5.0, layer(0, tone(0.3), ramp=0.0)).valid_for <= 100


def test_achieved_level_counts_once_its_set_is_reported() -> None:
    """0.5 was sent and 0.45 plays, which leaves 0.55; a report about another set is ignored."""
    account = Account()
    account.play(0.0, layer(0, tone(0.5)))
    achieved = account.admit(0.5, layer(0, tone(0.45)))

    account.ledger.playback.correct(achieved, account.token + 1)
    account.refuse(1.0, layer(1, tone(0.54, 200.0)))

    account.ledger.playback.correct(achieved, account.token)
    account.refuse(1.0, layer(1, tone(0.56, 200.0)))
    account.admit(1.0, layer(1, tone(0.54, 200.0)))


def test_rate_of_sets_is_limited_but_silence_is_not() -> None:
    """Three sets per second, at 0, 0.1 and 0.2 s, 0.1 s of which they may be late."""
    account = Account(rate=3.0)
    for time in (0.0, 0.1, 0.2):
        account.play(time, layer(0, tone()))

    assert account.refuse(0.5, layer(0, tone())).until == pytest.approx(1.1)
    account.admit(0.5, layer(0))
    account.admit(1.11, layer(0, tone()))


LOUD = layer(2, tone(0.9, 200.0))
"""Too loud together with any tone above 0.1."""


@pytest.fixture
def late_account() -> Account:
    """Return a ledger of an amplifier with eight voices."""
    return Account({**CAPABILITIES, "voices": 8})


def test_late_fade_may_start_from_a_higher_level(late_account: Account) -> None:
    """0.9 at 20 ms and little until 160 ms: started 10 ms late, it fades from nearly 0.9."""
    onset = Envelope(200, ((9000, 0),) + ((500, 0),) * 6)
    late_account.play(0.0, layer(0, tone(0.0, onset=onset)), delay=0.01)

    late_account.play(0.031, layer(0, ramp=0.13), delay=0.01)

    late_account.refuse(0.056, LOUD)
    late_account.admit(1.031, LOUD)


def test_late_set_may_leave_a_fade_that_it_would_cut_short(late_account: Account) -> None:
    """At 1.1 s all eight voices sound and 0.5 is cut short for a ninth; at 1.11 s one is over."""
    late_account.play(0.0, layer(0, tone(0.5)), delay=0.01)
    for number in range(1, 8):
        late_account.play(0.1 * number, layer(number, tone(0.01)), delay=0.01)
    late_account.play(1.0, layer(0, ramp=1.0), delay=0.01)
    late_account.play(1.055, layer(1, ramp=0.05), delay=0.01)

    late_account.play(1.1, layer(0, tone(0.01)), delay=0.01)

    late_account.refuse(1.125, LOUD)
    late_account.admit(2.1, LOUD)


def test_failing_check_refuses_and_leaves_silence_possible() -> None:
    """An exception in a check is a refusal; nothing is noted, and a silent set is admitted."""
    account = Account()
    account.play(0.0, layer(0, tone()))
    broken = tone(channel=1, onset=object())

    account.refuse(1.0, layer(1, broken))

    assert account.ledger.doubt is None
    assert account.ledger.playback.tokens == {0: 1}
    account.admit(1.0, layer(0))


@pytest.mark.parametrize("levels", [(0.1, 0.9), (0.9, 0.1)], ids=["arrived", "lost"])
def test_no_vibration_is_admitted_after_silence_followed_a_set_in_doubt(
    levels: tuple[float, float],
) -> None:
    """Layer 0 may play 0.9 whether its second set arrived or not, until all layers end."""
    account = Account()
    first_level, second_level = levels
    account.play(0.0, layer(0, tone(first_level)), layer(1, tone(0.1, channel=1)))
    account.send(0.1, layer(0, tone(second_level)))
    account.send(0.2, layer(1))
    account.ledger.resolve(account.token, 0.202)

    account.refuse(0.5, layer(2, tone(0.2, frequency=150.0)))
    account.ledger.note_ended(ramp=0.02, sent_at=0.6, now=0.6)

    account.admit(1.0, layer(2, tone(0.2, frequency=150.0)))


def test_silence_that_was_lost_before_another_leaves_no_room() -> None:
    """0.9 may play on layer 0 after two silences without replies; 0.2 more would exceed 1."""
    account = Account()
    account.play(0.0, layer(0, tone(0.9)), layer(1, tone(0.1, channel=1)))
    account.send(0.1, layer(0))
    account.send(0.2, layer(1))
    account.ledger.resolve(account.token, 0.202)

    account.refuse(0.5, layer(2, tone(0.2, frequency=150.0)))
    account.admit(0.5, layer(2, tone(0.05, frequency=150.0)))


def test_set_in_doubt_admits_only_silence_until_it_is_resolved() -> None:
    """A status with another token shows that it does not play, one with its own that it does."""
    account = Account()
    ledger = account.ledger
    single = layer(0, tone(0.5))
    ledger.sent(7, ledger.admit([single], 0.0), 0.0)
    assert ledger.doubt
    assert ledger.doubt.token == 7
    account.refuse(1.0, single)
    account.admit(1.0, layer(0))

    ledger.resolve(6, 1.0)
    assert ledger.doubt is None
    assert ledger.playback.level(0, 1.0) == 0.0

    ledger.sent(8, ledger.admit([single], 1.0), 1.0)
    ledger.resolve(8, 1.01)
    assert ledger.playback.level(0, 2.0) == pytest.approx(0.5)


def random_envelope(chance: random.Random) -> Envelope | None:
    """Return no envelope, or one of up to three knots."""
    if chance.random() < 0.6:
        return None
    knots = []
    for _ in range(chance.randrange(4)):
        knots.append((chance.randrange(5000), chance.randrange(-18000, 18000)))
    return Envelope(chance.choice((20, 100)), tuple(knots))


def random_layer(chance: random.Random, number: int) -> AmplifierLayer:
    """Return a layer of up to three tones of three frequencies, with shapes, fades and ends."""
    valid_for = chance.choice((0.0, 0.05, 0.2))
    if valid_for and chance.random() < 0.1:
        return layer(number, renew=True, valid_for=valid_for)
    tones = []
    for channel in chance.sample(range(3), chance.randrange(4)):
        random_tone = tone(
            chance.choice((0.0, 0.2, 0.4, 0.7)),
            chance.choice((100.0, 150.0, 200.0)),
            channel,
            phase=chance.uniform(-180, 180),
            keep_phase=chance.random() < 0.5,
            skip_ending=chance.random() < 0.3,
            onset=random_envelope(chance),
            ending=random_envelope(chance),
        )
        tones.append(random_tone)
    if not tones:
        return layer(number, ramp=0.08, valid_for=valid_for)
    ramp = chance.choice((0.005, 0.02, 0.08))
    waits = chance.random() < 0.2
    return layer(number, *tones, ramp=ramp, valid_for=valid_for, after=waits)


@pytest.mark.parametrize("seed", range(12))
def test_admitted_sets_stay_within_the_limits_whenever_they_are_played(seed: int) -> None:
    """Random sets play up to 90 ms after they were sent: level, power and rise every 0.5 ms.

    A jump of a ramp counts within one step of the sampling.
    """
    chance = random.Random(seed)
    slew = chance.choice((60.0, 150.0, math.inf))
    ledger = Account(level=0.9, power=1.2, slew=slew).ledger
    playback = Playback(3, 16)
    now = 0.0
    step = 0.0005
    admitted_sets = 0
    earlier_levels = [0.0] * 3
    for token in range(1, 120):
        numbers = chance.sample(range(3), chance.choice((1, 1, 2)))
        layers = [random_layer(chance, number) for number in numbers]
        try:
            waiting = ledger.admit(layers, now)
        except CommandRefused:
            waiting = ()
        commit = now + chance.choice((0.0, 0.001, 0.01, 0.09))
        end = max(commit + 0.002, now + chance.choice((0.012, 0.03, 0.1)))
        if waiting:
            admitted_sets += 1
            ledger.sent(token, waiting, now)
        while now < end:
            now += step
            if waiting and now >= commit:
                playback.commit(waiting, token, commit)
                waiting = ()
            playback.advance(now)
            levels = [playback.level(channel, now) for channel in range(3)]
            assert max(levels) <= 0.9 * (1 + 1e-6)
            power = sum(level**2 for level in levels)
            assert power <= 1.2 * (1 + 1e-6)
            for level, earlier_level in zip(levels, earlier_levels, strict=True):
                assert (level - earlier_level) / step <= slew * (1 + 1e-6)
            earlier_levels = levels
        ledger.resolve(token, min(commit + 0.001, end))
    assert admitted_sets > 20
