"""What each finger feels of a touch stream, over every wire and over two in virtual time.

The direct solver and the model's answer on the drawn plate say what is to be felt, where, and when.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from cases import shortly
from kit.direct_plate import direct_responder
from kit.plates import TWO_AMPLIFIERS, write_rig
from kit.set_table import only
from model.answer.answer import Layer
from model.answer.stimulus import Placement
from model.arrays import ComplexArray, FloatArray
from model.ensemble.draws import ClockErrors
from model.finger import (
    Grid,
    contrast_db,
    fingertip_points,
    mean_level_db_sl,
)
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.structure.fingertips import FingertipLoad
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from sim.far_ends.wire_assignment import FAR_ENDS
from sim.plant.imperfections import Imperfections, draw_imperfections
from tests.integration.streams import (
    LEVEL_DB_SL,
    SENSORS,
    Heard,
    Played,
    Situation,
    Stream,
    play_stream,
)

STROKE = 100e-6  # m; of every ERA in the example
JUDGED_UP_TO = 25.0  # dB; no model predicts what a quiet finger feels beyond that
LEVEL_STEP, PHASE_STEP = 1e-4, 0.01  # the wires' own: full strokes, degrees


@dataclass(frozen=True)
class Truth:
    """The true rig, its table and the stream."""

    rig: Rig
    table: LocalizationTable
    stream: Stream
    drive_mode: str = "phased"

    def placed(self, situation: Situation) -> Placement:
        """The fingers of a situation."""
        target = self.stream.places[situation.felt_at]
        quiet = [self.stream.places[place] for place in situation.quiet]
        return Placement((target,), tuple(quiet))

    def layer(self, heard: Heard) -> Layer:
        """What is to play in a situation, by clocks as far off as they were known to be."""
        table = self.table
        if heard.clocks:
            eras = [era.name for era in table.eras]
            clock_errors = ClockErrors.of(eras, self.rig.wiring, heard.clocks)
            table = table.with_clocks(clock_errors)
        layer, _ = only(
            table,
            self.placed(heard.situation),
            LEVEL_DB_SL,
            drive_mode=self.drive_mode,
            band_hz=(40.0, 500.0),
        )
        return layer

    def fields(self, heard: Heard, points: FloatArray) -> tuple[FloatArray, ComplexArray]:
        """Frequencies (f,) [Hz] of the reported pattern, and its acceleration (f, p) [m/s²]."""
        drive = heard.patterns[-1]["drive"]
        played_frequencies = {tone["frequency_hz"] for tone in drive.values()}
        frequencies = np.array(sorted(played_frequencies))
        drawn_rig = self.drawn.plate.realised(self.rig)
        solve = direct_responder(drawn_rig.plate, drawn_rig.mesh)
        loads = list(self.resting(heard.situation).values())
        fields_of_eras = solve(drawn_rig.eras, frequencies, points, loads=loads)
        names = [era.name for era in self.rig.eras]
        shape = (len(frequencies), len(names))
        weights = np.zeros(shape, dtype=complex)
        for name, tone in drive.items():
            row = int(np.searchsorted(frequencies, tone["frequency_hz"]))
            errors = self.drawn.channels[self.rig.wiring[name]]
            phase = math.radians(tone["phase_deg"]) + errors.phase
            weight = tone["level"] * errors.gain * np.exp(1j * phase)
            weights[row, names.index(name)] = weight
        return frequencies, np.einsum("fe,fep->fp", weights, fields_of_eras)

    @property
    def drawn(self) -> Imperfections:
        """In what the plate differs from the rig."""
        return draw_imperfections(self.rig)

    def resting(self, situation: Situation) -> dict[str, FingertipLoad]:
        """The fingers of a situation by place, each with its load."""
        loads = dict[str, FingertipLoad]()
        for place in situation.fingers.values():
            load = self.drawn.load_of(place, self.rig.fingertip)
            loads[place] = FingertipLoad(*self.stream.places[place], load)
        return loads

    def fingertip(self, place: str) -> FloatArray:
        """Points (p, 2) [m] of the fingertip there."""
        return fingertip_points(*self.stream.places[place], self.rig.plate)


def patterns_match_table(played: Played, truth: Truth) -> None:
    """Each situation has one pattern: the ERAs, frequencies, levels and phases of the table."""
    for heard in _touched(played):
        assert len(heard.patterns) == 1, heard.situation
        (pattern,) = heard.patterns
        tones = truth.layer(heard).excitation
        assert pattern["drive"].keys() == tones.keys()
        for name, tone in tones.items():
            reported = pattern["drive"][name]
            assert reported["frequency_hz"] == tone.frequency, name
            level = tone.amplitude / STROKE
            assert reported["level"] == pytest.approx(level, abs=0.51 * LEVEL_STEP), name
            phase = math.degrees(tone.phase)
            phase_error = math.remainder(reported["phase_deg"] - phase, 360)
            assert abs(phase_error) <= 0.51 * PHASE_STEP, name
        frequencies = {tone.frequency for tone in tones.values()}
        for place, felt in heard.steady.items():
            assert set(felt.frequencies) == frequencies, place


def plate_response_matches_model(played: Played, truth: Truth) -> None:
    """Sensors agree with the direct solver for that drive; phases have any common origin.

    Within 1 % of the largest, each frequency turned to where they agree best: structural damping is
    viscous in time, and other modes still ring.
    """
    points = np.array(list(SENSORS.values()))
    for heard in _touched(played):
        _, fields = truth.fields(heard, points)
        assert heard.phasors.shape == fields.shape
        common = (fields.conj() * heard.phasors).sum(axis=1)
        origins = np.exp(-1j * np.angle(common))
        turned = heard.phasors * origins[:, None]
        errors = np.abs(turned - fields).max(axis=1)
        relative_errors = errors / np.abs(fields).max(axis=1)
        assert relative_errors.max() <= 0.01, heard.situation


def localization_matches_prediction(played: Played, truth: Truth) -> None:
    """Contrast within 1 dB up to 25 dB, level within 1 dB of the solver, and at least the promise.

    On the plate that is drawn first all situations keep it.
    """
    for heard in _touched(played):
        situation = heard.situation
        target = heard.steady[situation.felt_at]
        frequencies = np.array(target.frequencies)
        pattern = heard.patterns[-1]
        contacts = {contact["role"]: contact for contact in pattern["contacts"]}
        contact = contacts["target"]
        assert contact["level_db_sl"] == pytest.approx(LEVEL_DB_SL, abs=1e-5)
        fields = dict[str, FloatArray]()
        for place in situation.fingers.values():
            _, field = truth.fields(heard, truth.fingertip(place))
            fields[place] = np.abs(field)

        level = mean_level_db_sl(frequencies, target.amplitude, target.weights)
        target_field = fields[situation.felt_at]
        solved_level = mean_level_db_sl(frequencies, target_field, target.weights)
        assert level == pytest.approx(solved_level, abs=1), situation

        if situation.quiet:
            assert contact["contrast_db"] == pattern["predicted_contrast_db"]
            felt_sums = {place: felt.amplitude.sum(axis=0) for place, felt in heard.steady.items()}
            contrast = _contrast(felt_sums, situation, target.weights)
            solved_sums = {place: field.sum(axis=0) for place, field in fields.items()}
            solved_contrast = _contrast(solved_sums, situation, target.weights)
            judged = min(contrast, JUDGED_UP_TO)
            assert judged == pytest.approx(min(solved_contrast, JUDGED_UP_TO), abs=1), situation
            assert 3 < pattern["promised_contrast_db"] <= contrast, situation


def plate_decays(played: Played, truth: Truth) -> None:
    """After that the plate rings on by itself, and less: by 13 dB from the steady state at once.

    In the last 20 ms of a pause of 0.2 s or more. Modes above 40 Hz fade by 6 /s and faster, and
    the slowest, at 32 Hz, takes a small part in what is played at 80 Hz and above.
    """
    residuals = []
    for loaded, unloaded in pairwise(played.heard):
        if unloaded.fading is None or loaded.phasors is None:
            continue
        is_last = unloaded.fading.times >= unloaded.end - 0.02
        last_samples = unloaded.fading.samples[is_last]
        residual_power = (last_samples**2).sum(axis=1).mean()
        steady_power = (np.abs(loaded.phasors) ** 2).sum() / 2
        residuals.append(residual_power / steady_power)
    assert max(residuals) < 0.05, residuals


def all_is_off_in_the_end(played: Played, truth: Truth) -> None:
    """Every amplifier is silent, without high voltage and without a fault."""
    for amplifier in played.summaries:
        assert (amplifier.state, amplifier.fault) == ("SWITCH_ON_DISABLED", "NONE"), amplifier
        assert not amplifier.is_high_voltage, amplifier
        assert max(amplifier.levels) == 0, amplifier


def no_rule_is_broken(played: Played, truth: Truth) -> None:
    """No rule is broken: patterns and silences are in time, levels within limits."""
    assert not played.violations, played.violations[0]


Check = Callable[[Played, Truth], None]
CHECKS: tuple[Check, ...] = (
    patterns_match_table,
    plate_response_matches_model,
    localization_matches_prediction,
    plate_decays,
    all_is_off_in_the_end,
    no_rule_is_broken,
)


def _touched(played: Played) -> list[Heard]:
    """Situations with fingers, each of which must have a pattern."""
    touched = [heard for heard in played.heard if heard.situation.fingers]
    for heard in touched:
        assert heard.patterns, heard.situation
    return touched


def _contrast(peaks: Mapping[str, FloatArray], situation: Situation, weights: FloatArray) -> float:
    """From the target to the loudest quiet point, of peaks (p,) by place [dB].

    weights (p,): of the points in the mean over the target.
    """
    quiet = np.concatenate([peaks[place] for place in situation.quiet])
    target = peaks[situation.felt_at]
    return float(contrast_db([target], quiet, [weights]))


PLACES = {
    "A": (0.07, 0.06),
    "B": (0.04, 0.17),
    "C": (0.16, 0.19),
    "D": (0.05, 0.05),
    "E": (0.24, 0.08),
    "F": (0.26, 0.11),
}
STREAM = Stream(
    PLACES,
    [
        (0.1, {1: "B", 2: "C"}),  # two at once on a plate at rest: the second is the target
        (0.8, {1: "B", 2: "C", 3: "D", 4: "E"}),  # three are to be quiet
        (1.4, {1: "B", 2: "C", 3: "D", 4: "F"}),  # the target moves by 36 mm
        (2.0, {1: "B", 2: "C", 3: "D"}),  # it lifts: the one before is the target again
        (2.6, {}),  # the last up
        (2.9, {5: "A"}),  # one finger
        (3.5, {}),
        (3.8, {}),
    ],
)
SHORT = Stream(PLACES, [*STREAM.changes[:1], (0.8, {}), (1.1, {})])
"""Stream for the other wires, since the daemon's decisions do not depend on the wire."""

