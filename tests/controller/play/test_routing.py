"""The way from a rig and its open amplifiers to what can be played, and to the commands."""

import cmath
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import pytest

from controller.play.routing import on_wire, route, thinned
from controller.play.shared_capabilities import (
    EnvelopeSupport,
    envelope_support,
    playback_capabilities,
)
from drivers.host.ledger import Ledger
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.records import Values
from drivers.protocol.sets import Envelope
from kit.clock import in_virtual_time
from kit.fingers import table as paper_table
from kit.plates import smooth_rig
from model.errors import InputError
from model.rig.rig import Channel
from model.transients.base_motion import BaseEnvelope
from model.vibration import Excitation, Tone
from registry.limits import GuardLimits
from sim.amplifier.readings import capabilities
from tests.controller.play.fingers_on_layouts import LAYOUT, LEFT, fingers_on

STROKES = {"A": 1e-4, "B": 2e-4, "C": 1e-4}  # m
PAIRED_RIG = replace(
    smooth_rig(),
    eras=tuple(
        replace(era, name=name, stroke=stroke)
        for era, (name, stroke) in zip(smooth_rig().eras, STROKES.items(), strict=False)
    ),
    wiring={"A": Channel("left", 1), "B": Channel("left", 0), "C": Channel("right", 0)},
    amplifiers={"left": "sim://", "right": "sim://"},
    limits=GuardLimits(40.0, 500.0, 0.8),
)
"""Two ERAs on the left amplifier, one on the right."""
INSTANT = 0.0


def line_of(seconds: float) -> Any:
    """A line on which a word takes a time [s]."""
    return Mock(wire=Mock(transit=lambda words: words * seconds))


def amplifier(*, line: Any = None, **changes: int) -> Any:
    """An amplifier on a line, with changes of its capabilities."""
    values: Values = {**capabilities(4), **changes}
    ledger = Ledger(PAIRED_RIG.limits, values)
    return Mock(line=line or line_of(INSTANT), capabilities=values, ledger=ledger)


def pair(first: Any = None, second: Any = None) -> Mapping[str, Any]:
    """The left and the right amplifier of the rig."""
    return {"left": first or amplifier(), "right": second or amplifier()}


@pytest.mark.parametrize(
    ("changes", "mode"),
    [
        ({"level_step": 1, "phase_step": 1}, "phased"),
        ({"level_step": 1, "phase_step": 18_000}, "switched"),
        ({"level_step": 10_000, "phase_step": 1}, "switched"),
    ],
)
def test_capabilities_choose_the_best_common_drive_mode(changes: dict[str, int], mode: str) -> None:
    """According to the steps of level (1e-4) and phase (0.01 degrees) of the coarsest amplifier."""
    fine = amplifier(level_step=1, phase_step=1)
    playback = playback_capabilities(PAIRED_RIG, pair(fine, amplifier(**changes)))
    assert playback.drive_mode == mode
    assert playback.playable[-1] == mode


def test_capabilities_are_the_tightest_limits_of_rig_and_amplifiers() -> None:
    """50 Hz and half of the full level on the left, 300 Hz on the right, 0.8 in the rig."""
    weak = amplifier(frequency_min=1000, level_max=5000)
    slow = amplifier(frequency_max=6000)
    limits = playback_capabilities(PAIRED_RIG, pair(weak, slow)).limits
    assert limits.frequencies == (50.0, 300.0)
    assert limits.amplitudes == pytest.approx({"A": 5e-5, "B": 1e-4, "C": 8e-5})


def test_capabilities_refuse_a_drive_mode_that_cannot_be_played() -> None:
    """The error lists the modes that can be played."""
    plain = pair(amplifier(phase_step=18_000), amplifier(phase_step=18_000))
    switched = playback_capabilities(PAIRED_RIG, plain, drive_mode="switched")
    assert switched.drive_mode == "switched"
    with pytest.raises(InputError, match=r"switched.*phased"):
        playback_capabilities(PAIRED_RIG, plain, drive_mode="phased")


@pytest.mark.parametrize(
    ("words", "is_shared", "onset", "ending"),
    [
        (10_000, False, 20, 7),
        (18 + 4 * 19, False, 19, 7),
        (18 + 4 * 7, False, 7, 7),
        (18 + 4 * 6, False, 6, 0),
        (18 + 3, False, 0, 0),
        (30 + 6 * 7, True, 7, 7),
        (30 + 6 * 6, True, 6, 0),
    ],
)
def test_envelopes_have_as_many_knots_as_wires_carry(
    words: int, is_shared: bool, onset: int, ending: int
) -> None:
    """So many words pass in 10 ms, on a wire for each amplifier, or on one for both.

    By hand: two channels on the left have 18 words of heads, and 4 words for each knot; with the
    third channel 30 and 6. An ending has 7 knots, in a set of its own.
    """
    seconds = 0.010 / (words + 0.5)
    first_line = line_of(seconds)
    second_line = first_line if is_shared else line_of(seconds)
    amplifiers = pair(amplifier(line=first_line), amplifier(line=second_line))
    support = envelope_support(PAIRED_RIG, amplifiers)
    assert support == EnvelopeSupport(onset, ending)


