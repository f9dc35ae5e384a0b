"""Envelopes in the simulated amplifier, against their definition and against the model's own."""

import math
from dataclasses import replace

import numpy as np
import pytest

from driven_bases import motion_of
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.protocol.messages import (
    Achieved,
    Apply,
    Arm,
    ChannelLimits,
    Commit,
    Disarm,
    Loaded,
    LoadEnvelope,
    Nak,
    NakCode,
    Ping,
    Request,
    Stage,
    Stop,
)
from model.transients.envelope import BaseEnvelope
from sim.amplifier.amplifier import SimulatedAmplifier

STROKE = 1e-4
RISE = Envelope(1, 0.005, (Knot(0.2, 90.0), Knot(0.4, 0.0)))
BRAKE = Envelope(2, 0.005, (Knot(0.5, 180.0), Knot(0.1, 0.0)))


def armed() -> SimulatedAmplifier:
    """Four channels, enabled, with two envelopes loaded."""
    amplifier = SimulatedAmplifier("main", channels=4)
    amplifier.handle(Arm(2.0), 0.0)
    for envelope in (RISE, BRAKE):
        loaded = amplifier.handle(LoadEnvelope(envelope), 0.0)
        assert loaded == Loaded(envelope.slot, 2)
    return amplifier


def playing(
    token: int, level: float, *, ramp: float = 0.0, valid_for: float = 0.0, **more: int
) -> CommandSet:
    """Channel 0 at 110 Hz."""
    command = DriveCommand(0, 110.0, level, **more)
    return CommandSet(token, (command,), ramp=ramp, valid_for=valid_for)


def level(amplifier: SimulatedAmplifier, time: float) -> float:
    """What channel 0 plays."""
    amplifier.tick(time)
    return amplifier.status(time).levels[0]


def test_onset_follows_its_knots() -> None:
    """From zero, one knot every 5 ms, the level of the command after a third step, then steady."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.8, onset=1)), 1.0)
    expected = {1.0: 0.0, 1.0025: 0.1, 1.005: 0.2, 1.01: 0.4, 1.015: 0.8, 1.5: 0.8}
    # Half way from 0.2 at 90 degrees to 0.4 at 0: a straight line in the complex plane.
    expected[1.0075] = abs(0.2j + 0.4) / 2
    for moment, value in sorted(expected.items()):
        assert level(amplifier, moment) == pytest.approx(value, abs=1e-9)


def test_envelope_moves_the_base_as_modelled() -> None:
    """The plant's terms are those of the model's own envelope with the destination as last knot."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.8, onset=1)), 0.25)  # 27.5 periods: a phase of its own
    played = [part for tone in amplifier.outputs[0] for part in tone.motion(stroke=STROKE)]
    knots = tuple(STROKE * value for value in (0.2j, 0.4 + 0j, 0.8 + 0j))
    model = list(BaseEnvelope(110.0, 0j, knots, step=0.005).terms())
    times = np.linspace(0.0, 0.03, 500)
    assert motion_of(played, times + 0.25) == pytest.approx(motion_of(model, times), abs=1e-12)


def test_ending_plays_before_a_silent_set() -> None:
    """Through its knots to zero, whatever the ramp; the phase still counts from the first set."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.8, ending=2)), 1.0)
    amplifier.handle(Apply(CommandSet(2, (), ramp=0.5, valid_for=0.0)), 1.2)
    (tone,) = amplifier.outputs[0]
    assert level(amplifier, 1.205) == pytest.approx(0.5)
    assert tone.amplitude(1.205) == pytest.approx(-0.5)
    assert tone.origin == 1.0
    assert level(amplifier, 1.21) == pytest.approx(0.1)
    assert level(amplifier, 1.215) == 0.0
    assert tone.silent_from == pytest.approx(1.215)


def test_ending_plays_amid_an_onset_to_level_zero() -> None:
    """From the present amplitude, whatever the ramp and whatever the onset would have done."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.0, onset=1, ending=2)), 1.0)
    amplifier.handle(Apply(CommandSet(2, (), ramp=0.5, valid_for=0.0)), 1.01)
    expected = {1.01: 0.4, 1.0125: 0.05, 1.015: 0.5, 1.02: 0.1, 1.025: 0.0}
    for moment, value in expected.items():  # 0.4, half way to -0.5, the knots, silence
        assert level(amplifier, moment) == pytest.approx(value, abs=1e-9)


def test_silent_set_after_an_onset_to_level_zero_fades_what_else_sounds() -> None:
    """A voice that has ended has no ending; that of the set before fades along the new ramp."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.8)), 1.0)
    amplifier.handle(Apply(playing(2, 0.0, ramp=0.8, onset=1, ending=2)), 1.0)
    before = level(amplifier, 1.1)
    assert before > 0.5
    amplifier.handle(Apply(CommandSet(3, (), ramp=0.02, valid_for=0.0)), 1.1)
    assert level(amplifier, 1.11) == pytest.approx(before / 2)
    assert level(amplifier, 1.1201) == 0.0


@pytest.mark.parametrize(
    "silencing",
    [Apply(playing(2, 0.0, ramp=0.005, skip_ending=True)), Stop(0.005), Disarm(0.005), None],
)
def test_ending_is_skipped(silencing: Request | None) -> None:
    """By its flag, a stop, a disarm and the watchdog: silent within the ramp, without its knots."""
    amplifier = armed()
    amplifier.handle(Arm(0.1), 1.0)
    amplifier.handle(Apply(playing(1, 0.8, ending=2)), 1.0)
    if silencing is not None:
        amplifier.handle(silencing, 1.1 - 1e-9)
    assert level(amplifier, 1.1) == pytest.approx(0.8)
    assert level(amplifier, 1.1025) == pytest.approx(0.4)
    assert level(amplifier, 1.1051) == 0.0


def test_stop_amid_an_onset_fades_from_the_reached_level() -> None:
    """Half of the level at the stop after half of its ramp."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.8, onset=1, ending=2)), 1.0)
    amplifier.handle(Stop(0.005), 1.01)
    assert level(amplifier, 1.0125) == pytest.approx(0.2)  # half of 0.4
    assert level(amplifier, 1.0151) == 0.0


