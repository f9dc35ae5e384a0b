"""The way from a rig and its open amplifiers to what can be played, and to the commands.

Clocks of several amplifiers as answers count them, one that is not held among them.
"""

import cmath
import logging
import math
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import cache
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from controller.effects.player import EffectPlayer
from controller.play.counted_clocks import CountedClocks
from controller.play.routing import on_wire, route, thinned
from controller.play.selected_contents import leaks_db_sl
from controller.play.shared_capabilities import (
    EnvelopeSupport,
    envelope_support,
    playback_capabilities,
)
from controller.sources.touch import Contact, ContactKey
from drivers.host.group import Group
from drivers.host.ledger import Ledger
from drivers.playing import AmplifierLayer
from drivers.playing import AmplifierTone as Played
from drivers.protocol.definition import CLOCK_UNKNOWN
from drivers.protocol.records import Values
from drivers.protocol.sets import Envelope
from kit.chain import FarEnd
from kit.clock import in_virtual_time
from kit.fingers import LAYOUT, LEFT, RIGHT, Fingers, fingers_on
from kit.fingers import table as paper_table
from kit.plates import smooth_rig, smooth_table
from model.answer.answer_report import Timing
from model.ensemble.attached_plate import AttachedPlate, PlateOnEras
from model.ensemble.draws import EXACT_CLOCKS
from model.errors import InputError
from model.rig.rig import Channel, Rig, Uncertainty
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.transients.base_motion import BaseEnvelope
from model.vibration import Excitation, Tone
from registry import threads
from registry.limits import GuardLimits
from sim.amplifier.amplifier_clock import Crystal
from sim.amplifier.readings import capabilities
from sim.far_ends.wire_assignment import SimulatedWire as WireAssignmentWire
from sim.plant.imperfections import draw_imperfections

