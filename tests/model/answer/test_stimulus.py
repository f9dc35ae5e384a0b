"""Fingers and stimuli, and the search for tones: the kernel in C against numpy."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from cases import read_yaml, shortly
from kit.plates import SMALL_TABLE_HZ, contact_sets, smooth_rig, smooth_table
from kit.set_table import only, phased, wants
from model.answer import plan
from model.answer.envelope import Course
from model.answer.fingers_on_plate import DriveTones, FingersOnPlate
from model.answer.plan import query
from model.answer.promise import promised, share_stroke
from model.answer.question import Contents, Stream, Tones
from model.answer.stimulus import Finger, Placement, Stimulus, check_fingers, together
from model.answer.tone_search import choose_by_numpy, choose_tones
from model.arrays import Point
from model.ensemble.draws import ClockErrors
from model.errors import InputError
from model.finger import THRESHOLDS, detection_threshold
from model.rig.rig import Uncertainty
from model.structure.attachments import PointLoad
from model.table.table import LocalizationTable
from model.table.table_file import build_table

FOLDER = Path(__file__).parent
TARGET = (0.09, 0.07)
NEAR_TARGET = (0.14, 0.09)
SECOND_TARGET = (0.2, 0.1)
QUIET = (0.25, 0.18)

# The kernel and numpy

IDENTIFIED = Uncertainty(0.015, 1.5, 0.002, 0.01, 1.1, 0.5, modulus=0.002, place=0.0002)
EXACT_THICKNESS = Uncertainty(0.02, 1.0, 0.0, 0.02, 1.2, 0.3)
MASS = PointLoad(0.2, 0.05, mass=0.03)


@cache
def random_table(seed: int) -> LocalizationTable:
    """Return a table of three to seven ERAs anywhere, unequal in stiffness and stroke.

    Promises of two tables hold by all sets of thresholds, of one by that of its levels.
    """
    rng = np.random.default_rng(seed)
    rig = smooth_rig()
    corner = rig.eras[0]
    eras = []
    for number in range(3 + 2 * seed):
        x = float(rng.uniform(0, rig.plate.length))
        y = float(rng.uniform(0, rig.plate.width))
        stiffness = corner.stiffness * float(rng.uniform(0.7, 1.4))
        stroke = corner.stroke * float(rng.uniform(0.7, 1.4))
        name = f"E{number}"
        eras.append(replace(corner, name=name, x=x, y=y, stiffness=stiffness, stroke=stroke))
    uncertainty = (rig.uncertainty, IDENTIFIED, EXACT_THICKNESS)[seed]
    rig = replace(rig, eras=tuple(eras), uncertainty=uncertainty)
    if seed == 1:
        rig = replace(rig, masses=(MASS,))
    else:
        rig = replace(rig, promised_thresholds=THRESHOLDS)
    return build_table(rig, frequencies=np.linspace(40, 320, 29), drive_mode="phased")


@dataclass(frozen=True)
class Case:
    """Contents for a search, as described in `kernel_contents.yaml`."""

    own: int
    quiet: int = 0
    is_shared: bool = False
    level: float = 15.0
    bands: Sequence[Sequence[int]] = ((0, 29),)
    loads: Sequence[float] = ()
    places: Sequence[Sequence[float]] = ()

    def positions_on(self, table: LocalizationTable, seed: int) -> list[Point]:
        """Return the positions of all fingers, own fingers first."""
        count = self.own + self.quiet
        if self.places:
            return [(x * table.plate.length, y * table.plate.width) for x, y in self.places]
        if count >= 10:
            return TWENTY_POSITIONS[:count]
        (positions,) = contact_sets(1, fingers=max(2, count), seed=seed)
        return positions[:count]

    def contents_on(self, table: LocalizationTable, seed: int) -> Contents:
        """Return the question to the search."""
        positions = self.positions_on(table, seed)
        own = tuple(range(self.own))
        targets = [own] if self.is_shared else [(finger,) for finger in own]
        bands = tuple((first, end) for first, end in self.bands)
        streams = []
        for priority, fingers in enumerate(targets):
            streams.append(Stream(fingers, self.level, bands, priority))
        is_alone = len(streams) == 1 and not self.quiet
        return Contents(
            tuple(positions),
            tuple(self.loads),
            tuple(streams),
            tuple(range(self.own, len(positions))),
            apart_hz=30.0,
            background=table.background(positions) if is_alone else None,
        )


ROWS = [(0.03 + 0.06 * x, 0.05 + 0.12 * y) for x in range(5) for y in range(2)]
TWENTY_POSITIONS = [*ROWS, *((x + 0.028, y) for x, y in ROWS)]
CASES = read_yaml(FOLDER / "kernel_contents.yaml")


def gains_of_weights(table: LocalizationTable, contents: Contents, tones: Tones) -> list[float]:
    """Return the gains that numpy computes for the weights of tones."""
    fingers = FingersOnPlate.of(table, contents.places, contents.loads, by_kernel=False)
    weights = np.array(tones.weights, np.complex64)
    drives = DriveTones(np.array(tones.rows), weights, np.array(tones.owners))
    return promised(fingers, contents, drives).gains


@pytest.mark.usefixtures("kernels_or_numpy")
@pytest.mark.parametrize("seed", shortly(range(3), [0]))
@pytest.mark.parametrize("name", CASES)
def test_kernel_agrees_with_numpy(name: str, seed: int) -> None:
    """In frequencies and weights, and in all figures within 0.03 dB, on random rigs.

    Searches end near the optimum, at weights that differ by up to 0.12 %. Gains follow from the
    weights to single precision, so they are compared at the same weights.
    """
    table = random_table(seed)
    contents = Case(**CASES[name]).contents_on(table, seed)

    tones = choose_tones(table, contents)

    expected = choose_by_numpy(table, contents)
    assert tones.rows == expected.rows
    assert tones.is_apart == expected.is_apart
    np.testing.assert_allclose(np.abs(tones.weights), np.abs(expected.weights), atol=0.02)
    np.testing.assert_allclose(tones.gains, gains_of_weights(table, contents, tones), rtol=1e-4)
    np.testing.assert_allclose(tones.stroke_factor, expected.stroke_factor, rtol=2e-3)
    for key in ("contrast_db", "level_db_sl", "foreign_db_sl", "worst_db"):
        values = getattr(tones, key)
        expected_values = getattr(expected, key)
        np.testing.assert_allclose(values, expected_values, rtol=0, atol=0.03, err_msg=key)


# The search


def test_higher_priority_has_its_stroke_first() -> None:
    """By hand: two others have one factor, half of what remains and a little less."""
    weights = np.array([[0.5, 0.1], [0.5, 1.0], [0.5, 1.0]], dtype=np.complex64)

    gains, factor = share_stroke(np.ones(3), weights, np.ones(3), [1, 0, 0])

    assert gains == pytest.approx([1.0, 0.45, 0.45])
    assert factor == pytest.approx(0.45)


@pytest.mark.parametrize(
    ("needs", "expected"),
    [((0.8, 0.4, 0.3), (0.375, 1, 1)), ((0.8, 0.8, 0.3), (0.175, 0.7, 1))],
    ids=["one", "two"],
)
def test_loudest_contents_are_lowered_first(needs: list[float], expected: list[float]) -> None:
    """By hand: levels of 8, 2 and 1, which need these shares of an ERA.

    The first is lowered, or the first two end at the level 1.4: 0.14 + 0.56 + 0.3.
    """
    weights = np.array(needs, dtype=np.complex64)[:, None]

    gains, factor = share_stroke(np.ones(3), weights, np.array([8.0, 2.0, 1.0]), [0, 0, 0])

    assert gains == pytest.approx(expected)
    assert factor == pytest.approx(min(expected))


def test_full_era_lowers_only_contents_that_use_it() -> None:
    """By hand: two contents share one ERA; the third has another one and plays in full."""
    weights = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.5]], dtype=np.complex64)

    gains, factor = share_stroke(np.ones(3), weights, np.ones(3), [0, 0, 0])

    assert gains == pytest.approx([0.5, 0.5, 1.0])
    assert factor == pytest.approx(0.5)


def test_content_ignores_a_full_era_that_it_does_not_use() -> None:
    """By hand: a content of high priority fills the first ERA, the other plays on the second."""
    weights = np.array([[2.0, 0.0], [0.0, 0.5]], dtype=np.complex64)

    gains, _ = share_stroke(np.ones(2), weights, np.ones(2), [1, 0])

    assert gains == pytest.approx([0.5, 1.0])


# Rejected questions

REJECTED = read_yaml(FOLDER / "rejected.yaml")


@pytest.mark.parametrize("name", REJECTED["placements"])
def test_placement_is_rejected(name: str) -> None:
    """By the number, distance, load and position of its fingers."""
    case = REJECTED["placements"][name]
    placed = Placement(case["targets"], case.get("quiet", ()), case.get("loads", ()))

    with pytest.raises(InputError, match=case["error"]):
        check_fingers(together(placed, Stimulus()), smooth_table().plate)


@pytest.mark.parametrize("name", REJECTED["stimuli"])
def test_stimulus_is_rejected(name: str) -> None:
    """The error names the argument."""
    arguments = REJECTED["stimuli"][name]
    (argument, *_) = arguments

    with pytest.raises(InputError, match=argument.removesuffix("_db_sl")):
        Stimulus(**arguments)


@pytest.mark.parametrize("duration", ["0.5", 0.2])
def test_stimulus_with_a_course_has_no_other_duration(duration: object) -> None:
    """The course has one."""
    with pytest.raises(InputError, match="duration"):
        Stimulus(duration=duration, course=Course((0, 0.5), (1, 1)))


@pytest.mark.parametrize("name", REJECTED["fingers"])
def test_finger_is_rejected(name: str) -> None:
    """The error names the argument."""
    arguments = REJECTED["fingers"][name]
    (argument,) = arguments

    with pytest.raises(InputError, match=argument):
        phased(smooth_table(), [Finger(TARGET, Stimulus(), **arguments)])


@pytest.mark.parametrize("keys", [{"duration": 0.04}, {"is_limit": True}], ids=str)
def test_fingers_that_must_share_have_equal_stimuli(keys: Mapping[str, object]) -> None:
    """In duration, and in whether the level is a limit."""
    fingers = [
        Finger(TARGET, Stimulus(name="a"), sharing="must"),
        Finger(QUIET, Stimulus(name="a", **keys), sharing="must"),
    ]

    with pytest.raises(InputError, match=next(iter(keys))):
        phased(smooth_table(), fingers)


@pytest.mark.parametrize("count", [0, 22])
def test_answer_needs_1_to_20_fingers(count: int) -> None:
    """Each with a content."""
    fingers = [wants((0.013 * number, 0.01)) for number in range(count)]

    with pytest.raises(InputError, match="finger"):
        phased(smooth_table(), fingers)


def test_fingers_must_be_13_mm_apart() -> None:
    """Two contents, or a content and a quiet finger, at the same position."""
    finger = wants(TARGET)

    with pytest.raises(InputError, match="13 mm"):
        phased(smooth_table(), [finger, finger])
    with pytest.raises(InputError, match="13 mm"):
        phased(smooth_table(), [finger], [Finger(TARGET)])


def test_band_must_contain_a_frequency_of_the_table() -> None:
    """Its frequencies are 18 Hz apart."""
    with pytest.raises(InputError, match="contain a frequency"):
        phased(smooth_table(), [wants(TARGET, (41, 42)), wants(QUIET)])


def test_query_rejects_a_drive_mode() -> None:
    """Modes have names."""
    with pytest.raises(InputError, match="drive mode"):
        query(smooth_table(), Placement((TARGET,)), drive_mode="loud")


# Levels


@pytest.mark.parametrize(
    ("placed", "mode"),
    [
        (Placement((TARGET,), (QUIET,)), "phased"),
        (Placement((TARGET, SECOND_TARGET)), "phased"),
        (Placement((TARGET, SECOND_TARGET)), "switched"),
    ],
    ids=["quiet finger", "two targets", "switched"],
)
def test_level_out_of_reach_is_lowered(placed: Placement, mode: str) -> None:
    """An ERA is at full stroke, and the promised level is reached if it is requested.

    Two targets of one vibration are lowered by the loss of the first.
    """
    table = smooth_table()
    low_band = (60.0, 80.0)

    lowered = query(table, placed, 60.0, band_hz=low_band, drive_mode=mode)

    targets = lowered.fingers[: len(placed.targets)]
    weakest = min(targets, key=lambda sensation: sensation.promised_level_db_sl)
    promised = weakest.promised_level_db_sl
    assert 20 < promised < 60
    loss = 60 - targets[0].promised_level_db_sl
    assert weakest.lowered_db == pytest.approx(loss, abs=0.01)
    assert not lowered.is_reached
    assert "lowered" in lowered.applied[-1]
    levels = [lowered.amplitudes[name] / table.full_levels[name] for name in lowered.amplitudes]
    assert max(levels) == pytest.approx(1.0, abs=1e-5)
    reachable = query(table, placed, promised - 0.2, band_hz=low_band, drive_mode=mode)
    assert reachable.is_reached


LIMIT = Finger(TARGET, Stimulus(26.0, is_limit=True))


@pytest.mark.parametrize("mode", ["switched", "phased"])
def test_limit_is_as_strong_as_a_quiet_finger_allows(mode: str) -> None:
    """This is at -10 dB SL on 90 % of plates; without it the limit is reached."""
    table = smooth_table()

    quiet = plan.answer(table, [LIMIT], quiet=[NEAR_TARGET], drive_mode=mode)
    alone = plan.answer(table, [LIMIT], drive_mode=mode)

    assert quiet.fingers[1].foreign_level_db_sl == pytest.approx(-10.0, abs=1e-3)
    assert quiet.fingers[0].level_db_sl < 26.0
    assert alone.fingers[0].level_db_sl == pytest.approx(26.0, abs=1e-3)
    for answer in (quiet, alone):
        lowered = 26.0 - answer.fingers[0].promised_level_db_sl
        assert answer.fingers[0].lowered_db == pytest.approx(lowered, abs=1e-3)


def test_limit_is_not_lowered_for_another_content() -> None:
    """The other vibration does not count; without quiet fingers both have their levels."""
    neighbor = Finger((0.05, 0.17), Stimulus(20.0))

    answer = phased(smooth_table(), [LIMIT, neighbor])

    verdicts = {sensation.verdict for sensation in answer.fingers}
    assert verdicts <= {"own", "mixed"}
    assert answer.fingers[0].promised_level_db_sl >= 12.0 - 1e-3

    alone = phased(smooth_table(), [LIMIT], [NEAR_TARGET, neighbor.at])
    joint = phased(smooth_table(), [LIMIT, neighbor], [NEAR_TARGET], min_contrast_db=-99.0)
    assert joint.fingers[2].foreign_level_db_sl > -10.0
    level_alone = alone.fingers[0].promised_level_db_sl
    assert joint.fingers[0].promised_level_db_sl > level_alone - 3.0


@pytest.mark.parametrize("mode", ["switched", "phased"])
def test_band_limits_the_frequencies_of_an_answer(mode: str) -> None:
    """From 150 to 250 Hz no tone lies outside; the ends of a band are in it."""
    placed = Placement((TARGET,), (QUIET,))
    end = float(SMALL_TABLE_HZ[9])

    banded, _ = only(smooth_table(), placed, drive_mode=mode, band_hz=(150.0, 250.0))
    at_end, _ = only(smooth_table(), placed, drive_mode=mode, band_hz=(end, end))

    for name, tone in banded.excitation.items():
        assert 150 <= tone.frequency <= 250, name
    assert at_end.frequency == end


@pytest.mark.parametrize(
    ("targets", "mode"),
    [((TARGET,), "switched"), ((TARGET,), "phased"), ((TARGET, QUIET), "phased")],
    ids=["switched", "phased", "two targets"],
)
def test_query_without_quiet_fingers_contrasts_with_the_plate_around(
    targets: tuple[Point, ...], mode: str
) -> None:
    """The level relative to the RMS over cell centers beyond 5 cm of all targets.

    The plate around is the plate without fingers, which change it little.
    """
    table = smooth_table()

    answer = query(table, Placement(targets), drive_mode=mode)

    distances = [np.linalg.norm(table.cell_centers - target, axis=1) for target in targets]
    far = table.cell_centers[np.min(distances, axis=0) > 0.05]
    (layer,) = answer.layers
    frequencies, amplitudes = table.amplitudes(layer.excitation, far)
    powers = ((amplitudes.T / detection_threshold(frequencies)) ** 2).sum(axis=1)
    level = min(target.level_db_sl for target in answer.fingers)
    contrast = level - 10 * math.log10(powers.mean())
    assert layer.contrast_to_plate_db == pytest.approx(contrast, abs=0.01)
    assert {target.contrast_db for target in answer.fingers} == {None}


@pytest.mark.parametrize("level", [14.0, 60.0], ids=["in reach", "out of reach"])
@pytest.mark.parametrize(("is_held", "amplifier_count"), [(True, 2), (False, 1)])
def test_switched_content_needs_amplifiers_with_held_clocks(
    level: float, is_held: bool, amplifier_count: int
) -> None:
    """ERAs of two amplifiers play together only if their clocks are held together."""
    table = smooth_table()
    if not is_held:
        table = table.with_clocks(ClockErrors((0, 1, 0, 1), (0.0, math.inf)))
    amplifier_of = {era.name: number % 2 for number, era in enumerate(table.eras)}
    counts = []

    for target, quiet in contact_sets(6, fingers=2, seed=3):
        answer = query(table, Placement((target,), (quiet,)), level, drive_mode="switched")
        for layer in answer.layers:
            amplifiers = {amplifier_of[name] for name in layer.excitation}
            counts.append(len(amplifiers))

    assert len(counts) == 6
    assert max(counts) == amplifier_count
