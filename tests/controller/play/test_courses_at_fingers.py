"""Content files at fingers, played over a wire in virtual time on the simulated plate.

They play alone, together, at the edge of the plate and under a moving finger. Magnets must stay
within their excursion.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from controller.content.pattern import Pattern
from controller.daemon.plate_view import PlateView
from controller.effects.effect import Region
from controller.effects.file_effect import File
from controller.effects.kinds import Buzz
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.shared_capabilities import RAMPS_ONLY, PlaybackCapabilities
from controller.sources.touch import Contact, ContactKey
from kit.chain import Position
from kit.clock import in_virtual_time
from kit.fingers import table as paper_table
from kit.magnets import STEP, Magnets
from model.answer.answer import Answer, Limits
from model.answer.answer_report import Timing
from model.answer.envelope import STRONGEST
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import ComplexArray, FloatArray, Point
from model.config.shapes import Circle, Rectangle
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import load_rig, parse_rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.transients.base_motion import Envelopes
from sim.far_ends.wire_assignment import SimulatedWire
from tests.controller.play.fingers_on_layouts import (
    ABOVE,
    LEFT,
    RIGHT,
    Fingers,
    fingers_on,
    sensations,
)

EXAMPLES = Path(__file__).parents[3] / "examples"
SWELL = Pattern(1.5, ((0.0, 0.3), (0.7, 1.0), (1.5, 0.2)), ((0.0, 0.4),))
SHARPER = Pattern(1.5, SWELL.intensity, ((0.0, 0.7),))
FADING = Pattern(1.0, ((0.0, 1.0), (0.2, 0.3), (0.5, 1.0), (1.0, 0.5)), ((0.0, 0.1),))


def file_of(pattern: Pattern, table: LocalizationTable, *, loop: bool = False) -> File:
    """A file at 14 dB SL."""
    file = File.of(pattern, name="it", level_db_sl=14.0, loop=loop)
    return file.for_table(table.frequencies)


def felt_effect(fingers: Fingers) -> str | None:
    """The name of the effect that the only finger feels."""
    (target,) = fingers.applied[-1].targets
    return target.content_name


def level_of_amplifier(fingers: Fingers) -> float:
    """The level of the strongest channel [dB of full level]."""
    return float(20 * np.log10(max(fingers.far_end.levels)))


@in_virtual_time
async def test_later_effect_is_felt_then_the_remainder_of_the_earlier_one() -> None:
    """By hand: the file has 12.8 dB SL after 0.4 s, and 11.6 at 1.3 s after a buzz of 0.5 s.

    The buzz of the resting finger continues once both are over.
    """
    file = file_of(SWELL, paper_table())
    short_buzz = Buzz(level=14.0, duration=0.5)
    effects = {"it": file, "short": short_buzz, "buzz": Buzz()}
    layout = SurfaceLayout(effects=effects, elsewhere="buzz")
    async with fingers_on(paper_table(), layout, at={1: LEFT}, held=0.5) as fingers:
        fingers.play("it")
        await fingers.hold(0.41)
        assert felt_effect(fingers) == "it"
        early_level = level_of_amplifier(fingers)

        await fingers.hold(0.3)
        fingers.play("short")
        await fingers.hold(0.3)
        assert felt_effect(fingers) == "short"

        await fingers.hold(0.3)
        assert felt_effect(fingers) == "it"
        change = level_of_amplifier(fingers) - early_level
        assert change == pytest.approx(11.6 - 12.8, abs=0.15)
        await fingers.hold(0.5)
        assert felt_effect(fingers) == "buzz"


@pytest.mark.parametrize("at", [(0.0, 0.1), (0.001, 0.001), (0.3048, 0.2286)])
@in_virtual_time
async def test_file_has_its_level_at_the_edge_and_in_corners(at: Position) -> None:
    """14 dB SL as a mean over the fingertip after a slow rise; no set is refused."""
    pattern = Pattern(2.0, ((0.0, 0.01), (0.3, 1.0), (2.0, 1.0)), ((0.0, 0.5),))
    layout = SurfaceLayout(effects={"it": file_of(pattern, paper_table())}, elsewhere="it")
    async with fingers_on(paper_table(), layout, at={1: at}, held=1.0) as fingers:
        assert fingers.reached()[1].level == pytest.approx(14.0, abs=0.1)
        assert fingers.refused == []


@cache
def table_of_eight() -> LocalizationTable:
    """The table of the example with eight ERAs."""
    rig = load_rig(EXAMPLES / "eight_eras.yaml")
    return build_table(rig, frequencies=np.arange(60.0, 321.0, 20.0), drive_mode="phased")


def layout_of_files(positions: Sequence[Position], patterns: Sequence[Pattern]) -> SurfaceLayout:
    """A region around each position with a looping file."""
    table = table_of_eight()
    regions, effects = [], {}
    for number, (position, pattern) in enumerate(zip(positions, patterns, strict=True)):
        name = f"file{number}"
        regions.append(Region(f"region{number}", Circle(*position, 0.03), on_press=name))
        effects[name] = file_of(pattern, table, loop=True)
    return SurfaceLayout(tuple(regions), effects, elsewhere=None)


@in_virtual_time
async def test_three_fingers_feel_three_files_apart() -> None:
    """Each at its own frequency with the promised contrast, in every turn of the file.

    Every piece of each is on the wire when its predecessor ends.
    """
    plate = table_of_eight().plate
    shares = [(0.2, 0.25), (0.8, 0.2), (0.4, 0.85)]
    positions = [(x * plate.length, y * plate.width) for x, y in shares]
    async with Fingers.armed(
        SimulatedWire("serial", speed=921_600, unpluggable=True),
        load_rig(EXAMPLES / "eight_eras.yaml"),
        table_of_eight(),
        intent_source=EffectPlayer(layout_of_files(positions, (SWELL, SHARPER, FADING))),
        timing=Timing(table_of_eight()),
    ) as fingers:
        fingers.at = dict(enumerate(positions))
        await fingers.hold(0.6)
        levels, crosstalk_levels = [], []
        for _ in range(50):
            await fingers.hold(0.03)
            reached = fingers.reached(over=STRONGEST)
            levels.append([tip.level for _, tip in sorted(reached.items())])
            crosstalk_levels.append([tip.crosstalk_level for _, tip in sorted(reached.items())])

        contrasts = np.max(levels, axis=0) - np.max(crosstalk_levels, axis=0)
        targets = sensations(fingers.applied[-1])
        assert len({target.frequency for target in targets.values()}) == 3
        for finger, contrast in enumerate(contrasts):
            promise = targets[finger].sensation.promised_contrast_db
            assert contrast > promise, f"finger {finger}"
        assert fingers.refused == []


EXCURSION = 0.5e-3  # m
TARGETS_AND_NEIGHBORS = (((0.1, 0.1), (0.3, 0.2)), ((0.3, 0.22), (0.15, 0.1)))


@cache
def exact_rig() -> Rig:
    """The weekend's rig down to 45 Hz, known exactly: magnets can use their whole excursion."""
    text = (EXAMPLES / "weekend" / "rig.yaml").read_text()
    band = "frequency: [100 Hz, 300 Hz]"
    assert band in text
    rig = parse_rig("rig.yaml", text.replace(band, "frequency: [45 Hz, 300 Hz]"))
    return replace(rig, uncertainty=Uncertainty.none())


