"""Whether identified gains are those of real drives and sensors.

A response tells only the product of a drive's and a sensor's gain, so that the fit shares an error
of either among both, and its residuals do not show a wrong unit or sign.
"""

import math

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.identification.measurement import Measurement
from model.identification.parameters import Space
from model.identification.values import Values
from model.rig.rig import Rig

_STDS = 5.0
_LEAST_GAIN, _LEAST_PHASE = 0.3, math.radians(20)  # what is allowed at least


def check_gains(rig: Rig, measurement: Measurement, values: Values, space: Space) -> None:
    """Raise InputError for gains no drive or sensor has: another unit, a sign, a wrong plug."""
    drives = [f"drive {era.name}" for era in rig.eras]
    sensors = [f"sensor {sensor.name}" for sensor in measurement.sensors]
    wrong = [
        *_wrong(drives, np.log(values.drive_gains), space, ""),
        *_wrong(sensors, np.log(values.sensor_gains), space, "sensor_"),
    ]
    if wrong:
        raise InputError(
            "measurement must be acceleration in m/s² along the drives' motion, got gains of "
            f"{'; '.join(wrong)}; check unit, sign and plug of each sensor and drive"
        )


def _wrong(names: list[str], logarithms: FloatArray, space: Space, whose: str) -> list[str]:
    """Those whose complex logarithm of the gain is beyond what is usual, in words."""
    gain, phase = (space.std[space.groups[whose + kind]].max() for kind in ("gain", "phase"))
    return [
        f"{name} {math.exp(one.real):.2f} at {math.degrees(one.imag):.0f}°"
        for name, one in zip(names, logarithms.tolist(), strict=True)
        if abs(one.real) > max(_LEAST_GAIN, _STDS * gain)
        or abs(one.imag) > max(_LEAST_PHASE, _STDS * phase)
    ]
