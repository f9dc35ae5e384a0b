"""Responses that a desk would measure of a simulated plate, which deviates from its rig's file."""

from pathlib import Path
from typing import Any

import numpy as np

from model.arrays import FloatArray
from model.calibration.responses import Responses, are_places
from model.reduction.free_plate import solve_free_plate
from model.structure.attachments import PointLoad
from sim.desk.measuring.desk import Desk
from sim.desk.measuring.multisine import default_frequencies
from sim.desk.measuring.stepped_file import written
from sim.plant.imperfections import draw_imperfections

NOISE = 2e-3
"""Of a sensor's root mean square over all that it reads, of each part."""


def measured_by_simulation(
    desk: Desk, output: Path, *, frequencies: FloatArray | None, seed: int
) -> tuple[list[str | None], dict[str, Any]]:
    """Write responses of a plate drawn within a rig's uncertainty; return the report.

    frequencies (f,) [Hz]: None for those of `era measure`; seed: of the plate and of the noise.
    Sensors weigh what their file says, one that is moved at one place at a time. Raises InputError
    for frequencies beyond the rig's limits.
    """
    rig, sensors = desk.rig, desk.sensors
    limits, drawn = rig.limits, draw_imperfections(rig, seed=seed)
    if frequencies is None:
        frequencies = default_frequencies(limits.frequency_min, limits.frequency_max)
    desk.check_frequencies(frequencies, what="--frequencies")
    real = drawn.plate.realised(rig)
    plate = solve_free_plate(real.plate, real.mesh, frequency_max=limits.frequency_max)
    points = np.array([[each.x, each.y] for each in sensors])
    weights = [PointLoad(each.x, each.y, mass=each.mass) for each in sensors]
    found = [
        plate.acceleration(
            real.eras,
            frequencies,
            point[None],
            loads=[*real.masses, *([weight] if are_places(sensors) else weights)],
        )
        for point, weight in zip(points, weights, strict=True)
    ]
    drives = drawn.factors(rig) / np.array([*rig.full_levels.values()])
    values = np.concatenate(found, axis=2) * drives[:, None]
    parts = np.random.default_rng(seed).standard_normal((2, *values.shape))
    rms = np.sqrt((np.abs(values) ** 2).mean(axis=(0, 1)))
    values += NOISE * rms * (parts[0] + 1j * parts[1])
    names = tuple(each.name for each in sensors)
    masses = np.array([each.mass for each in sensors]) if are_places(sensors) else None
    responses = Responses(names, points, frequencies, values, masses=masses)
    return written(responses, desk, output, source="simulated plate")
