"""Stepped-sine test on the simulated plate: each ERA at each frequency, after settling.

A lock-in gives acceleration per base displacement at the virtual sensors.
"""

import math
from collections.abc import Sequence

import numpy as np

from model.arrays import FloatArray
from model.calibration.responses import Responses
from model.errors import InputError
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.structure.point_load import footprints_of
from model.transients.base_motion import Term
from sim.plant.plant import Plant
from sim.sensors.accelerometer import Accelerometer, positions, read_sensors
from sim.sensors.signal_measures import tone_phasors

_SETTLE = 1.5  # s: the slowest mode of the paper's plate, T60 1 s, is then down by 90 dB
_RECORD = 0.2  # s


def record_responses(
    rig: Rig,
    sensors: Sequence[Accelerometer],
    frequencies: FloatArray,
    *,
    level: float = 0.1,
    sample_rate: float = 5000.0,
    seed: int = 0,
) -> Responses:
    """Measure the frequency responses of a rig's plate, at a level 0..1 of full stroke.

    Structural damping is the viscous equivalent of `model.reduction.modal_matrices`. Raises
    InputError for frequencies [Hz] above 0.4 of the sampling rate [Hz].
    """
    if frequencies.max() >= 0.4 * sample_rate:
        raise InputError(
            f"frequencies must be below {0.4 * sample_rate:g} Hz at a sampling rate of "
            f"{sample_rate:g} Hz, got {frequencies.max():g} Hz"
        )
    attached = footprints_of(rig.eras, rig.masses)
    reduced = reduce_plate(
        rig.plate, rig.mesh, attached, frequency_max=max(float(frequencies.max()), 200.0)
    )
    shapes = reduced.at(positions(sensors))
    plant = Plant(reduced, rig.eras, loads=rig.masses)
    rng = np.random.default_rng(seed)
    values = np.empty((len(frequencies), len(rig.eras), len(sensors)), dtype=complex)
    for number, era in enumerate(rig.eras):
        for row, frequency in enumerate(frequencies):
            omega = 2 * math.pi * float(frequency)
            begin = plant.time
            base = level * era.stroke
            # The phase is that of the plate's clock.
            tone = Term(begin, math.inf, omega, base * np.exp(1j * omega * begin))
            plant.set_input(number, [tone])
            plant.skip(begin + _SETTLE)
            times, truth = plant.advance(
                begin + _SETTLE + _RECORD, sample_rate=sample_rate, shapes=shapes
            )
            recording = read_sensors(
                sensors, truth, sample_rate=sample_rate, start=float(times[0]), rng=rng
            )
            values[row, number] = tone_phasors(recording, [float(frequency)])[0] / base
        plant.set_input(number, [])
    names = tuple(sensor.name for sensor in sensors)
    return Responses(names, positions(sensors), np.asarray(frequencies, dtype=float), values)