def test_ending_plays_after_valid_for() -> None:
    """valid_for leads into the ending."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.8, ramp=0.5, valid_for=0.1, ending=2)), 1.0)
    before = level(amplifier, 1.1 - 1e-9)
    assert level(amplifier, 1.1) == pytest.approx(before, abs=1e-6)
    assert level(amplifier, 1.105) == pytest.approx(0.5, abs=1e-6)
    assert level(amplifier, 1.1151) == 0.0


def test_onset_with_keep_phase_continues_the_tone() -> None:
    """Nothing jumps: it begins at the amplitude that the channel has, and counts its t on."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.6)), 1.0)
    command = DriveCommand(0, 110.0, 0.8, phase=0.0, keep_phase=True, onset=1)
    amplifier.handle(Apply(CommandSet(2, (command,), ramp=0.0, valid_for=0.0)), 1.3)
    (tone,) = amplifier.outputs[0]
    assert (tone.origin, tone.amplitude(1.3)) == (1.0, 0.6)
    assert level(amplifier, 1.305) == pytest.approx(0.2)


def test_onset_to_level_zero() -> None:
    """An ERA that only helps during the onset has level 0 in its command."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.0, onset=1)), 1.0)
    assert level(amplifier, 1.01) == pytest.approx(0.4)
    assert level(amplifier, 1.0151) == 0.0
    amplifier.handle(Ping(), 2.0)
    assert amplifier.outputs[0][0].silent_from == pytest.approx(1.015)


def test_set_with_an_empty_slot_is_refused() -> None:
    """NO_ENVELOPE with the channel; what plays and what is staged stays."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.3)), 1.0)
    outputs = amplifier.outputs
    commands = (DriveCommand(0, 110.0, 0.5, onset=1), DriveCommand(2, 110.0, 0.5, ending=9))
    reply = amplifier.handle(Apply(CommandSet(2, commands, 0.0, 0.0)), 1.1)
    assert reply == Nak(NakCode.NO_ENVELOPE, 2)
    assert amplifier.outputs == outputs
    amplifier.handle(LoadEnvelope(Envelope(1, 0.005, ())), 1.2)
    assert amplifier.handle(Apply(playing(3, 0.5, onset=1)), 1.2) == Nak(NakCode.NO_ENVELOPE, 0)


def test_staged_set_keeps_its_envelopes() -> None:
    """What is loaded into the slot after Stage changes nothing of what Commit plays."""
    amplifier = armed()
    staged = amplifier.handle(Stage(playing(1, 0.8, onset=1)), 1.0)
    assert isinstance(staged, Achieved)
    amplifier.handle(LoadEnvelope(Envelope(1, 0.005, (Knot(1.0, 0.0),))), 1.0)
    amplifier.handle(Commit(1), 1.0)
    assert level(amplifier, 1.005) == pytest.approx(0.2)


@pytest.mark.parametrize(
    "envelope",
    [
        Envelope(0, 0.005, (Knot(0.1, 0.0),)),
        Envelope(64, 0.005, (Knot(0.1, 0.0),)),
        Envelope(1, 0.0005, (Knot(0.1, 0.0),)),
        Envelope(1, 0.2, (Knot(0.1, 0.0),)),
        Envelope(1, 0.005, (Knot(0.1, 0.0),) * 33),
        Envelope(1, 0.005, (Knot(1.1, 0.0),)),
        Envelope(1, 0.005, (Knot(math.nan, 0.0),)),
    ],
)
def test_load_envelope_refuses_invalid_values(envelope: Envelope) -> None:
    """Slots, steps, numbers of knots and levels out of range; what was there stays."""
    amplifier = armed()
    assert amplifier.handle(LoadEnvelope(envelope), 1.0) == Nak(NakCode.BAD_VALUE)
    amplifier.handle(Apply(playing(1, 0.8, onset=1)), 1.0)
    assert level(amplifier, 1.005) == pytest.approx(0.2)


def test_knot_above_its_channels_level_is_refused() -> None:
    """The set is refused with the channel, by the wire page; on another it plays."""
    amplifier = SimulatedAmplifier("main", channels=2)
    full, half = ChannelLimits(20.0, 600.0, 1.0), ChannelLimits(20.0, 600.0, 0.5)
    can = replace(amplifier.capabilities, channel_limits=(full, half))
    amplifier.capabilities = amplifier._sets._capabilities = can
    amplifier.handle(Arm(2.0), 0.0)
    amplifier.handle(LoadEnvelope(Envelope(1, 0.005, (Knot(0.6, 0.0),))), 0.0)
    for channel, refusal in ((1, Nak(NakCode.BAD_VALUE, 1)), (0, None)):
        command = DriveCommand(channel, 110.0, 0.2, onset=1)
        wanted = CommandSet(1, (command,), ramp=0.0, valid_for=0.0)
        reply = amplifier.handle(Apply(wanted), 0.0)
        assert reply == refusal if refusal else isinstance(reply, Achieved)
