"""Promises of answers: on plates that the search has not seen, of hands, by sets of thresholds.

Cases of drawn plates are in `promises.yaml`.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cases import read_yaml, shortly
from kit.plates import (
    SMALL_TABLE_HZ,
    Realised,
    contact_sets,
    realised,
    small_table,
    smooth_rig,
)
from kit.set_table import phased, wants
from model.answer.answer import (
    MIN_CONTRAST_DB,
    MIXED,
    OWN,
    Answer,
    Limits,
    Sensation,
)
from model.answer.plan import answer
from model.answer.stimulus import BY_NAME, MUST, Finger, Stimulus
from model.arrays import FloatArray, Point
from model.ensemble.draws import ClockErrors
from model.finger import THRESHOLDS, detection_threshold
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import load_rig
from model.rig.rig_writing import change_rig
from model.study.exact_plates import draw_plates
from model.table.table import LocalizationTable
from model.table.table_file import build_table

EXAMPLES = Path(__file__).parents[3] / "examples"

# Drawn plates

AMPLIFIER_OF_ERA = [0, 1, 0, 1]


@dataclass(frozen=True)
class Case:
    """A promise and the plates that must keep it, as described in `promises.yaml`."""

    promised: str
    plate: str
    contents: Sequence[Mapping[str, Any]]
    draws: Mapping[str, int]
    rig: Mapping[str, Any] = field(default_factory=dict)
    by: Sequence[str] = ()
    known: Mapping[str, Any] = field(default_factory=dict)
    believed: Mapping[str, Any] = field(default_factory=dict)
    hertz: Sequence[float] = ()
    mode: str = "phased"
    quiet: Sequence[int] = (0,)
    late: float | str = 0.0
    judged: Sequence[str | None] = (None,)
    kept: Mapping[str, Sequence[float]] = field(default_factory=dict)
    tenth: float = math.inf
    median: float = math.inf
    numpy: bool = False
    long: bool = False

    @property
    def true_rig(self) -> Rig:
        """The rig of the drawn plates."""
        rig = smooth_rig() if self.plate == "paper" else load_rig(EXAMPLES / "weekend/rig.yaml")
        if self.rig:
            rig = change_rig(rig, **self.rig)
        if self.known:
            rig = replace(rig, uncertainty=replace(Uncertainty.none(), **self.known))
        if self.by:
            rig = replace(rig, promised_thresholds=tuple(self.by))
        return rig

    @property
    def frequencies(self) -> FloatArray:
        """Frequencies of the table [Hz]."""
        if not self.hertz:
            return SMALL_TABLE_HZ
        first, last, step = self.hertz
        return np.arange(first, last + 1, step, dtype=float)

    @cached_property
    def stimuli(self) -> list[Stimulus]:
        """A stimulus for each finger with a content."""
        return [Stimulus(**keys) for keys in self.contents]

    def believing(self, table: LocalizationTable) -> LocalizationTable:
        """Return the table that promises, with the tolerances that it believes."""
        believed = dict(self.believed)
        late = believed.pop("late", self.late)
        table = replace(table, uncertainty=replace(table.uncertainty, **believed))
        if not late:
            return table
        error = math.inf if late == "anyhow" else float(late)
        return table.with_clocks(ClockErrors(tuple(AMPLIFIER_OF_ERA), (error, error)))

    def delays(self, rng: np.random.Generator) -> FloatArray | None:
        """Return delays (d, eras) of the drives [s], None if there are none."""
        shape = (self.draws["plates"], 2)
        if not self.late:
            return None
        if self.late == "anyhow":
            return rng.uniform(0, 1, shape)[:, AMPLIFIER_OF_ERA]
        return rng.normal(0, self.late, shape)[:, AMPLIFIER_OF_ERA]


CASES = {
    keys["promised"]: Case(**keys) for keys in read_yaml(Path(__file__).with_name("promises.yaml"))
}


@cache
def table_of(name: str) -> LocalizationTable:
    """Return the table with the tolerances of the plates that are drawn."""
    case = CASES[name]
    return build_table(case.true_rig, frequencies=case.frequencies, drive_mode=case.mode)


def shares_that_keep(answer: Answer, fields: Sequence[Realised]) -> dict[str, float]:
    """Return the share of plates that keeps each promise.

    fields: of the plates, by each set of thresholds; the set counts that is kept least often.
    """
    served = sum(sensation.layer is not None for sensation in answer.fingers)
    levels = column(answer, "promised_level_db_sl")
    contrasts = column(answer, "promised_contrast_db")
    crosstalk = column(answer, "foreign_level_db_sl")
    shares: dict[str, list[FloatArray]] = defaultdict(list)
    for realised_field in fields:
        worst = realised_field.contrast.min(axis=0, keepdims=True)
        is_kept = {
            "worst": worst >= answer.promised_worst_db,
            "level": (realised_field.own >= levels)[:served],
            "contrast": (realised_field.contrast >= contrasts)[:served],
            "foreign": realised_field.foreign <= crosstalk,
        }
        for promise, plates in is_kept.items():
            shares[promise].append(plates.mean(axis=1))
    return {promise: float(np.min(by_set, axis=0).mean()) for promise, by_set in shares.items()}


def column(answer: Answer, name: str) -> FloatArray:
    """Return a figure of all fingers (k, 1), NaN for None."""
    return np.array([[getattr(sensation, name)] for sensation in answer.fingers], dtype=float)


def check_promises(name: str) -> None:
    """Answer each set of fingers, solve the plates drawn for it, and count kept promises."""
    case = CASES[name]
    table = table_of(name)
    believing_table = case.believing(table)
    own_count = len(case.stimuli)
    finger_count = own_count + max(case.quiet)
    sets = contact_sets(
        case.draws["sets"], fingers=finger_count, seed=case.draws["seed"], plate=table.plate
    )
    shares = defaultdict(list)
    median_errors = []
    modulated_count = 0
    for seed, (places, quiet_count) in enumerate(zip(sets, cycle(case.quiet), strict=False)):
        fingers = [Finger(*pair) for pair in zip(places, case.stimuli, strict=False)]
        quiet = places[own_count : own_count + quiet_count]
        promised = answer(
            believing_table, fingers, quiet=quiet, drive_mode=case.mode, min_contrast_db=-99.0
        )
        rng = np.random.default_rng(seed)
        plates = draw_plates(
            rng,
            table.uncertainty,
            of=table,
            count=case.draws["plates"],
            contact_count=own_count + quiet_count,
        )
        late = case.delays(rng)
        fields = []
        for threshold in case.judged:
            fields.append(realised(table, promised, plates, threshold=threshold, late=late))

        for promise, share in shares_that_keep(promised, fields).items():
            shares[promise].append(share)
        contrasts = fields[0].contrast.min(axis=0)
        tenth = np.percentile(contrasts, 10)
        assert promised.promised_worst_db == pytest.approx(tenth, abs=case.tenth), seed
        median = promised.fingers[0].median_contrast_db or 0.0
        median_errors.append(np.median(contrasts) - median)
        modulated_count += any(layer.side_bands for layer in promised.layers)

    for promise, (low, high) in case.kept.items():
        assert low <= np.mean(shares[promise]) <= high, promise
    assert np.mean(median_errors) == pytest.approx(0, abs=case.median)
    if case.stimuli[0].modulation_hz:
        assert modulated_count >= len(sets) / 2


SHORT_CASES = [name for name, case in CASES.items() if not case.long]


@pytest.mark.parametrize("name", shortly(CASES, SHORT_CASES))
def test_promises_are_kept_by_90_percent_of_plates(name: str) -> None:
    """Each share is within the bounds of its case, on plates solved exactly."""
    check_promises(name)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.numpy])
def test_promises_without_kernels_are_kept(name: str, without_kernels: Callable[[], None]) -> None:
    """The same where there is no compiler."""
    without_kernels()

    check_promises(name)


# Limits

TARGET = (0.09, 0.07)
QUIET = Finger((0.16, 0.20))
STROKE = 100e-6  # m
LOW_STROKE_OF_SW = {"SW": 0.6 * STROKE, "SE": STROKE, "NE": STROKE, "NW": STROKE}


@pytest.mark.parametrize("duration", [None, 0.04])
@pytest.mark.parametrize(
    "limits",
    [Limits(), Limits(amplitudes=LOW_STROKE_OF_SW), Limits(power=0.3125)],
    ids=["stroke", "amplitudes", "power"],
)
def test_drive_stays_within_its_limits(limits: Limits, duration: float | None) -> None:
    """A level of 60 dB SL, too high for all, is lowered to what they allow."""
    table = small_table()
    finger = Finger(TARGET, Stimulus(60.0, duration=duration))

    lowered = answer(table, [finger], drive_mode="phased", limits=limits)

    assert limits.factor_within(lowered.layers, table) == pytest.approx(1.0, abs=1e-6)
    allowed = limits.amplitudes or table.full_levels
    amplitudes = lowered.amplitudes
    power = sum((amplitude / STROKE) ** 2 for amplitude in amplitudes.values())
    levels = [amplitudes[name] / allowed[name] for name in amplitudes]
    assert max(*levels, power / limits.power) == pytest.approx(1.0, rel=1e-3)
    sensation = lowered.fingers[0]
    assert 20.0 < sensation.level_db_sl < 60.0
    assert sensation.lowered_db > 1.0


# Hands

SPACING = 0.021
"""Distance between the fingers of a hand [m]."""
DISTANCE = 0.09
"""Minimum distance of another person's finger from the hand [m]."""
MARGIN = 0.02
"""Distance of all fingers from the edge [m]."""


