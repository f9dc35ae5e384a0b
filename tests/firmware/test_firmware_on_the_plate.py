"""The samples of the firmware drive the plate in time: what fingers feel of a pattern."""

import cmath
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from firmware_script import Script, Shape, apply, arm, command, replay
from model.arrays import FloatArray
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import felt_part
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import fingertip_loads, footprints_of
from model.table.pattern import Pattern
from model.table.question import Question
from model.table.timing import Timing
from model.transients.base_motion import BaseEnvelope, Term, shaped
from moved_firmware import RATE
from paper_table import smooth_rig, smooth_table
from sim.plant.fingers import Record
from sim.plant.plant import Plant
from sim.plant.playback import Playback
from sim.plant.sampled import SampledPlant

pytestmark = pytest.mark.long

QUESTION = Question(((0.10, 0.03),), ((0.22, 0.16),))
COMMIT, END = 50.0, 1250.0  # ms; the set plays from one to the other
AFTER = 200.0  # ms
SETTLED = 0.3  # s


@dataclass(frozen=True)
class Played:
    """A pattern, and accelerations (n, p) [m/s²] under both fingers while the firmware played it.

    exact: the same by the envelopes themselves, without samples.
    """

    pattern: Pattern
    accelerations: FloatArray
    exact: FloatArray


def shape_of(envelope: BaseEnvelope | None, stroke: float) -> Shape | None:
    """Step [ms] and knots of an envelope of a base motion, but for its final amplitude."""
    if envelope is None:
        return None
    values = [value / stroke for value in envelope.knots[:-1]]
    return envelope.step * 1000, [(abs(v), math.degrees(cmath.phase(v))) for v in values]


def script_of(pattern: Pattern, rig: Rig) -> Script:
    """Arm, and play the pattern until it ends by itself."""
    onsets, endings = pattern.onset or {}, pattern.ending or {}
    commands = []
    for name in onsets.keys() | endings.keys():
        tone, stroke = pattern.excitation.get(name), rig.era(name).stroke
        commands.append(
            command(
                rig.wiring[name].number,
                (onsets or endings)[name].frequency,
                tone.amplitude / stroke if tone else 0.0,
                math.degrees(tone.phase) if tone else 0.0,
                onset=shape_of(onsets.get(name), stroke),
                ending=shape_of(endings.get(name), stroke),
            )
        )
    return [(COMMIT, arm()), (COMMIT, apply(1, *commands, valid_for_ms=round(END - COMMIT)))]


@pytest.fixture(scope="module")
def played(replaying: Path) -> Played:
    """A pattern with a shaped onset and ending, played by the firmware."""
    rig, table = smooth_rig(), smooth_table()
    timing = Timing(table)
    pattern = timing.with_envelopes(QUESTION, table.query(QUESTION))
    pattern = timing.with_transient_measures(QUESTION, pattern)
    samples, _ = replay(replaying, script_of(pattern, rig), END + AFTER)
    channels = [rig.wiring[era.name].number for era in rig.eras]
    bases = samples[round(COMMIT / 1000 * RATE) :, channels] * [era.stroke for era in rig.eras]

    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras, rig.masses))
    resting = fingertip_loads(rig.fingertip, QUESTION.contacts, QUESTION.loads)
    contacts = {str(number): each for number, each in enumerate(resting)}
    points = np.concatenate([fingertip_points(*at, rig.plate) for at in QUESTION.contacts])
    plant = Plant(reduced, rig.eras, loads=rig.masses, time=0.0)
    sampled = SampledPlant(plant, rate=RATE)
    plant.set_contacts(contacts)
    sampled.follow()
    felt = sampled.advance(bases, shapes=plant.reduced.at(points))
    for number, terms in enumerate(motion(pattern, rig)):
        plant.set_input(number, terms)
    until = (len(bases) - 1) / RATE
    _, exact = plant.advance(until, sample_rate=2 * RATE, shapes=plant.reduced.at(points))
    return Played(pattern, felt[1:], exact[::2])  # halfway between two samples


def on_the_wire(term: Term) -> float:
    """Its angular frequency [rad/s] in steps of 0.05 Hz."""
    return 2 * math.pi * round(20 * term.omega / (2 * math.pi)) / 20


def motion(pattern: Pattern, rig: Rig) -> list[list[Term]]:
    """The base motion of each ERA by the formulas of the pattern: onset, then ending.

    At the nearest frequency of the wire: within a second the phases would drift apart.
    """
    assert pattern.onset is not None
    assert pattern.ending is not None
    end = (END - COMMIT) / 1000
    onsets, endings = shaped(pattern.onset, rig.eras), shaped(pattern.ending, rig.eras)
    whole = []
    for onset, ending in zip(onsets, endings, strict=True):
        before = [term._replace(end=min(term.end, end), omega=on_the_wire(term)) for term in onset]
        after = [
            term._replace(
                start=term.start + end,
                end=term.end + end,
                omega=on_the_wire(term),
                c0=cmath.exp(1j * on_the_wire(term) * end) * term.c0,
                c1=cmath.exp(1j * on_the_wire(term) * end) * term.c1,
            )
            for term in ending
        ]
        whole.append([*before, *after])
    return whole


def test_fingers_feel_what_the_pattern_promised(played: Played) -> None:
    """Level at the target and felt contrast, steady and over the first 100 ms, within 0.5 dB."""
    rig, pattern = smooth_rig(), played.pattern
    times = np.arange(len(played.accelerations)) / RATE
    playing = times < (END - COMMIT) / 1000
    discs = [fingertip_points(*at, rig.plate) for at in QUESTION.contacts]
    target, quiet = (
        Record(disc, fingertip_weights(*at, rig.plate), times[playing], part[playing])
        for at, disc, part in zip(
            QUESTION.contacts,
            discs,
            np.split(played.accelerations, [len(discs[0])], axis=1),
            strict=True,
        )
    )
    frequencies = tuple(sorted({tone.frequency for tone in pattern.excitation.values()}))
    felt = Playback(frequencies, (target,), (quiet,), SETTLED, rig.threshold)
    assert felt.level_db_sl == pytest.approx(pattern.level_db_sl, abs=0.5)
    assert felt.felt_contrast_db == pytest.approx(pattern.felt_contrast_db, abs=0.5)
    assert felt.transient_contrast_db == pytest.approx(pattern.transient_contrast_db, abs=0.5)


def test_onset_and_brake_move_the_plate_as_their_formulas(played: Played) -> None:
    """Of what skin can feel, at every sample, also once the bases stand still.

    Within 2 % of the steady vibration. Beyond that band the steps of 16-bit samples show.
    """
    exact, made = (felt_part(each, RATE) for each in (played.exact, played.accelerations))
    steady = np.abs(exact).max()
    assert np.abs(made - exact).max() < 0.02 * steady
    still = made[round((END - COMMIT + 50) / 1000 * RATE) :]
    assert 0 < np.abs(still).max() < 0.1 * steady
