"""The way from a rig and its open amplifiers to what can be played, and to the commands.

Clocks of several amplifiers as answers count them, one that is not held among them.
"""

import cmath
import logging
import math
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from chain import FarEnd
from controller.effects.player import EffectPlayer
from controller.play.intent import leaks_db_sl
from controller.play.routing import (
    CountedClocks,
    EnvelopeSupport,
    envelope_support,
    on_wire,
    playback_capabilities,
    route,
    thinned,
    tones_by_era,
)
from controller.sources.touch import Contact, ContactKey
from drivers.host.group import Group
from drivers.host.ledger import Ledger
from drivers.playing import AmplifierLayer
from drivers.playing import AmplifierTone as Played
from drivers.protocol.definition import CLOCK_UNKNOWN
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet
from model.answer.answer_report import Timing
from model.ensemble.attached_plate import AttachedPlate, PlateOnEras
from model.ensemble.draws import EXACT_CLOCKS
from model.errors import InputError
from model.fem import Mesh
from model.rig.rig import Channel, Rig, Uncertainty
from model.structure.attachments import Era
from model.structure.material import Material
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.transients.base_motion import BaseEnvelope
from model.vibration import Excitation, Tone
from plates import smooth_rig, smooth_table
from registry import threads
from registry.limits import GuardLimits
from several_fingers import LAYOUT, LEFT, RIGHT, Fingers
from sim.amplifier.readings import Crystal, capabilities
from sim.far_ends.wire_assignment import SimulatedWire as WireAssignmentWire
from sim.plant.imperfections import draw_imperfections
from virtual_lines import in_virtual_time