@cache
def exact_table() -> LocalizationTable:
    """Its table at frequencies near the magnets' resonances, and one above."""
    frequencies = np.array([60.0, 70.0, 90.0, 120.0])
    return build_table(exact_rig(), frequencies=frequencies, drive_mode="phased")


@cache
def magnets() -> Magnets:
    """The magnets of this rig."""
    return Magnets(exact_rig())


TIMES: FloatArray = STEP * np.arange(1600)


def voltages(envelopes: Sequence[Envelopes]) -> ComplexArray:
    """The voltage of each exciter (n, eras) for envelopes that begin together."""
    volts = np.zeros((len(TIMES), len(exact_table().eras)), dtype=complex)
    for number, era in enumerate(exact_table().eras):
        for envelopes_by_era in envelopes:
            if era.name in envelopes_by_era:
                envelope = envelopes_by_era[era.name]
                carrier = np.exp(2j * np.pi * envelope.frequency * TIMES)
                volts[:, number] += envelope.amplitude(TIMES) * carrier
    return volts


def largest_motion(volts: ComplexArray) -> float:
    """The largest motion of a magnet from rest, in any phase [m]."""
    return float(np.abs(magnets().moved(volts)).max())


def strongest_answer(at: Point, frequency: float, limits: Limits, *quiet: Finger) -> Answer:
    """The strongest content of one finger within limits, near others that feel nothing."""
    fingers = [Finger(at, Stimulus(60.0, band_hz=(frequency, frequency))), *quiet]
    strongest = answer(exact_table(), fingers, drive_mode="phased", shaped=True, limits=limits)
    return Timing(exact_table()).shaped(strongest)


