"""Robust contrast: the tenth percentile over an ensemble of plates within tolerance.

Each plate is solved exactly in the reduced coordinates of the table, at the pattern's frequencies:

- gains of the ERAs differ by 5 %, phases by 5 degrees (normal, standard deviation);
- stiffness k_b of each ERA by up to 10 %, thickness by up to 2 % (uniform);
- all damping, the plate's and the ERAs', by up to a factor of 2 (uniform in its logarithm);
- every finger loads the plate (`model.finger.load`);
- the response at each fingertip is off by the discretisation error that the table states (complex
  normal), relative to the root mean square of the ERAs' fields.

A plate that is thicker by a factor s has the same mode shapes; natural frequencies and modal masses
scale with s. That is exact for thin plates; shear and rotary inertia of the paper's plate change
the response by less than 1e-3 over 2 %.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.finger.contrast import contrast_db
from model.finger.load import finger_loads
from model.structure.actuator import Era
from model.structure.dynamic_stiffness import attached_stiffness, dynamic_stiffness
from model.structure.low_rank import coupled_forces
from model.structure.point_load import PointLoad
from model.table.pattern import Pattern
from model.table.question import Point, Question
from model.table.table import LocalizationTable
from model.vibration.excitation import Excitation, random_gains
from model.vibration.peak import base_amplitudes

STIFFNESS_RANGE = 0.10
THICKNESS_RANGE = 0.02
DAMPING_FACTOR = 2.0

MEMBERS = 200
PERCENTILE = 10


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Plates within tolerance, relative to the modelled one.

    thickness, damping (m,); stiffness (m, eras); gain (m, eras): complex factor of each ERA;
    deviation (m, contacts): of the response at each fingertip, in discretisation errors.
    """

    thickness: FloatArray
    damping: FloatArray
    stiffness: FloatArray
    gain: ComplexArray
    deviation: ComplexArray


def draw_ensemble(era_count: int, *, contact_count: int) -> Ensemble:
    """Draw MEMBERS plates on the given number of ERAs, always the same."""
    rng = np.random.default_rng(0)
    each = (MEMBERS, era_count)
    gain = random_gains(rng, draws=MEMBERS, eras=era_count)
    return Ensemble(
        thickness=rng.uniform(1 - THICKNESS_RANGE, 1 + THICKNESS_RANGE, MEMBERS),
        damping=DAMPING_FACTOR ** rng.uniform(-1, 1, MEMBERS),
        stiffness=rng.uniform(1 - STIFFNESS_RANGE, 1 + STIFFNESS_RANGE, each),
        gain=gain,
        deviation=rng.normal(0, math.sqrt(0.5), (MEMBERS, contact_count, 2)).view(complex)[..., 0],
    )


def with_robust_contrast(table: LocalizationTable, question: Question, pattern: Pattern) -> Pattern:
    """Add the robust contrast [dB] to a pattern with quiet fingers.

    Takes some milliseconds; in live use patterns are chosen by their robustness against gain and
    phase errors only (`model.drive_modes.fields`).
    """
    if not question.quiet:
        return pattern
    contact_count = len(question.targets) + len(question.quiet)
    ensemble = draw_ensemble(len(table.eras), contact_count=contact_count)
    contrasts = ensemble_contrast_db(table, question, pattern.excitation, ensemble)
    return replace(pattern, robust_contrast_db=float(np.percentile(contrasts, PERCENTILE)))


def ensemble_contrast_db(
    table: LocalizationTable, question: Question, excitation: Excitation, ensemble: Ensemble
) -> FloatArray:
    """Contrast [dB] of an excitation at the weakest target on each plate, (m,)."""
    contacts = (*question.targets, *question.quiet)
    shapes, ends, means = table.shapes_at_fingertips(contacts)
    deviation = np.repeat(ensemble.deviation, np.diff(ends, prepend=0), axis=1)
    tones = zip(*base_amplitudes(excitation, table.eras), strict=True)
    peak = np.sum(
        [
            np.abs(
                _acceleration(table, contacts, ensemble, shapes, frequency, base)
                + table.error_amplitude(frequency, base) * deviation
            )
            for frequency, base in tones
        ],
        axis=0,
    )
    *targets, quiet = np.split(peak, ends[: len(question.targets)], axis=1)
    return contrast_db(targets, quiet, list(means[: len(question.targets)]))


def _acceleration(
    table: LocalizationTable,
    contacts: Sequence[Point],
    ensemble: Ensemble,
    shapes: FloatArray,
    frequency: float,
    motion: ComplexArray,
) -> ComplexArray:
    """Acceleration (m, p) [m/s²] at points of shapes (p, r) for a base motion (eras,) [m]."""
    attachment_shapes = np.vstack([table.attachment_shapes, table.shapes_at(contacts)])
    omega = 2 * np.pi * frequency
    stiffness, base_stiffness = _attached(table, finger_loads(contacts), ensemble, omega)
    scale = ensemble.thickness[:, None]
    loss = 1 + 1j * table.plate.loss_factor * ensemble.damping[:, None]
    modal_receptance = 1 / ((loss * (table.omega * scale) ** 2 - omega**2) * scale)
    receptance = np.asarray(
        (modal_receptance[:, None, :] * attachment_shapes) @ attachment_shapes.T, dtype=complex
    )
    applied = np.zeros((*stiffness.shape, 1), dtype=complex)
    gains = [complex(era.gain(np.array(frequency))) for era in table.eras]
    applied[:, : len(table.eras), 0] = base_stiffness * ensemble.gain * gains * motion
    forces = coupled_forces(receptance, stiffness, applied)[:, :, 0]
    return np.asarray(-(omega**2) * ((modal_receptance * (forces @ attachment_shapes)) @ shapes.T))


def _attached(
    table: LocalizationTable, loads: Sequence[PointLoad], ensemble: Ensemble, omega: float
) -> tuple[ComplexArray, ComplexArray]:
    """Dynamic stiffness of ERAs, masses, fingers (m, n), and of the ERAs' bases (m, eras) [N/m]."""
    eras: Sequence[Era] = table.eras
    base_stiffness = dynamic_stiffness(
        ensemble.stiffness * [era.stiffness for era in eras],
        ensemble.damping[:, None] * [era.damping for era in eras],
        0.0,
        omega,
    )
    bolts = dynamic_stiffness(0.0, 0.0, np.array([era.bolt_mass for era in eras]), omega)
    (rest,) = attached_stiffness((), [*table.masses, *loads], np.array([omega]))
    rest = np.broadcast_to(rest, (len(base_stiffness), len(rest)))
    return np.hstack([base_stiffness + bolts, rest]), base_stiffness