@cache
def example_table() -> LocalizationTable:
    """Return the table of four ERAs with the tolerances of parts as bought."""
    return build_table(load_rig(EXAMPLES / "paper_plate.yaml"))


@cache
def hands() -> list[list[Point]]:
    """Return eight hands: three fingers in a row, and another person's finger."""
    rng = np.random.default_rng(3)
    plate = example_table().plate
    corner = np.array([plate.length, plate.width]) - MARGIN
    accepted: list[list[Point]] = []
    while len(accepted) < 8:
        middle, far = rng.uniform(MARGIN, corner, (2, 2))
        angle = rng.uniform(0, 2 * math.pi)
        step = SPACING * np.array([math.cos(angle), math.sin(angle)])
        hand = middle + np.outer([-1, 0, 1], step)
        is_inside = ((hand >= MARGIN) & (hand <= corner)).all()
        if is_inside and np.linalg.norm(hand - far, axis=1).min() >= DISTANCE:
            accepted.append([(float(x), float(y)) for x, y in (*hand, far)])
    return accepted


def fingers_at(places: Sequence[Point], names: str, sharing: str) -> list[Finger]:
    """Return the three fingers of a hand that share in this way, and the other person's finger."""
    *hand, far = [Stimulus(14, name=name) for name in names]
    fingers = []
    for place, stimulus in zip(places, hand, strict=False):
        fingers.append(Finger(place, stimulus, sharing=sharing))
    return [*fingers, Finger(places[3], far, sharing=BY_NAME)]