RIG = smooth_rig()
HALVES = replace(
    RIG,
    amplifiers={"a": "sim://", "b": "sim://"},
    wiring={era.name: Channel("ab"[n % 2], n // 2) for n, era in enumerate(RIG.eras)},
)


def test_answers_count_clocks_before_they_are_worse_than_counted() -> None:
    """A quarter more than is known; anew where that is passed, or far too much: not in between."""
    now = {"a": 8e-6, "b": 4e-6}
    clocks, table = CountedClocks(HALVES, lambda: now), smooth_table()
    first = clocks.counted_by(table)
    assert first.clocks.errors == pytest.approx((10e-6, 5e-6))
    assert clocks.errors == pytest.approx({"a": 10e-6, "b": 5e-6})
    now |= {"a": 9.9e-6, "b": 3e-6}
    assert clocks.counted_by(first) is first
    now["a"] = 10.1e-6
    worse = clocks.counted_by(first)
    assert worse.clocks.errors[0] == pytest.approx(12.625e-6)
    now["a"] = 5e-6
    assert clocks.counted_by(worse).clocks.errors[0] == pytest.approx(6.25e-6)


def test_a_table_that_is_learned_has_the_same_clocks() -> None:
    """Whatever table is answered by; nothing else of it changes."""
    clocks = CountedClocks(HALVES, lambda: {"a": 8e-6, "b": 4e-6})
    first, learned = clocks.counted_by(smooth_table()), replace(smooth_table())
    other = clocks.counted_by(learned)
    assert other.clocks == first.clocks
    assert other.omega is learned.omega


def test_clocks_that_come_and_go_are_told_once_with_how_often(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lost five times within a second: one warning; held for 10 s: once, after five times.

    Answers follow each change at once.
    """
    seconds, now = [0.0], {"a": 4e-6, "b": 4e-6}
    monkeypatch.setattr(threads, "now", lambda: seconds[0])
    clocks, table = CountedClocks(HALVES, lambda: now), smooth_table()
    with caplog.at_level(logging.INFO, logger="controller.play.routing"):
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
    with caplog.at_level(logging.INFO, logger="controller.play.routing"):
        assert clocks.counted_by(smooth_table()).clocks.groups == (0, 1, 0, 1)
    assert [each.levelno for each in caplog.records] == [logging.INFO]


def test_one_amplifier_has_no_clock_that_counts() -> None:
    """It is not even asked."""
    one = replace(RIG, wiring={era.name: Channel("a", n) for n, era in enumerate(RIG.eras)})
    clocks = CountedClocks(one, lambda: pytest.fail("not to be asked"))
    assert clocks.counted_by(smooth_table()) is smooth_table()
    assert smooth_table().clocks == EXACT_CLOCKS


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
            each.contact.key.id: each.promised_contrast_db for each in fingers.applied[-1].targets
        }
        return {id: felt - promised[id] for id, felt in fingers.contrasts().items()}


@in_virtual_time
async def test_promise_is_kept_beside_a_clock_that_is_not_steered() -> None:
    """By contents of the ERAs of one amplifier; 40 ppm are 0.4 ms after 10 s."""
    found = await beyond_the_promise()
    assert len(found) == 2
    assert min(found.values()) > 0


@pytest.mark.long
@in_virtual_time
async def test_promise_is_broken_if_clocks_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """So what plays over both amplifiers is felt by who should not."""
    monkeypatch.setattr(CountedClocks, "counted_by", lambda clocks, table, known: table)
    assert min((await beyond_the_promise()).values()) < -1


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
            fingers.controller.cycle.tracker.changed = _Changing()
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


LIMITS = GuardLimits(40.0, 500.0, 0.8)


@dataclass
class Wire:
    """A wire on which a word takes a time [s]."""

    word: float

    def transit(self, words: int) -> float:
        """In proportion to the words."""
        return words * self.word


@dataclass(eq=False)
class Line:
    """A line with a wire."""

    wire: Wire = field(default_factory=lambda: Wire(0.0))


class Opened:
    """An amplifier with some capabilities of its own."""

    def __init__(self, line: Line | None = None, **changed: int) -> None:
        self.line = line or Line()
        self.capabilities: Values = {**capabilities(4), **changed}
        self.ledger = Ledger(LIMITS, self.capabilities)


def paired_rig() -> Rig:
    """Two ERAs on the left amplifier, one on the right."""
    return Rig(
        plate=Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33)),
        mesh=Mesh(4, 4, 0.3, 0.2),
        eras=tuple(
            Era(name, x, 0.0, 17_000.0, 1.0, 0.0, stroke)
            for name, x, stroke in (("A", 0.0, 1e-4), ("B", 0.15, 2e-4), ("C", 0.3, 1e-4))
        ),
        wiring={"A": Channel("left", 3), "C": Channel("right", 0), "B": Channel("left", 1)},
        amplifiers={"left": "fake://", "right": "fake://"},
        limits=LIMITS,
    )


def both(left: Opened | None = None, right: Opened | None = None) -> Mapping[str, Any]:
    """The two amplifiers of the rig."""
    return {"left": left or Opened(), "right": right or Opened()}


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
    left, right = (Opened(level_step=level, phase_step=phase) for level, phase in steps)
    found = playback_capabilities(paired_rig(), both(left, right))
    assert found.drive_mode == mode
    assert found.playable[-1] == mode


def test_capabilities_refuse_an_unplayable_drive_mode() -> None:
    """With those that can be played."""
    plain = both(Opened(phase_step=18_000), Opened(phase_step=18_000))
    assert (
        playback_capabilities(paired_rig(), plain, drive_mode="switched").drive_mode == "switched"
    )
    with pytest.raises(InputError, match=r"switched.*phased"):
        playback_capabilities(paired_rig(), plain, drive_mode="phased")


def test_capabilities_are_the_tightest_limits() -> None:
    """Of the rig and all amplifiers: 50 Hz and half of full level, and 300 Hz."""
    left = Opened(frequency_min=1000, level_max=5000)
    found = playback_capabilities(paired_rig(), both(left, Opened(frequency_max=6000)))
    assert found.limits.frequencies == (50.0, 300.0)
    assert found.limits.amplitudes == pytest.approx({"A": 5e-5, "B": 1e-4, "C": 8e-5})


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
    lines = [Line(Wire(0.010 / (words + 0.5))) for _ in range(2)]
    left, right = (Opened(lines[0 if is_shared else number]) for number in range(2))
    assert envelope_support(paired_rig(), both(left, right)) == EnvelopeSupport(*expected)


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
    found = envelope_support(paired_rig(), both(Opened(**changed)))
    assert found == EnvelopeSupport(*expected)


STROKES = {"A": 1e-4, "B": 2e-4, "C": 1e-4}


def test_envelopes_on_the_wire_by_hand() -> None:
    """Levels in strokes of 1e-4, phases in 0.01 degrees and steps of 0.1 ms, without the last knot.

    Half a turn is the lowest phase that the wire has.
    """
    onset = {
        "B": BaseEnvelope(110.0, 0, (1e-4j, -2e-4, 0), 0.01),
        "A": BaseEnvelope(110.0, 0, (2e-5, 5e-5)),
    }
    found, none, ending = on_wire(STROKES, onset, None, {"C": BaseEnvelope(110.0, 0, (5e-5,))})
    assert (none, ending) == ({}, {"C": Envelope(50, ())})
    assert found["A"] == Envelope(50, ((2000, 0),))
    assert found["B"] == Envelope(100, ((5000, 9000), (10000, -18000)))


def test_envelopes_round_full_stroke_to_one() -> None:
    """A rounding error above it would be refused by the ledger."""
    full = cmath.rect(1e-4 * (1 + 1e-12), 1.0)
    (found,) = on_wire(STROKES, {"A": BaseEnvelope(110.0, 0, (full, 0))})
    ((level, _),) = found["A"].knots
    assert level == 10000


def test_thinned_envelope_follows_the_same_lines() -> None:
    """Six steps of 5 ms become three of 10, whose knots are those of before."""
    line = BaseEnvelope(110.0, 0, (1.0, 2.0, 4.0, 5.0, 7.0, 6.0))
    (found,) = thinned({"A": line}, knots=2).values()
    assert (found.step, found.knots) == (0.01, (2.0, 5.0, 6.0))
    (whole,) = thinned({"A": line}, knots=5).values()
    assert whole is line


PLATE = Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33))
PAIRED_RIG = Rig(
    plate=PLATE,
    mesh=Mesh(4, 4, 0.3, 0.2),
    eras=tuple(
        Era(name, x, y, 17_000.0, 1.0, 0.0, stroke)
        for name, x, y, stroke in (
            ("SW", 0.0, 0.0, 100e-6),
            ("SE", 0.3, 0.0, 50e-6),
            ("NE", 0.3, 0.2, 100e-6),
        )
    ),
    wiring={"SW": Channel("left", 1), "SE": Channel("right", 0), "NE": Channel("left", 0)},
    amplifiers={"left": "sim://", "right": "sim://"},
    limits=GuardLimits(40.0, 500.0, 1.0),
)


def test_route_by_hand() -> None:
    """20 of 100 µm is level 0.2, 20 of 50 is 0.4; pi/2 is 90°; other channels are silent."""
    layers = route(
        {"SW": Tone(110.0, 20e-6, math.pi / 2), "SE": Tone(250.0, 20e-6)},
        PAIRED_RIG,
        ramp=0.02,
    )
    played = Played(1, 110.0, pytest.approx(0.2), pytest.approx(90.0))
    silent = Played(0, 40.0, 0.0, skip_ending=True)
    assert layers == {
        "left": AmplifierLayer(0, (played, silent), ramp=0.02),
        "right": AmplifierLayer(0, (Played(0, 250.0, pytest.approx(0.4)),), ramp=0.02),
    }


@pytest.mark.parametrize(
    ("radians", "degrees"),
    [
        (0.0, 0.0),
        (math.pi, 180.0),
        (-math.pi, -180.0),
        (1.5 * math.pi, -90.0),
        (-1.5 * math.pi, 90.0),
        (6 * math.pi, 0.0),
        (20 * math.pi + 0.1, math.degrees(0.1)),
    ],
)
def test_route_wraps_phases(radians: float, degrees: float) -> None:
    """Phases lie within half a turn, of which both ends are one."""
    command = route({"SE": Tone(100.0, 1e-6, radians)}, PAIRED_RIG, ramp=0)["right"].tones[0]
    assert command.phase == pytest.approx(degrees)


def test_route_applies_no_limits() -> None:
    """More than full stroke and NaN reach the ledger unchanged."""
    over = route({"SE": Tone(1e9, 1e-4, math.nan)}, PAIRED_RIG, ramp=0)["right"].tones[0]
    assert over.frequency == 1e9
    assert over.level == pytest.approx(2.0)
    assert math.isnan(over.phase)


def test_route_refuses_an_unknown_era() -> None:
    """A pattern of another rig is refused as a whole."""
    with pytest.raises(InputError, match="got NW"):
        route({"SW": Tone(100.0, 1e-6), "NW": Tone(100.0, 1e-6)}, PAIRED_RIG, ramp=0)


@pytest.mark.parametrize(
    ("wanted", "kept"),
    [
        ({"SW": Tone(110.0, 5e-6), "SE": Tone(110.0, 9e-6)}, {"SW", "SE"}),
        ({"SW": Tone(110.0, 5e-6, 1.0), "SE": Tone(110.0, 9e-6)}, {"SW", "SE"}),
        ({"SE": Tone(110.0, 9e-6)}, {"SE"}),
        ({"SW": Tone(110.0, 5e-6), "SE": Tone(250.0, 9e-6)}, {"SW"}),
        ({"SW": Tone(110.0, 5e-6), "NE": Tone(110.0, 9e-6)}, set()),
        ({"SW": Tone(110.01, 5e-6), "SE": Tone(110.01, 9e-6)}, set()),
        ({"SW": Tone(250.0, 5e-6), "SE": Tone(250.0, 9e-6)}, set()),
    ],
)
def test_route_keeps_phase_only_if_all_eras_continue(wanted: Excitation, kept: set[str]) -> None:
    """A frequency restarts if an ERA joins it."""
    playing = {name: Played(0, 110.0, 0.5) for name in ("SW", "SE")}
    layers = route(wanted, PAIRED_RIG, ramp=0, playing=playing)
    assert {
        name
        for name, channel in PAIRED_RIG.wiring.items()
        for tone in layers[channel.amplifier].tones
        if tone.channel == channel.number and tone.keep_phase
    } == kept
    first = route(wanted, PAIRED_RIG, ramp=0)
    assert not any(tone.keep_phase for each in first.values() for tone in each.tones)


def test_drive_of_eras_by_hand() -> None:
    """What each ERA plays, without silent ones."""
    achieved = {
        "left": [LayerSet(0, 20, 0, (Command(0, 800, 0, 0), Command(1, 2201, 1999, -9000)))],
        "right": [LayerSet(0, 20, 0, (Command(0, 5000, 4000, 0),))],
    }
    assert tones_by_era(achieved, PAIRED_RIG) == {
        "SW": Played(1, 110.05, 0.1999, -90.0),
        "SE": Played(0, 250.0, 0.4),
    }
