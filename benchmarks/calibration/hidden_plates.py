"""Plates that calibration must identify without knowing how they were made.

They are solved with finite elements of fourth order (Q4, strips along the edges) and a sparse solve
for each frequency, while the product uses modes of polynomials. They have form errors that a rig
file cannot express, as large as a fit allows for, times SHARE. The sizes are stated here again, so
that a fit that allows for less fails on these plates.

    python -m benchmarks.calibration.hidden_plates FOLDER FIRST COUNT SHARE

writes the readings of three, four, six and twelve sensors in turn as CSV, and the true values as
JSON. Calibration runs in another process and reads the CSV only.
"""

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.setting import RIG
from kit.direct_plate import direct_acceleration
from model.arrays import ComplexArray, FloatArray
from model.estimate.gains import gains_of as best_gains
from model.estimate.gains import row_rms
from model.estimate.measurement import Measurement, sensors_at
from model.estimate.sensed_plate import sensed_plate
from model.fem import ELEMENTS, Mesh, PlateMatrices, assemble
from model.response_files import write_responses_csv
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.structure.attachments import PointLoad
from model.structure.sources import Era

MESH = (6, 5)  # within 0.1 % of converged, with strips
STRIP = 3e-3  # m, twice the plate's thickness
FREQUENCIES = np.arange(40.0, 501.0, 20.0)
# Twelve sensors off all lines of symmetry, as fractions of the sides.
SENSORS = np.array(
    [
        *([0.07, 0.15], [0.37, 0.08], [0.67, 0.18], [0.94, 0.12]),
        *([0.14, 0.44], [0.42, 0.53], [0.62, 0.41], [0.91, 0.57]),
        *([0.06, 0.91], [0.31, 0.80], [0.71, 0.86], [0.96, 0.93]),
    ]
)

FIELD_POINTS = np.stack(np.meshgrid([0.1, 0.3, 0.5, 0.7, 0.9], [0.12, 0.37, 0.63, 0.88]), -1)
FIELD_POINTS = FIELD_POINTS.reshape(-1, 2)
"""Finger positions, as fractions of the sides."""

CHOSEN = {3: [0, 6, 9], 4: [0, 3, 5, 10], 6: [0, 2, 4, 7, 9, 10], 12: list(range(12))}
"""Indices of the used sensors, by number of sensors."""

FORM = {
    "place": 1.5e-3,
    "side": 0.5e-3,
    "poisson": 0.015,
    "sensor_place": 0.5e-3,
    "sensor_scale": 0.01,
    "mass": 0.01,
}
"""Standard deviations of form errors, which a rig file does not contain.

Positions of ERAs along each side, length and width, positions of sensors [m]; Poisson's ratio;
scales of sensors, relative; a foreign mass at any position, relative to the plate's mass.
"""


@dataclass(frozen=True, eq=False)
class HiddenPlate:
    """A plate: the rig with true values, and the matrices of its solver."""

    rig: Rig
    masses: tuple[PointLoad, ...]
    matrices: PlateMatrices
    points: FloatArray
    scales: FloatArray

    def responses(self, frequencies: FloatArray, points: FloatArray) -> ComplexArray:
        """Return the acceleration per commanded displacement (f, e, p) [1/s²], with gains."""
        eras = self.rig.eras
        found = direct_acceleration(self.matrices, eras, frequencies, points, loads=self.masses)
        return np.asarray(found / np.array([era.full_level for era in eras])[:, None])


def draw_plate(
    rig: Rig,
    form: Mapping[str, float] = FORM,
    *,
    seed: int,
    sensors: FloatArray = SENSORS,
    frequencies: FloatArray = FREQUENCIES,
) -> HiddenPlate:
    """Draw a plate within a builder's tolerances of a rig, with form errors.

    form: standard deviations with the keys of FORM.
    """
    rng = np.random.default_rng([seed, 50])
    plate = rig.plate

    def error(kind: str, *shape: int) -> FloatArray:
        return np.asarray(form[kind] * rng.standard_normal(shape))

    sides = np.array([plate.length, plate.width]) + error("side", 2)
    material = replace(
        plate.material,
        E=float(plate.material.E * np.exp(0.05 * rng.standard_normal())),
        nu=float(plate.material.nu + error("poisson")),
    )
    loss_factor = plate.loss_factor * np.exp(0.35 * rng.standard_normal())
    real = replace(
        plate,
        length=float(sides[0]),
        width=float(sides[1]),
        material=material,
        loss_factor=float(loss_factor),
    )
    eras = []
    for era in (each for each in rig.eras if isinstance(each, Era)):
        # Bolts at an edge can only be displaced inward.
        at = np.array([era.x, era.y]) / [plate.length, plate.width]
        inwards = np.where(at > 0.5, -1.0, 1.0)
        place = at * sides + inwards * np.abs(error("place", 2))
        size = 1 + 0.05 * rng.standard_normal(len(frequencies))
        phase = np.radians(5.0) * rng.standard_normal(len(frequencies))
        eras.append(
            replace(
                era,
                x=float(place[0]),
                y=float(place[1]),
                stiffness=float(era.stiffness * np.exp(0.1 * rng.standard_normal())),
                damping=float(era.damping * np.exp(0.35 * rng.standard_normal())),
                bolt_mass=float(rng.uniform(0.004, 0.016)),
                gains=tuple(zip(frequencies.tolist(), size, phase, strict=True)),
            )
        )
    x, y = (rng.uniform(0.05, 0.95, 2) * sides).tolist()
    mass = plate.mass * abs(float(error("mass")))
    points = sensors * [plate.length, plate.width]
    points = points + error("sensor_place", *points.shape)
    grid = Mesh(*MESH, real.length, real.width, ELEMENTS["Q4"], STRIP)
    return HiddenPlate(
        replace(rig, plate=real, eras=tuple(eras), mesh=grid),
        (PointLoad(x, y, mass=mass),) if mass else (),
        assemble(real, grid),
        np.clip(points, 0, sides),
        1 + error("sensor_scale", len(points)),
    )