@pytest.mark.parametrize(
    ("changes", "onset", "ending"),
    [
        ({"knots": 19}, 19, 7),
        ({"knots": 6}, 6, 0),
        ({"knots": 0}, 0, 0),
        ({"envelope_step_min": 100}, 0, 0),
        ({"set_words": 18 + 4 * 13}, 13, 7),
    ],
)
def test_envelopes_need_capabilities(changes: dict[str, int], onset: int, ending: int) -> None:
    """Every amplifier must have the knots, steps of 5 ms and the words of a set."""
    support = envelope_support(PAIRED_RIG, pair(amplifier(**changes)))
    assert support == EnvelopeSupport(onset, ending)


def test_envelopes_on_the_wire_by_hand() -> None:
    """Levels in strokes of 1e-4, phases in 0.01 degrees, steps of 0.1 ms, without the last knot.

    Half a turn is the lowest phase of the wire. A level that rounding makes more than full stroke
    is full stroke: the ledger would refuse it.
    """
    onset = {
        "B": BaseEnvelope(110.0, 0, (1e-4j, -2e-4, 0), 0.01),
        "A": BaseEnvelope(110.0, 0, (2e-5, 5e-5)),
        "C": BaseEnvelope(110.0, 0, (cmath.rect(1e-4 * (1 + 1e-12), 0.0), 0)),
    }
    ending = {"C": BaseEnvelope(110.0, 0, (5e-5,))}

    envelopes = on_wire(STROKES, onset, None, ending)

    onset_by_hand = {
        "A": Envelope(50, ((2000, 0),)),
        "B": Envelope(100, ((5000, 9000), (10000, -18000))),
        "C": Envelope(50, ((10000, 0),)),
    }
    assert [*envelopes] == [onset_by_hand, {}, {"C": Envelope(50, ())}]


def test_thinned_envelope_follows_the_same_lines() -> None:
    """Six steps of 5 ms become three of 10 ms, whose knots are among the former ones."""
    line = BaseEnvelope(110.0, 0, (1.0, 2.0, 4.0, 5.0, 7.0, 6.0))
    thin_line = thinned({"A": line}, knots=2)["A"]
    assert (thin_line.step, thin_line.knots) == (0.01, (2.0, 5.0, 6.0))
    assert thinned({"A": line}, knots=5)["A"] is line


def test_route_by_hand() -> None:
    """20 of 100 µm is level 0.2; pi/2 is 90°; other channels of an amplifier are silent."""
    drive = {"A": Tone(110.0, 20e-6, math.pi / 2), "C": Tone(250.0, 20e-6)}
    silent = AmplifierTone(0, 40.0, 0.0, skip_ending=True)
    left_tone = AmplifierTone(1, 110.0, pytest.approx(0.2), pytest.approx(90.0))
    right_tone = AmplifierTone(0, 250.0, pytest.approx(0.2))
    assert route(drive, PAIRED_RIG, ramp=0.02) == {
        "left": AmplifierLayer(0, (left_tone, silent), ramp=0.02),
        "right": AmplifierLayer(0, (right_tone,), ramp=0.02),
    }


def test_route_refuses_a_pattern_of_another_rig_as_a_whole() -> None:
    """The error names the ERA that the rig does not have."""
    drive = {"A": Tone(100.0, 1e-6), "NW": Tone(100.0, 1e-6)}
    with pytest.raises(InputError, match="got NW"):
        route(drive, PAIRED_RIG, ramp=0)


def continued_eras(layers: Mapping[str, AmplifierLayer]) -> set[str]:
    """The ERAs whose tones continue in phase."""
    channels = {
        Channel(amplifier, tone.channel)
        for amplifier, layer in layers.items()
        for tone in layer.tones
        if tone.keep_phase
    }
    return {era for era, channel in PAIRED_RIG.wiring.items() if channel in channels}


@pytest.mark.parametrize(
    ("drive", "continued"),
    [
        ({"A": Tone(110.0, 5e-6), "C": Tone(110.0, 9e-6)}, {"A", "C"}),
        ({"A": Tone(110.0, 5e-6, 1.0), "C": Tone(110.0, 9e-6)}, {"A", "C"}),
        ({"C": Tone(110.0, 9e-6)}, {"C"}),
        ({"A": Tone(110.0, 5e-6), "C": Tone(250.0, 9e-6)}, {"A"}),
        ({"A": Tone(110.0, 5e-6), "B": Tone(110.0, 9e-6)}, set()),
        ({"A": Tone(110.01, 5e-6), "C": Tone(110.01, 9e-6)}, set()),
        ({"A": Tone(250.0, 5e-6), "C": Tone(250.0, 9e-6)}, set()),
    ],
    ids=["amplitude", "phase", "fewer", "frequency of one", "another", "all by little", "all"],
)
def test_route_keeps_phase_only_if_all_eras_continue(
    drive: Excitation, continued: set[str]
) -> None:
    """A frequency restarts if an ERA joins it."""
    playing = {"A": AmplifierTone(0, 110.0, 0.5), "C": AmplifierTone(0, 110.0, 0.5)}
    layers = route(drive, PAIRED_RIG, ramp=0, playing=playing)
    layers_after_silence = route(drive, PAIRED_RIG, ramp=0)
    assert continued_eras(layers) == continued
    assert continued_eras(layers_after_silence) == set()


@in_virtual_time
async def test_ledger_checks_the_set_of_a_touch_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The check of the plan still counts when its set is sent."""
    checks = Mock(side_effect=Ledger.admit)
    monkeypatch.setattr(Ledger, "admit", lambda *values, **options: checks(*values, **options))
    async with fingers_on(paper_table(), LAYOUT) as fingers:
        fingers.at = {1: LEFT}
        await fingers.hold(0.03)
        assert len(fingers.committed) == 1
        assert checks.call_count == 1
