"""What a rig's own amplifiers measured, as the check of the rig takes it."""

import numpy as np

from model.calibration.responses import Responses
from model.identification.measurement import Measurement
from model.rig.rig import Rig


def observation_of(measurement: Measurement, rig: Rig) -> Responses:
    """Responses to the channels of a rig one by one, from those to interleaved tones.

    Raises InputError for a plate that was not linear or has changed meanwhile.
    """
    measurement.check()
    sensors = measurement.sensors
    shape = len(measurement.tones), len(rig.eras), len(sensors)
    values = np.full(shape, np.nan, dtype=complex)
    values[measurement.rows, measurement.eras, measurement.at] = measurement.values
    places = [rig.era(each.era) if each.era else each for each in sensors]
    return Responses(
        tuple(each.name for each in sensors),
        np.array([(each.x, each.y) for each in places]),
        measurement.tones,
        values,
        has_phases=not measurement.drives_lag,
    )
