"""Simulate a modal test of a plate that differs slightly from the paper's; write its responses.

Twelve accelerometers measure while each ERA is driven alone at a tenth of its amplitude, in a
stepped-sine sweep. The true parameters that `era calibrate` must recover are below, together with
the measurement errors: noise, one sensor with a wrong sensitivity, and one dead sensor. Writes
measured.uff and measured.csv.

    python examples/make_measured.py
    era calibrate examples/paper_plate.yaml examples/measured.uff -o calibrated.yaml
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.estimate.measurement import Measurement, sensors_at
from model.reduction.reduced_plate import reduce_plate
from model.response_files import write_responses_csv, write_responses_uff
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.structure.attachments import footprints_of
from model.structure.plate import Plate
from model.transients.base_motion import Term
from sim.plant.plant import Plant


@dataclass(frozen=True)
class Accelerometer:
    """An accelerometer at x, y [m].

    noise_density [m/s²/sqrt(Hz)]; reach: measuring range, plus or minus [m/s²]; resolution: step
    size [m/s²], 0 for unlimited; scale: reading divided by true acceleration.
    """

    name: str
    x: float
    y: float
    noise_density: float = 0.0
    reach: float = math.inf
    resolution: float = 0.0
    scale: float = 1.0


FREQUENCIES = np.arange(40.0, 501.0, 10.0)
SEED = 1

# By ERA: stiffness and damping relative to the rig's, bolt mass [kg].
ERAS = {
    "SW": (1.12, 1.40, 0.012),
    "SE": (0.91, 0.80, 0.008),
    "NE": (1.05, 1.15, 0.015),
    "NW": (0.84, 1.30, 0.010),
}
MODULUS = 74e9
LOSS_FACTOR = 0.013
SENSOR = Accelerometer("", 0, 0, noise_density=5e-3, reach=200.0, resolution=1e-3)
SCALES = {"P3": 1.25, "P8": 0.0}  # the sensor with a wrong sensitivity, and the dead one
SETTLE = 1.5  # s; by then the slowest mode of the paper's plate (T60 1 s) has decayed by 90 dB
RECORD = 0.2  # s
RATE = 5000.0  # Hz


def true_rig(rig: Rig) -> Rig:
    """Return the rig with the true parameters, and random ERA gains at every frequency."""
    rng = np.random.default_rng(SEED)
    material = replace(rig.plate.material, E=MODULUS)
    eras = []
    for era in rig.eras:
        stiffness, damping, bolt_mass = ERAS[era.name]
        size = 1 + 0.08 * rng.standard_normal(len(FREQUENCIES))
        phase = np.radians(-0.02 * FREQUENCIES + 5 * rng.standard_normal(len(FREQUENCIES)))
        eras.append(
            replace(
                era,
                stiffness=stiffness * era.stiffness,
                damping=damping * era.damping,
                bolt_mass=bolt_mass,
                gains=tuple(zip(FREQUENCIES, size, phase, strict=True)),
            )
        )
    plate = replace(rig.plate, material=material, loss_factor=LOSS_FACTOR)
    return replace(rig, plate=plate, eras=tuple(eras))


def readings(
    sensors: Sequence[Accelerometer], accelerations: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return sensor readings (n, s) [m/s²] of true accelerations (n, s) [m/s²]."""
    noise = rng.standard_normal(accelerations.shape)
    columns = []
    for number, sensor in enumerate(sensors):
        # Standard deviation of white noise with this density up to half the sampling rate.
        deviation = sensor.noise_density * math.sqrt(RATE / 2)
        column = sensor.scale * accelerations[:, number] + deviation * noise[:, number]
        clipped = np.clip(column, -sensor.reach, sensor.reach)
        if sensor.resolution > 0:
            clipped = sensor.resolution * np.round(clipped / sensor.resolution)
        columns.append(clipped)
    return np.stack(columns, axis=1)


def fit_tone(times: FloatArray, samples: FloatArray, frequency: float) -> ComplexArray:
    """Fit Im[a exp(i omega t)] plus an offset to samples (n, s); return the amplitudes a (s,)."""
    angle = 2 * np.pi * frequency * times
    basis = np.column_stack([np.sin(angle), np.cos(angle), np.ones(len(times))])
    sine, cosine, _ = np.linalg.lstsq(basis, samples, rcond=None)[0]
    return np.asarray(sine + 1j * cosine)


def scanning_grid(plate: Plate, nx: int, ny: int, *, like: Accelerometer) -> list[Accelerometer]:
    """Return equal sensors at the centers of nx by ny cells, numbered along x from the origin."""
    sensors = []
    for row in range(ny):
        for column in range(nx):
            x = (column + 0.5) / nx * plate.length
            y = (row + 0.5) / ny * plate.width
            sensors.append(replace(like, name=f"P{len(sensors) + 1}", x=x, y=y))
    return sensors


def record_responses(
    rig: Rig, sensors: Sequence[Accelerometer], frequencies: FloatArray, *, seed: int = 0
) -> Measurement:
    """Measure the steady response of a simulated plate to each ERA at each frequency [Hz].

    The simulation runs in the time domain; structural damping is the viscous equivalent of
    `model.reduction.supported_plate`.
    """
    reduced = reduce_plate(
        rig.plate,
        rig.mesh,
        footprints_of(rig.eras, rig.masses),
        frequency_max=max(float(frequencies.max()), 200.0),
    )
    points = np.array([[sensor.x, sensor.y] for sensor in sensors])
    shapes = reduced.at(points)
    plant = Plant(reduced, rig.eras, loads=rig.masses)
    rng = np.random.default_rng(seed)
    values = np.empty((len(frequencies), len(sensors), len(rig.eras)), dtype=complex)
    for number, era in enumerate(rig.eras):
        for row, frequency in enumerate(frequencies.tolist()):
            start = plant.time
            settled = start + SETTLE
            omega = 2 * math.pi * frequency
            amplitude = 0.1 * era.stroke
            # The phase refers to the simulation's clock.
            tone = Term(start, math.inf, omega, amplitude * np.exp(1j * omega * start))
            plant.set_input(number, [tone])
            plant.skip(settled)
            times, accelerations = plant.advance(settled + RECORD, sample_rate=RATE, shapes=shapes)
            samples = readings(sensors, accelerations, rng)
            values[row, :, number] = fit_tone(times, samples, frequency) / amplitude
        plant.set_input(number, [])
    positions = sensors_at(points, tuple(sensor.name for sensor in sensors))
    return Measurement(positions, np.asarray(frequencies, dtype=float), values)


def main() -> None:
    """Measure, and write both files next to this program."""
    folder = Path(__file__).parent
    rig = load_rig(folder / "paper_plate.yaml")
    sensors = [
        replace(sensor, scale=SCALES.get(sensor.name, 1.0))
        for sensor in scanning_grid(rig.plate, 4, 3, like=SENSOR)
    ]
    responses = record_responses(true_rig(rig), sensors, FREQUENCIES, seed=SEED)
    write_responses_uff(folder / "measured.uff", responses, rig)
    write_responses_csv(folder / "measured.csv", responses, rig)
    print(f"wrote measured.uff and measured.csv in {folder}: {responses.count} values")


if __name__ == "__main__":
    main()
