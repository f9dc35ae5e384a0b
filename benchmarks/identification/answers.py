"""The model's answers for a rig as written, as identified, and for the plate known exactly."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.identification.hidden import finger_stiffness
from benchmarks.identification.thin_plate import Complexes, Mounted, Reals
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import Complex64Array
from model.ensemble.attached_plate import AttachedPlate
from model.rig.rig import Rig, Uncertainty
from model.structure.attachments import Era, PointLoad
from model.structure.plate import LOSS_FREQUENCY
from model.table.table import LocalizationTable
from model.table.table_file import build_table

DRIVES = Uncertainty(gain=0.01, phase_deg=1, thickness=0, stiffness=0, damping=1, fingertip=0)


@dataclass(frozen=True, eq=False)
class _UnderKnownFingers(AttachedPlate):
    """A plate whose fingers are of dynamic stiffness (f, k) [N/m], of none for k = 0."""

    fingers: Complex64Array

    def finger_stiffness(self, count: int, loads: Sequence[float] = ()) -> Complex64Array:
        """As they are."""
        is_known = self.fingers.shape[-1] == count
        return self.fingers if is_known else super().finger_stiffness(count, loads)


def table_of(rig: Rig, frequencies: Reals, *, loaded: bool) -> LocalizationTable:
    """The table of a rig with the rig's fingers or weightless ones."""
    fingertip = rig.fingertip if loaded else None
    return build_table(
        replace(rig, fingertip=fingertip), frequencies=frequencies, drive_mode="phased"
    )


def known_table(
    table: LocalizationTable, own: Mounted, shapes: Reals, factors: Reals
) -> LocalizationTable:
    """A table of the plate as it is, and of fingers (k, 4) as they are, if not weightless.

    shapes (p, r): of the plate at the table's points.
    """
    eras = tuple(
        replace(
            era,
            x=float(own.at[n, 0]),
            y=float(own.at[n, 1]),
            stiffness=float(own.stiffness[n]),
            damping=float(own.damping[n]),
            bolt_mass=float(own.bolt[n]),
            gains=((LOSS_FREQUENCY, float(abs(own.gain[n])), float(np.angle(own.gain[n]))),),
        )
        for n, era in enumerate(table.eras)
        if isinstance(era, Era)
    )
    known = replace(
        table,
        eras=eras,
        masses=tuple(PointLoad(x, y, mass=mass) for x, y, mass in own.masses.tolist()),
        uncertainty=DRIVES,
        omega=np.sqrt(own.plate.modes[0]),
        losses=np.zeros(len(own.plate.modes[0])),
        attachment_shapes=own.attached,
        shapes=shapes.astype(np.float32),
        discretisation_error=np.zeros(len(table.frequencies)),
    )
    # Its loss is not hysteretic, and its fingers are not multiples of one.
    stiffness = [[finger_stiffness(float(f), each) for each in factors] for f in table.frequencies]
    receptance = np.array([own.receptance(float(f)) for f in table.frequencies])
    square = (2 * np.pi * table.frequencies[:, None]) ** 2
    known.__dict__["attached"] = _UnderKnownFingers(
        **(vars(known.attached) | {"modal": 1 / receptance + square}),
        fingers=np.array(stiffness, dtype=np.complex64),
    )
    return known


@dataclass(frozen=True, eq=False)
class Answer:
    """A tone for a target among quiet fingers, with what nine of ten plates shall give.

    frequency [Hz]; bases (n,): amplitudes [m]; threshold [m/s²] there; contrast, level [dB, dB SL].
    """

    frequency: float
    bases: Complexes
    threshold: float
    contrast: float
    level: float


def answer(table: LocalizationTable, places: Reals) -> Answer:
    """The table's answer for fingers (k, 2) [m], the first the target."""
    points = [(float(x), float(y)) for x, y in places]
    found = query(table, Placement((points[0],), tuple(points[1:])), 0.0)
    tones = [found.layers[0].excitation.get(era.name) for era in table.eras]
    (frequency,) = {tone.frequency for tone in tones if tone is not None}
    contrast = found.fingers[0].promised_contrast_db
    level = found.fingers[0].promised_level_db_sl
    assert contrast is not None
    return Answer(
        float(frequency),
        np.array([0 if tone is None else tone.phasor for tone in tones], dtype=complex),
        float(np.interp(frequency, table.frequencies, table.thresholds)),
        contrast,
        level,
    )