RIG = smooth_rig()
HALVES = replace(
    RIG,
    amplifiers={"a": "sim://", "b": "sim://"},
    wiring={era.name: Channel("ab"[n % 2], n // 2) for n, era in enumerate(RIG.eras)},
)


def test_answers_count_clocks_before_they_are_worse_than_counted() -> None:
    """A quarter more than is known; anew where that is passed, or far too much: not in between.

    Whatever table is answered by, of which nothing else changes. One amplifier is not even asked.
    """
    now = {"a": 8e-6, "b": 4e-6}
    clocks, table = CountedClocks(HALVES, lambda: now), smooth_table()
    first = clocks.counted_by(table)
    assert first.clocks.errors == pytest.approx((10e-6, 5e-6))
    assert clocks.errors == pytest.approx({"a": 10e-6, "b": 5e-6})
    learned = replace(table)
    other = clocks.counted_by(learned)
    assert (other.clocks, other.omega is learned.omega) == (first.clocks, True)
    now |= {"a": 9.9e-6, "b": 3e-6}
    assert clocks.counted_by(first) is first
    now["a"] = 10.1e-6
    worse = clocks.counted_by(first)
    assert worse.clocks.errors[0] == pytest.approx(12.625e-6)
    now["a"] = 5e-6
    assert clocks.counted_by(worse).clocks.errors[0] == pytest.approx(6.25e-6)
    one = replace(RIG, wiring={era.name: Channel("a", n) for n, era in enumerate(RIG.eras)})
    alone = CountedClocks(one, lambda: pytest.fail("not to be asked"))
    assert alone.counted_by(table) is table
    assert table.clocks == EXACT_CLOCKS


def test_clocks_that_come_and_go_are_told_once_with_how_often(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lost five times within a second: one warning; held for 10 s: once, after five times.

    Answers follow each change at once.
    """
    seconds, now = [0.0], {"a": 4e-6, "b": 4e-6}
    monkeypatch.setattr(threads, "now", lambda: seconds[0])
    clocks, table = CountedClocks(HALVES, lambda: now), smooth_table()
    with caplog.at_level(logging.INFO, logger="controller.play.counted_clocks"):
        table = clocks.counted_by(table)
        for _ in range(5):
            for now["b"], groups in ((math.inf, (0, 1, 0, 1)), (4e-6, ())):
                table = clocks.counted_by(table)
                assert table.clocks.groups == groups
                seconds[0] += 0.1
        assert [each.levelno for each in caplog.records] == [logging.WARNING]
        seconds[0] += 9.8  # 9.9 s since it was held
        table = clocks.counted_by(table)
        assert len(caplog.records) == 1
        seconds[0] += 0.2
        table = clocks.counted_by(table)
        table = clocks.counted_by(table)
        assert [each.levelno for each in caplog.records] == [logging.WARNING, logging.INFO]
        assert "losses before: 5" in caplog.records[1].getMessage()
        now["b"] = math.inf
        clocks.counted_by(table)
    levels = [each.levelno for each in caplog.records]
    assert levels == [logging.WARNING, logging.INFO, logging.WARNING]
    assert all("amplifier b" in each.getMessage() for each in caplog.records)


def test_clock_that_is_not_known_yet_is_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    """When its line has just been opened."""
    clocks = CountedClocks(HALVES, lambda: {"a": 4e-6, "b": math.inf})
    with caplog.at_level(logging.INFO, logger="controller.play.counted_clocks"):
        assert clocks.counted_by(smooth_table()).clocks.groups == (0, 1, 0, 1)
    assert [each.levelno for each in caplog.records] == [logging.INFO]


IDENTIFIED = Uncertainty(0.015, 1.5, 0.002, 0.01, 1.1, 0.5, modulus=0.0, place=0.0, harmonic=0.0)
CRYSTALS = {"a": Crystal(), "b": Crystal(error=40e-6)}
WIRE = WireAssignmentWire("serial", speed=921_600, shared=True, line_kind="prompt")


def halves() -> Rig:
    """The paper's rig as it is once identified, each half on an amplifier."""
    rig = smooth_rig()
    return replace(
        rig,
        uncertainty=IDENTIFIED,
        amplifiers={"a": "sim://", "b": "sim://"},
        wiring={era.name: Channel("ab"[n // 2], n % 2) for n, era in enumerate(rig.eras)},
    )


@cache
def clock_table() -> LocalizationTable:
    """Its table at 29 frequencies."""
    return build_table(halves(), frequencies=np.linspace(40.0, 320.0, 29))


@asynccontextmanager
async def two_fingers(*, is_stated: bool = True) -> AsyncIterator[Fingers]:
    """Two fingers, each with a content, once armed; is_stated: that b's clock is not steered."""
    rig = halves()
    drawn = replace(draw_imperfections(rig, seed=1), crystals=CRYSTALS)
    options = {"intent_source": EffectPlayer(LAYOUT), "timing": Timing(clock_table())}
    async with Fingers.on(WIRE, rig, clock_table(), imperfections=drawn, **options) as fingers:
        if is_stated:
            fingers.far.bench.amplifiers["b"].capabilities["clock_error"] = CLOCK_UNKNOWN
        await fingers.open()
        await fingers.operate("arm")
        await fingers.hold(1.0)
        fingers.at = {1: LEFT, 2: RIGHT}
        yield fingers
        await fingers.close()


async def beyond_the_promise() -> dict[int, float]:
    """By how much [dB] each finger's contrast is beyond what is promised, after 10 s of rest."""
    async with two_fingers() as fingers:
        await fingers.hold(10.0)
        promised = {
            each.contact.key.id: each.sensation.promised_contrast_db
            for each in fingers.applied[-1].targets
        }
        return {id: felt - promised[id] for id, felt in fingers.contrasts().items()}


@in_virtual_time
async def test_promise_is_kept_beside_a_clock_that_is_not_steered() -> None:
    """By contents of the ERAs of one amplifier; 40 ppm are 0.4 ms after 10 s."""
    found = await beyond_the_promise()
    assert len(found) == 2
    assert min(found.values()) > 0


class _Changing(dict[ContactKey | None, float]):
    """Fingers that have changed in every plan."""

    def __bool__(self) -> bool:
        return True


@pytest.mark.parametrize("is_changing", [False, True], ids=["resting", "changing"])
@in_virtual_time
async def test_contents_leave_a_clock_that_is_lost(
    monkeypatch: pytest.MonkeyPatch, is_changing: bool
) -> None:
    """Within 0.1 s none plays over both amplifiers, though no finger has changed.

    Within 0.2 s where fingers change in every plan: clocks are counted every 0.1 s then.
    """
    known = {"a": 2e-6, "b": 2e-6}
    monkeypatch.setattr(Group, "clock_errors", property(lambda group: known))
    async with two_fingers(is_stated=False) as fingers:
        await fingers.hold(1.0)
        assert shared(fingers)
        if is_changing:
            fingers.controller.cycle.tracker._changed = _Changing()
        known["b"] = math.inf
        await fingers.hold(0.2 if is_changing else 0.1)
        assert not shared(fingers)
        await fingers.hold(0.5)
        assert not shared(fingers)
        assert any(map(played, fingers.far_ends))


def played(end: FarEnd) -> set[float]:
    """Frequencies [Hz] that an amplifier plays and is to play on."""
    voices = [voice for each in end.amplifier.outputs for voice in each]
    return {voice.frequency for voice in voices if voice.transition.last}


def shared(fingers: Fingers) -> set[float]:
    """Frequencies [Hz] that both amplifiers play."""
    return set.intersection(*map(played, fingers.far_ends))


@in_virtual_time
async def test_status_of_several_amplifiers_eliminates_no_plate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of 16 ERAs that takes 0.2 s, in which no heartbeat goes out: it is done before touches."""
    eliminated: list[object] = []
    eliminate = PlateOnEras.of

    def noted(plate: AttachedPlate, *counts: int) -> PlateOnEras:
        eliminated.append(plate)
        return eliminate(plate, *counts)

    monkeypatch.setattr(PlateOnEras, "of", noted)
    rig, fresh = halves(), replace(clock_table())
    options = {"intent_source": EffectPlayer(LAYOUT), "timing": Timing(clock_table())}
    async with Fingers.on(WIRE, rig, fresh, **options) as fingers:
        await fingers.open()
        assert eliminated
        eliminated.clear()
        leaks_db_sl(fresh, (), (Contact(ContactKey("panel", 1), *LEFT, since=0.0),))
        assert not eliminated


PAIRED_RIG = replace(
    RIG,
    eras=tuple(
        replace(era, name=name, stroke=stroke)
        for era, name, stroke in zip(RIG.eras, "ABC", (1e-4, 2e-4, 1e-4), strict=False)
    ),
    wiring={"A": Channel("left", 1), "B": Channel("left", 0), "C": Channel("right", 0)},
    amplifiers={"left": "sim://", "right": "sim://"},
    limits=GuardLimits(40.0, 500.0, 0.8),
)
"""Two ERAs on the left amplifier, one on the right."""


def amplifier(*, line: Any = None, **changed: int) -> Any:
    """An amplifier on a line, with some capabilities of its own."""
    own: Values = {**capabilities(4), **changed}
    return Mock(line=line or line_of(0.0), capabilities=own, ledger=Ledger(PAIRED_RIG.limits, own))


def line_of(word: float) -> Any:
    """A line on whose wire a word takes a time [s]."""
    return Mock(wire=Mock(transit=lambda words: words * word))


def both(left: Any = None, right: Any = None) -> Mapping[str, Any]:
    """The two amplifiers of the rig."""
    return {"left": left or amplifier(), "right": right or amplifier()}


@pytest.mark.parametrize(
    ("steps", "mode"),
    [
        ([(1, 1), (1, 1)], "phased"),
        ([(1, 1), (1, 18_000)], "switched"),
        ([(10_000, 1), (1, 1)], "switched"),
    ],
)
def test_capabilities_choose_the_best_common_drive_mode(
    steps: list[tuple[int, int]], mode: str
) -> None:
    """By the steps of level (1e-4) and phase (0.01 degrees) of each amplifier."""
    left, right = (amplifier(level_step=level, phase_step=phase) for level, phase in steps)
    found = playback_capabilities(PAIRED_RIG, both(left, right))
    assert found.drive_mode == mode
    assert found.playable[-1] == mode


def test_capabilities_are_the_tightest_limits() -> None:
    """Of the rig and all amplifiers: 50 Hz and half of full level, and 300 Hz.

    A drive mode that cannot be played is refused, with those that can be.
    """
    left = amplifier(frequency_min=1000, level_max=5000)
    found = playback_capabilities(PAIRED_RIG, both(left, amplifier(frequency_max=6000)))
    assert found.limits.frequencies == (50.0, 300.0)
    assert found.limits.amplitudes == pytest.approx({"A": 5e-5, "B": 1e-4, "C": 8e-5})
    plain = both(amplifier(phase_step=18_000), amplifier(phase_step=18_000))
    only = playback_capabilities(PAIRED_RIG, plain, drive_mode="switched")
    assert only.drive_mode == "switched"
    with pytest.raises(InputError, match=r"switched.*phased"):
        playback_capabilities(PAIRED_RIG, plain, drive_mode="phased")


@pytest.mark.parametrize(
    ("words", "is_shared", "expected"),
    [
        (10_000, False, (20, 7)),
        (18 + 4 * 20, False, (20, 7)),
        (18 + 4 * 19, False, (19, 7)),
        (18 + 4 * 7, False, (7, 7)),
        (18 + 4 * 6, False, (6, 0)),
        (18 + 4 * 1, False, (1, 0)),
        (18 + 3, False, (0, 0)),
        (0, False, (0, 0)),
        (30 + 6 * 7, True, (7, 7)),
        (30 + 6 * 6, True, (6, 0)),
    ],
)
def test_envelopes_have_as_many_knots_as_wires_carry(
    words: int, is_shared: bool, expected: tuple[int, int]
) -> None:
    """So many words in 10 ms, on a wire for each amplifier, or on one for both.

    By hand: two channels on the left have 18 words of heads, and 4 words for each knot; with the
    third channel 30 and 6. An ending has 7 knots, in a set of its own.
    """
    lines = [line_of(0.010 / (words + 0.5)) for _ in range(2)]
    left, right = (amplifier(line=lines[0 if is_shared else number]) for number in range(2))
    assert envelope_support(PAIRED_RIG, both(left, right)) == EnvelopeSupport(*expected)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"knots": 19}, (19, 7)),
        ({"knots": 6}, (6, 0)),
        ({"knots": 0}, (0, 0)),
        ({"envelope_step_min": 100}, (0, 0)),
        ({"set_words": 18 + 4 * 13}, (13, 7)),
    ],
)
def test_envelopes_need_capabilities(changed: dict[str, int], expected: tuple[int, int]) -> None:
    """Knots, steps of 5 ms and words of a set, of every amplifier."""
    found = envelope_support(PAIRED_RIG, both(amplifier(**changed)))
    assert found == EnvelopeSupport(*expected)


STROKES = {"A": 1e-4, "B": 2e-4, "C": 1e-4}


def test_envelopes_on_the_wire_by_hand() -> None:
    """Levels in strokes of 1e-4, phases in 0.01 degrees and steps of 0.1 ms, without the last knot.

    Half a turn is the lowest phase that the wire has. What rounding makes more than full stroke is
    full stroke: the ledger would refuse it.
    """
    onset = {
        "B": BaseEnvelope(110.0, 0, (1e-4j, -2e-4, 0), 0.01),
        "A": BaseEnvelope(110.0, 0, (2e-5, 5e-5)),
        "C": BaseEnvelope(110.0, 0, (cmath.rect(1e-4 * (1 + 1e-12), 0.0), 0)),
    }
    found, none, ending = on_wire(STROKES, onset, None, {"C": BaseEnvelope(110.0, 0, (5e-5,))})
    assert (none, ending) == ({}, {"C": Envelope(50, ())})
    assert found == {
        "A": Envelope(50, ((2000, 0),)),
        "B": Envelope(100, ((5000, 9000), (10000, -18000))),
        "C": Envelope(50, ((10000, 0),)),
    }


def test_thinned_envelope_follows_the_same_lines() -> None:
    """Six steps of 5 ms become three of 10, whose knots are those of before."""
    line = BaseEnvelope(110.0, 0, (1.0, 2.0, 4.0, 5.0, 7.0, 6.0))
    (found,) = thinned({"A": line}, knots=2).values()
    assert (found.step, found.knots) == (0.01, (2.0, 5.0, 6.0))
    (whole,) = thinned({"A": line}, knots=5).values()
    assert whole is line


def test_route_by_hand() -> None:
    """20 of 100 µm is level 0.2, 20 of 200 is 0.1; pi/2 is 90°; other channels are silent.

    More than full stroke and NaN reach the ledger unchanged; a pattern of another rig is refused as
    a whole.
    """
    silent = Played(0, 40.0, 0.0, skip_ending=True)
    drive = {"A": Tone(110.0, 20e-6, math.pi / 2), "C": Tone(250.0, 20e-6)}
    played = Played(1, 110.0, pytest.approx(0.2), pytest.approx(90.0))
    assert route(drive, PAIRED_RIG, ramp=0.02) == {
        "left": AmplifierLayer(0, (played, silent), ramp=0.02),
        "right": AmplifierLayer(0, (Played(0, 250.0, pytest.approx(0.2)),), ramp=0.02),
    }
    over = route({"B": Tone(1e9, 4e-4, math.nan)}, PAIRED_RIG, ramp=0)["left"].tones[1]
    assert (over.frequency, over.level) == (1e9, pytest.approx(2.0))
    assert math.isnan(over.phase)
    with pytest.raises(InputError, match="got NW"):
        route({"A": Tone(100.0, 1e-6), "NW": Tone(100.0, 1e-6)}, PAIRED_RIG, ramp=0)


@pytest.mark.parametrize(
    ("wanted", "kept"),
    [
        ({"A": Tone(110.0, 5e-6), "C": Tone(110.0, 9e-6)}, {"A", "C"}),
        ({"A": Tone(110.0, 5e-6, 1.0), "C": Tone(110.0, 9e-6)}, {"A", "C"}),
        ({"C": Tone(110.0, 9e-6)}, {"C"}),
        ({"A": Tone(110.0, 5e-6), "C": Tone(250.0, 9e-6)}, {"A"}),
        ({"A": Tone(110.0, 5e-6), "B": Tone(110.0, 9e-6)}, set()),
        ({"A": Tone(110.01, 5e-6), "C": Tone(110.01, 9e-6)}, set()),
        ({"A": Tone(250.0, 5e-6), "C": Tone(250.0, 9e-6)}, set()),
    ],
    ids=["amplitude", "phase", "one less", "frequency of one", "another", "all by little", "all"],
)
def test_route_keeps_phase_only_if_all_eras_continue(wanted: Excitation, kept: set[str]) -> None:
    """A frequency restarts if an ERA joins it."""
    playing = {name: Played(0, 110.0, 0.5) for name in ("A", "C")}
    layers = route(wanted, PAIRED_RIG, ramp=0, playing=playing)
    assert {
        name
        for name, channel in PAIRED_RIG.wiring.items()
        for tone in layers[channel.amplifier].tones
        if tone.channel == channel.number and tone.keep_phase
    } == kept
    first = route(wanted, PAIRED_RIG, ramp=0)
    assert not any(tone.keep_phase for each in first.values() for tone in each.tones)


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