TURNS = Stream(
    {"A": (0.16, 0.20), "B": (0.25, 0.09), "C": (0.15, 0.05)},
    [
        (0.1, {1: "B", 2: "C"}),  # SW and SE, on one amplifier
        (1.0, {}),
        (1.3, {3: "A"}),  # NE and NW, on the other
        (2.0, {}),
        (2.5, {}),
    ],
)
"""Commits on two wires are apart by what the lines make of them: each pattern is of one of them."""

WIRES = tuple(FAR_ENDS)
SHORTLY = ("serial", "modbus-rtu")


def truth_of(folder: Path, stream: Stream, *changes: tuple[str, str], **options: str) -> Truth:
    """The true rig and its table, without the chain; changes: in the rig's text."""
    rig = load_rig(write_rig(folder / "truth.yaml", *changes, mesh="auto"))
    table = build_table(rig, frequencies=np.arange(80.0, 321.0, 40.0), grid=Grid(4, 3))
    return Truth(rig, table, stream, **options)


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    """That of one amplifier."""
    return truth_of(tmp_path_factory.mktemp("truth"), STREAM)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """The rig as the controller and the plate have it."""
    return load_rig(write_rig(tmp_path_factory.mktemp("rig") / "rig.yaml"))


@pytest.fixture(scope="module")
def played(truth: Truth, rig: Rig) -> Callable[[str], Played]:
    """Result over a wire: of the full stream over the first, of the short one over the others."""

    @cache
    def over(wire: str) -> Played:
        stream = STREAM if wire == WIRES[0] else SHORT
        return play_stream(stream, {"main": wire}, rig, truth.table)

    return over


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("wire", shortly(WIRES, SHORTLY))
def test_fingers_feel_the_commanded_pattern(
    played: Callable[[str], Played], truth: Truth, wire: str, check: Check
) -> None:
    """Every check passes over every wire."""
    check(played(wire), truth)


