"""Measurement of a simulated plate, for trying calibration and identification without hardware.

The plate is drawn at random from the rig's tolerances.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from era_haptics.lab.measuring.desk import Desk
from era_haptics.lab.measuring.multisine import multisine_frequencies
from era_haptics.lab.measuring.sensor_file import are_positions
from model.arrays import FloatArray
from model.estimate.measurement import Measurement
from model.quantities import counted
from model.reduction.free_plate import solve_free_plate
from model.response_files import write_responses
from model.structure.attachments import PointLoad
from sim.plant.imperfections import draw_imperfections

NOISE = 2e-3
"""Standard deviation of real and imaginary part, relative to the sensor's rms over all readings."""


def measured_by_simulation(
    desk: Desk, output: Path, *, frequencies: FloatArray | None, seed: int
) -> tuple[list[str | None], dict[str, Any]]:
    """Write responses of a plate drawn within a rig's uncertainty; return the report.

    frequencies (f,) [Hz]: None for the default of `era measure`; seed: of plate and noise.
    Sensors have the mass that their file states; a moved sensor is at one position at a time.
    Raises InputError for frequencies beyond the rig's limits.
    """
    rig, sensors = desk.rig, desk.sensors
    is_moved = are_positions(sensors)
    if frequencies is None:
        limits = rig.limits
        frequencies = multisine_frequencies(limits.frequency_min, limits.frequency_max)
    desk.check_frequencies(frequencies, what="--frequencies")
    imperfections = draw_imperfections(rig, seed=seed)
    real = imperfections.plate.realised(rig)
    plate = solve_free_plate(real.plate, real.mesh, frequency_max=rig.limits.frequency_max)
    masses = [PointLoad(sensor.x, sensor.y, mass=sensor.mass) for sensor in sensors]
    columns = []
    for sensor, mass in zip(sensors, masses, strict=True):
        point = np.array([[sensor.x, sensor.y]])
        loads = [*real.masses, mass] if is_moved else [*real.masses, *masses]
        columns.append(plate.acceleration(real.eras, frequencies, point, loads=loads))
    drives = imperfections.factors(rig) / np.array([*rig.full_levels.values()])
    values = np.concatenate(columns, axis=2) * drives[:, None]  # (f, eras, sensors)
    parts = np.random.default_rng(seed).standard_normal((2, *values.shape))
    rms = np.sqrt((np.abs(values) ** 2).mean(axis=(0, 1)))
    values += NOISE * rms * (parts[0] + 1j * parts[1])
    places = [sensor.place for sensor in sensors]
    if not is_moved:
        places = [replace(place, mass=0.0) for place in places]
    measurement = Measurement(places, frequencies, values.swapaxes(1, 2))
    write_responses(output, measurement, rig)
    rows: list[str | None] = [
        f"simulated plate: {counted(len(places), 'sensor')}, "
        f"{counted(len(frequencies), 'frequency', plural='frequencies')} from "
        f"{frequencies[0]:g} to {frequencies[-1]:g} Hz, {counted(measurement.count, 'value')}",
        f"wrote {output}",
    ]
    answer = {
        "frequencies_hz": frequencies.tolist(),
        "sensors": [*measurement.names],
        "values": measurement.count,
        "files": [str(output)],
    }
    return rows, answer
