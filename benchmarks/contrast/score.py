"""The score of an entry: felt contrast on held-out plates, and on plates in time.

Of each set the tenth percentile over plates drawn within the rig's uncertainty and solved exactly
counts: what nine of ten plates give. A pattern that leaves the target of more than one plate in ten
over 0.5 dB below the level, and a set without a pattern, count 0 dB.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.contrast.data_set import BenchmarkPlate, ContactSet, DataSet, data_set
from model.answer.answer import Layer
from model.answer.stimulus import Stimulus, together
from model.finger import decibels
from model.processes import Progress, unseen
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.study.verification import draw_plates, felt_on
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.vibration import Excitation
from sim.plant.excited_plate import play
from sim.plant.imperfections import draw_imperfections

LEVEL_TOLERANCE_DB = 0.5
DURATION = 1.5  # s; the slowest mode has settled then


@dataclass(frozen=True)
class SetScore:
    """Contrast [dB] and level [dB SL] that nine of ten plates give; in time: of one plate, or None.

    contrast_db is 0 for a pattern below the level, or none.
    """

    plate: str
    quiet_count: int
    contrast_db: float
    level_db_sl: float | None
    in_time_db: float | None = None

    @property
    def is_missed(self) -> bool:
        """Whether there was no pattern that reached the level."""
        return self.contrast_db == 0.0


def score(
    excitations: Mapping[str, Excitation],
    *,
    in_time: bool = False,
    progress: Progress = unseen,
) -> dict[str, SetScore]:
    """Score the excitations by set, of every plate that has one; in_time: play each, too.

    progress: called with the number of sets that are done and the total. Raises InputError.
    """
    found = data_set()
    plates = [
        plate for plate in found.plates.values() if any(s.name in excitations for s in plate.sets)
    ]
    total = sum(len(plate.sets) for plate in plates)
    scores: dict[str, SetScore] = {}
    for plate in plates:
        for name, each in _of_plate(found, plate, excitations, in_time=in_time):
            scores[name] = each
            progress(len(scores), total)
    return scores


def summary(scores: Mapping[str, SetScore]) -> list[dict[str, Any]]:
    """A row by plate and number of quiet fingers: median and tenth percentile over the sets."""
    rows = []
    for plate, quiet in dict.fromkeys((s.plate, s.quiet_count) for s in scores.values()):
        some = [s for s in scores.values() if (s.plate, s.quiet_count) == (plate, quiet)]
        contrasts = [each.contrast_db for each in some]
        timed = [each.in_time_db for each in some if each.in_time_db is not None]
        rows.append(
            {
                "plate": plate,
                "quiet": quiet,
                "sets": len(some),
                "missed": sum(each.is_missed for each in some),
                "contrast_db": float(np.median(contrasts)),
                "tenth_percentile_db": float(np.percentile(contrasts, 10)),
                "in_time_db": float(np.median(timed)) if timed else None,
            }
        )
    return rows


def _of_plate(
    found: DataSet,
    plate: BenchmarkPlate,
    excitations: Mapping[str, Excitation],
    *,
    in_time: bool,
) -> Iterator[tuple[str, SetScore]]:
    rig = plate.rig
    played = [excitations[each.name] for each in plate.sets if each.name in excitations]
    frequencies = sorted({tone.frequency for each in played for tone in each.values()})
    table = build_table(rig, frequencies=np.array(frequencies))
    players = {seed: _InTime(rig, seed) for seed in found.in_time} if in_time else {}
    for number, each in enumerate(plate.sets):
        excitation = excitations.get(each.name)
        if excitation is None:
            yield each.name, SetScore(plate.name, each.quiet_count, 0.0, None)
            continue
        contrast, level = on_held_out(found, table, each, excitation)
        if level < found.level_db_sl - LEVEL_TOLERANCE_DB:
            contrast = 0.0
        timed = None
        if players:
            player = players[found.in_time[number % len(found.in_time)]]
            timed = player.felt_contrast_db(found, each, excitation)
        yield each.name, SetScore(plate.name, each.quiet_count, contrast, level, timed)


def on_held_out(
    found: DataSet, table: LocalizationTable, contacts: ContactSet, excitation: Excitation
) -> tuple[float, float]:
    """Felt contrast [dB] and level [dB SL] that nine of ten held-out plates give."""
    plates = draw_plates(
        np.random.default_rng([found.seed, contacts.number]),
        table.uncertainty,
        count=found.draws,
        of=table,
        contact_count=len(contacts.contacts),
    )
    level, contrast = felt_on(table, contacts.placement, excitation, plates)
    assert contrast is not None
    return (
        float(np.percentile(decibels(contrast), 10)),
        float(np.percentile(decibels(level), 10)),
    )


class _InTime:
    """A plate within the rig's uncertainty, on another mesh, that vibrates in time."""

    def __init__(self, rig: Rig, seed: int) -> None:
        self._rig = rig
        self._drawn = draw_imperfections(rig, seed=seed)
        real = self._drawn.plate.realised(rig)
        self._reduced = reduce_plate(
            real.plate,
            real.mesh,
            footprints_of(real.eras, real.masses),
            frequency_max=rig.limits.frequency_max,
        )

    def felt_contrast_db(
        self, found: DataSet, contacts: ContactSet, excitation: Excitation
    ) -> float | None:
        """Felt contrast [dB] of a steady excitation that starts along a ramp from rest."""
        return play(
            self._rig,
            self._reduced,
            [Layer(excitation)],
            together(contacts.placement, Stimulus()),
            duration=DURATION,
            imperfections=self._drawn,
        ).contrast_db