@pytest.mark.parametrize("frequency", [60.0, 70.0, 90.0])
def test_onsets_keep_magnets_within_their_excursion(frequency: float) -> None:
    """At full drive, along shaped onsets and along a jump within a millisecond, in any phase."""
    motions = []
    jump = np.exp(2j * np.pi * frequency * TIMES) * np.minimum(TIMES / 1e-3, 1)
    for target, neighbor in TARGETS_AND_NEIGHBORS:
        (layer,) = strongest_answer(target, frequency, Limits(), Finger(neighbor)).layers
        assert layer.onset is not None
        phasors = np.array([layer.excitation[era.name].phasor for era in exact_table().eras])
        motions.append(largest_motion(voltages([layer.onset])))
        motions.append(largest_motion(jump[:, None] * phasors))
    assert 0.6 * EXCURSION < max(motions) < 1.01 * EXCURSION


def test_simultaneous_contents_keep_magnets_within_their_excursion() -> None:
    """A tone at 70 Hz takes half of it, and one at 90 Hz takes everything that is left."""
    motions = []
    capabilities = PlaybackCapabilities("phased", ("phased",), Limits(), RAMPS_ONLY)
    for first_target, second_target in TARGETS_AND_NEIGHBORS:
        first = strongest_answer(first_target, 70.0, Limits(excursion=0.5))
        remaining = capabilities.left_by(first.layers, exact_table()).limits
        second = strongest_answer(second_target, 90.0, remaining)
        onsets = [layer.onset for layer in (*first.layers, *second.layers) if layer.onset]
        assert len(onsets) == 2
        motions.append(largest_motion(voltages(onsets)))
    assert 0.3 * EXCURSION < max(motions) < 1.01 * EXCURSION


LEAKING = SurfaceLayout(
    (
        Region("left", Rectangle(0.0, 0.0, 0.15, 0.12), on_press="left"),
        Region("right", Rectangle(0.16, 0.0, 0.14, 0.12), on_press="right"),
    ),
    {"left": Buzz(level=14.0), "right": Buzz(level=14.0)},
    elsewhere=None,
)
THREE_FINGERS = {1: LEFT, 2: RIGHT, 3: ABOVE}
"""The third finger is outside of all regions."""


def leaks(fingers: Fingers) -> dict[int, float]:
    """The crosstalk level that the status reports at each finger [dB SL]."""
    contacts = tuple(
        Contact(ContactKey("panel", id), *position, since=0.0)
        for id, position in fingers.at.items()
    )
    view = PlateView(lambda key: None, contacts, fingers.applied[-1])
    levels = {}
    for row in view.statuses_now(paper_table()):
        levels[row.id] = -math.inf if row.leak_db_sl is None else row.leak_db_sl
    return levels


@in_virtual_time
async def test_status_reports_crosstalk_to_a_finger_that_has_moved() -> None:
    """Slowly, by less than 8 mm, no weights change: the report is within 1 dB of the plate.

    There is no crosstalk when the last finger has lifted and its silence is not confirmed yet.
    """
    async with fingers_on(paper_table(), LEAKING, at=THREE_FINGERS, held=1.2) as fingers:
        resting_leaks = leaks(fingers)
        assert resting_leaks == pytest.approx(fingers.crosstalk_levels(), abs=1.0)
        count = len(fingers.applied)

        def move(since: float) -> None:
            way = min(0.02 * since, 0.0055)
            fingers.at[3] = (ABOVE[0] + way, ABOVE[1] - way)

        await fingers.hold(1.0, move)
        assert len(fingers.applied) == count
        assert leaks(fingers) == pytest.approx(fingers.crosstalk_levels(), abs=1.0)
        assert leaks(fingers)[3] > resting_leaks[3]
        fingers.at.clear()
        assert leaks(fingers) == {}


@pytest.mark.long
@in_virtual_time
async def test_weights_follow_a_finger_at_half_a_meter_per_second() -> None:
    """There are several answers on its way of 10 cm, after which its crosstalk falls again."""
    async with fingers_on(paper_table(), LEAKING, at=THREE_FINGERS, held=1.0) as fingers:
        resting_leak = leaks(fingers)[3]
        count = len(fingers.applied)
        leaks_on_the_way = []

        def move(since: float) -> None:
            leaks_on_the_way.append(leaks(fingers)[3])
            fingers.at[3] = (ABOVE[0] + 0.5 * since, ABOVE[1])

        await fingers.hold(0.2, move)
        assert 4 <= len(fingers.applied) - count <= 0.2 / 0.017 + 1
        await fingers.hold(1.0)
        leak = leaks(fingers)[3]
        assert leak == pytest.approx(fingers.crosstalk_levels()[3], abs=1.0)
        assert max(leaks_on_the_way) > max(resting_leak, leak)