def measure(
    hidden: HiddenPlate,
    rig: Rig,
    *,
    seed: int,
    sensors: FloatArray = SENSORS,
    frequencies: FloatArray = FREQUENCIES,
    noise: float = 0.01,
    count: int = 12,
) -> Measurement:
    """Measure with sensors at their nominal positions; noise is relative to each row's RMS.

    count: number of sensors, which are far from each other.
    """
    rng = np.random.default_rng([seed, 51])
    some = CHOSEN[count]
    values = (hidden.scales * hidden.responses(frequencies, hidden.points))[:, :, some]
    size = np.sqrt((np.abs(values) ** 2).mean(axis=2, keepdims=True))
    white = rng.standard_normal(values.shape) + 1j * rng.standard_normal(values.shape)
    names = tuple(f"P{number + 1}" for number in some)
    points = sensors[some] * [rig.plate.length, rig.plate.width]
    heard = values + noise * size * white / np.sqrt(2)
    return Measurement(sensors_at(points, names), frequencies, heard.swapaxes(1, 2))


def true_values(rig: Rig) -> list[float]:
    """Return the fitted values in the order of `SensedPlate.parameters`."""
    values = [rig.plate.material.E, rig.plate.loss_factor]
    return values + [v for era in rig.eras for v in (era.stiffness, era.damping, era.in_time.mass)]


def gains_of(rig: Rig) -> ComplexArray:
    """Return the gains (f, e) of the drives."""
    rows = np.array([era.gains for era in rig.eras])  # (e, f, 3)
    return np.asarray((rows[..., 1] * np.exp(1j * rows[..., 2])).T)


def fields_of(hidden: HiddenPlate) -> ComplexArray:
    """Return true fields (f, e, p) at FIELD_POINTS and the frequencies of the gains."""
    frequencies = np.array([row[0] for row in hidden.rig.eras[0].gains])
    plate = hidden.rig.plate
    return hidden.responses(frequencies, FIELD_POINTS * [plate.length, plate.width])


def field_deviations(rig: Rig, true: ComplexArray) -> FloatArray:
    """Return errors (3, f, e) of a rig's fields against `fields_of`, relative to its uncertainty.

    The rows are the errors of magnitude and phase of the best gains, and the root mean square error
    of the fields with these gains.
    """
    points = FIELD_POINTS * [rig.plate.length, rig.plate.width]
    frequencies = np.array([row[0] for row in rig.eras[0].gains])
    true = true.swapaxes(1, 2)
    plate = sensed_plate(rig, sensors_at(points), frequencies)
    fields = gains_of(rig)[:, None] * plate.responses()
    gains = best_gains(fields, true)
    left = true - gains[:, None] * fields
    off, known = np.log(gains), rig.uncertainty
    return np.abs(
        [
            off.real / np.hypot(known.gain, known.common_gain),
            off.imag / np.radians(known.phase_deg),
            (row_rms(left) / row_rms(true))[:, 0] / known.field,
        ]
    )


def sensors_of(seed: int) -> int:
    """Return the number of sensors of a plate."""
    return list(CHOSEN)[seed % len(CHOSEN)]


def main() -> None:
    folder, first, count = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    rig, share = load_rig(RIG), float(sys.argv[4])
    form = {kind: share * size for kind, size in FORM.items()}
    for seed in range(first, first + count):
        hidden = draw_plate(rig, form, seed=seed)
        responses = measure(hidden, rig, seed=seed, count=sensors_of(seed))
        write_responses_csv(folder / f"{seed}.csv", responses, rig)
        fields = fields_of(hidden)
        truth = {
            "values": true_values(hidden.rig),
            "fields": [fields.real.tolist(), fields.imag.tolist()],
        }
        (folder / f"{seed}.json").write_text(json.dumps(truth))


if __name__ == "__main__":
    main()
