"""Promises to clicks on plates that vibrate in time: `python -m benchmarks.promise clicks`.

Clicks of 40 ms and 20 dB SL with plain ramps, and one to three quiet fingers at random positions,
5 cm apart. Each set has its own plates, drawn within the uncertainty. The contrast is the level at
the target over the click, relative to the strongest part of equal duration at the loudest quiet
point, including ringing. Each cell has the median promise and the share of plates that keep it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.promise.cases import EXAMPLES, IDENTIFIED
from model.answer.answer import Answer
from model.answer.envelope import DriveEnvelope
from model.answer.plan import query
from model.answer.ringing import RingingUnderFingers
from model.answer.stimulus import Placement
from model.arrays import ComplexArray, FloatArray, Point
from model.finger import fingertip_points, fingertip_weights
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.structure.attachments import footprints_of
from model.study.contact_sets import random_contacts
from model.study.exact_plates import draw_plates
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.vibration import Tone, base_amplitudes

RIGS = ("paper_plate", "eight_eras", "car_display", "table")
DURATION, LEVEL_DB_SL = 0.04, 20.0
SEED = 20
_SAME_PLACE = 1e-9  # m


def run(sets: int, plates: int) -> None:
    """Print a row for each rig."""
    print("| rig | default: promised, kept | identified: promised, kept |\n|---|---|---|")
    for name in RIGS:
        rig = load_rig(EXAMPLES / f"{name}.yaml")
        known = replace(rig, uncertainty=IDENTIFIED)
        cells = [_promised_and_kept(each, sets, plates) for each in (rig, known)]
        print(f"| `{name}` | {' | '.join(cells)} |", flush=True)


def _promised_and_kept(rig: Rig, sets: int, plates: int) -> str:
    table = build_table(rig, drive_mode="phased")
    clicks = clicks_on(table, sets, SEED)
    promises, kept = [], []
    for number, click in enumerate(clicks, start=1):
        promised = click.fingers[0].promised_contrast_db
        assert promised is not None
        promises.append(promised)
        kept.append(given(table, rig, [click], plates, SEED + number) >= promised)
    return f"{np.median(promises):.1f} dB, {100 * np.mean(kept):.0f} % of {sets * plates}"


def clicks_on(table: LocalizationTable, sets: int, seed: int) -> list[Answer]:
    """Return the answers for clicks with one to three quiet fingers in turn."""
    rng, found = np.random.default_rng(seed), []
    for number in range(sets):
        places = random_contacts(rng, 2 + number % 3, table.plate, margin=0.013)
        placed = Placement(places[:1], places[1:])
        found.append(query(table, placed, LEVEL_DB_SL, duration=DURATION, drive_mode="phased"))
    return found


def given(
    table: LocalizationTable, rig: Rig, answers: Sequence[Answer], plates: int, seed: int
) -> FloatArray:
    """Return the contrast (a, plates) [dB] of the first finger on plates within an uncertainty.

    For each answer: the level of its content relative to all others, or, for a single content,
    relative to its level at the loudest other finger.
    """
    found = np.empty((len(answers), plates))
    touches = _touches(rig, plates, max(len(each.contents.places) for each in answers), seed)
    for number, drawn in enumerate(_drawn_plates(table, rig, plates, seed)):
        for row, each in enumerate(answers):
            positions = zip(each.contents.places, touches[number], strict=False)
            places = tuple((x + dx, y + dy) for (x, y), (dx, dy) in positions)
            layers = range(len(each.layers))
            own, *others = (_felt_on(*drawn, each, places, layer) for layer in layers)
            heard = sum(power[0] for _, power in others) if others else own[1][1:].max()
            found[row, number] = 10 * math.log10(own[0] / heard)
    return found


def _touches(rig: Rig, plates: int, fingers: int, seed: int) -> list[list[list[float]]]:
    """Draw the displacement (plates, fingers, 2) [m] of fingers from their reported positions."""
    rng = np.random.default_rng([seed, 1])
    drawn = rig.uncertainty.touch_offset * rng.standard_normal((plates, fingers, 2))
    displacements: list[list[list[float]]] = drawn.tolist()
    return displacements


def _drawn_plates(
    table: LocalizationTable, rig: Rig, plates: int, seed: int
) -> Iterator[tuple[LocalizationTable, ComplexArray, ComplexArray]]:
    """Yield the table of each plate, and gains and second harmonics of its drives (eras,)."""
    drawn = draw_plates(
        np.random.default_rng(seed),
        rig.uncertainty,
        count=plates,
        of=rig,
        contact_count=1,
    )
    for number in range(plates):
        factor, finger = float(drawn.thickness[number]), rig.fingertip
        eras = tuple(
            replace(
                era,
                x=min(max(era.x + x, 0.0), rig.plate.length),
                y=min(max(era.y + y, 0.0), rig.plate.width),
                stiffness=k * era.stiffness,
                damping=drawn.damping[number] * era.damping,
            )
            for era, k, (x, y) in zip(
                rig.eras,
                drawn.stiffness[number].tolist(),
                drawn.places[number].tolist(),
                strict=True,
            )
        )
        plate = replace(
            rig.plate.scaled(modulus=float(drawn.modulus[number])),
            thickness=factor * rig.plate.thickness,
            loss_factor=float(drawn.loss[number]) * rig.plate.loss_factor,
        )
        load = float(drawn.load[number, 0])
        other = replace(rig, plate=plate, eras=eras, fingertip=finger and finger.multiplied(load))
        yield _table_on(table, other), drawn.gain[number], drawn.harmonic[number]


def _table_on(table: LocalizationTable, rig: Rig) -> LocalizationTable:
    """Return a table for a slightly different rig without building it.

    Modulus and thickness scale the modes of the table. Shapes at moved ERAs are interpolated on the
    sampling grid; masses and other ERAs keep their shapes.
    """
    thicker = rig.plate.thickness / table.plate.thickness
    faster = thicker * np.sqrt(rig.plate.material.E / table.plate.material.E)
    former = footprints_of(table.eras, table.masses)
    footprints = footprints_of(rig.eras, rig.masses)
    has_moved = np.abs(footprints - former).max(axis=1) >= _SAME_PLACE
    shapes = np.where(
        has_moved[:, None], table.shapes_at(footprints), table.attachment_shapes[: len(footprints)]
    )
    return replace(
        table,
        plate=rig.plate,
        eras=rig.eras,
        fingertip=rig.fingertip,
        omega=faster * table.omega,
        losses=faster**2 * table.losses,
        dispersion=faster**2 * table.dispersion,
        attachment_shapes=shapes / np.sqrt(thicker),
        shapes=(table.shapes / np.float32(np.sqrt(thicker))).astype(np.float32),
    )


def _felt_on(
    table: LocalizationTable,
    gains: ComplexArray,
    harmonic: ComplexArray,
    answer: Answer,
    places: tuple[Point, ...],
    number: int,
) -> tuple[float, FloatArray]:
    """Return the power to threshold of a layer at its first finger, and at all loudest points (k,).

    places: where the fingers of the answer touch the plate [m]. It is evaluated over the duration,
    at the strongest moments of a course, or in the steady state of a continuous layer.
    """
    contents, power = replace(answer.contents, places=places), 0.0
    steady = RingingUnderFingers(
        table, places, contents.loads, DriveEnvelope(np.ones(2), 1e-3, 1, share=0.0)
    )
    over = RingingUnderFingers.of_streams(table, contents)[number] or steady
    target, heard = contents.streams[number].targets[0], np.zeros(len(places))
    points = fingertip_points(*places[target], table.plate)
    weights = fingertip_weights(*places[target], table.plate)
    by_name = dict(zip((era.name for era in table.eras), gains.tolist(), strict=True))
    for excitation in answer.layers[number].excitations:
        tones = {
            name: Tone.from_phasor(tone.frequency, tone.phasor * by_name[name])
            for name, tone in excitation.items()
        }
        hertz, bases = base_amplitudes(tones, table.eras)
        frequencies, amplitudes = table.amplitudes(tones, points, contacts=places)
        thresholds = table.thresholds[table.rows_of(frequencies), None]
        level = float(np.linalg.norm(amplitudes / thresholds, axis=0) @ weights)
        played = over.over(zip(hertz.tolist(), bases, strict=True))
        harmonics = over.over(zip((2 * hertz).tolist(), bases * harmonic, strict=True))
        power += (level * float(played.gains[target])) ** 2
        heard += (played.heard + harmonics.heard).max(axis=1)
    return power, heard