@pytest.fixture(scope="module")
def turns(tmp_path_factory: pytest.TempPathFactory) -> tuple[Played, Truth]:
    """What came of two amplifiers on two wires that take turns."""
    folder = tmp_path_factory.mktemp("turns")
    truth = truth_of(folder, TURNS, *TWO_AMPLIFIERS, drive_mode="switched")
    rig = load_rig(write_rig(folder / "rig.yaml", *TWO_AMPLIFIERS))
    wires = {"main": "serial", "side": "modbus-tcp"}
    return play_stream(TURNS, wires, rig, truth.table, drive_mode="switched"), truth


def test_amplifiers_take_turns(turns: tuple[Played, Truth]) -> None:
    """Two ERAs of one amplifier, then two of the other one."""
    played, truth = turns
    amplifiers = list[list[str]]()
    for heard in played.heard:
        for pattern in heard.patterns:
            channels = [truth.rig.wiring[era] for era in pattern["drive"]]
            amplifiers.append([channel.amplifier for channel in channels])
    assert amplifiers == [["main", "main"], ["side", "side"]]


@pytest.mark.parametrize("check", CHECKS)
def test_fingers_feel_the_commanded_pattern_over_two_wires(
    turns: tuple[Played, Truth], check: Check
) -> None:
    """What holds over one wire holds where two amplifiers on two wires play together."""
    check(*turns)