def is_served(sensation: Sensation) -> bool:
    """Whether a finger feels its own content, 6 dB above all others on 90 % of plates."""
    is_own = sensation.verdict in (OWN, MIXED)
    return is_own and sensation.promised_contrast_db >= MIN_CONTRAST_DB


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 0, 1, 2)], ids=["hand first", "far first"])
def test_hand_with_three_contents_silences_no_other_person(order: tuple[int, ...]) -> None:
    """A person who is served next to a hand with one content is served next to three contents."""
    for places in hands():
        single = phased(example_table(), fingers_at(places, "aaad", MUST))
        fingers = fingers_at(places, "abcd", BY_NAME)

        served = phased(example_table(), [fingers[number] for number in order])

        assert is_served(single.fingers[3])
        *hand, far = [served.fingers[order.index(number)] for number in range(4)]
        assert is_served(far)
        assert is_served(hand[0])
        assert [sensation.verdict for sensation in hand[1:]] == ["shared", "shared"]
        assert len({sensation.layer for sensation in hand}) == 1
        assert served.promised_worst_db == pytest.approx(single.promised_worst_db, abs=1.0)


# Sets of thresholds

PROBE, PRESSING = "vibrotactile-probe", "pressing-fingertip"


@cache
def table_by(*sets: str) -> LocalizationTable:
    """Return the table of the paper's rig whose promises hold by these sets of thresholds."""
    rig = replace(smooth_rig(), promised_thresholds=sets)
    return build_table(rig, frequencies=np.linspace(40.0, 320.0, 29))


def test_levels_and_bounds_are_above_the_rigs_own_thresholds() -> None:
    """A second set changes neither the level nor, for a content alone, the contrast.

    The crosstalk is promised by the second set too, but bounds that fingers state refer to the
    rig's own.
    """
    fingers = [wants(TARGET)]
    rigs_own = phased(table_by(PROBE), fingers, [QUIET])
    by_all = phased(table_by(*THRESHOLDS), fingers, [QUIET])

    assert by_all.layers[0].excitation == rigs_own.layers[0].excitation
    expected = rigs_own.fingers[0]
    sensation = by_all.fingers[0]
    assert sensation.level_db_sl == pytest.approx(expected.level_db_sl, abs=1e-3)
    contrast = expected.promised_contrast_db
    assert sensation.promised_contrast_db == pytest.approx(contrast, abs=1e-3)
    frequency = np.array([by_all.layers[0].frequency])
    (ratio,) = detection_threshold(frequency, PROBE) / detection_threshold(frequency, PRESSING)
    crosstalk = rigs_own.fingers[1].foreign_level_db_sl
    crosstalk_by_all = crosstalk + 20 * np.log10(ratio)
    assert by_all.fingers[1].foreign_level_db_sl == pytest.approx(crosstalk_by_all, abs=1e-3)

    bounded = replace(QUIET, max_foreign_db_sl=crosstalk + 0.1)
    within_bound = phased(table_by(*THRESHOLDS), fingers, [bounded])
    assert within_bound.fingers[0].verdict == OWN
    assert within_bound.fingers[1].foreign_level_db_sl > crosstalk + 20
