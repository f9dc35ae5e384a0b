"""An exciter behind a resistor as the far end of a sound card, in time: two voltages by one.

The trapezoidal rule: at a frequency f it is the exact circuit at tan(pi f / rate) rate / pi, 0.14 %
above at 1 kHz and 48 kHz, and less below.
"""

import numpy as np
from scipy.signal import bilinear_zpk, sosfilt, zpk2sos

from model.arrays import FloatArray


class ExciterCircuit:
    """Voltages before a 25 mm exciter and over a resistor in series, by that of an output.

    Inputs are these two, late by some samples as of converters, with a noise [full scale];
    is_glued: whether the coil is held. Values in SI units, written here.
    """

    outputs, inputs = 1, 2
    COIL, MAGNET, STIFFNESS, DAMPING = 1.61e-3, 109.29e-3, 3189.2, 0.7553
    FORCE_FACTOR, RESISTANCE, INDUCTANCE, SERIES = 3.63, 4.3, 1e-4, 10.0
    DELAY = 73

    def __init__(self, *, is_glued: bool, rate: float, noise: float = 1e-6) -> None:
        moving = self.MAGNET
        if not is_glued:
            moving = self.COIL * self.MAGNET / (self.COIL + self.MAGNET)
        # Current, velocity and way of the coil in the magnet.
        resistance = self.RESISTANCE + self.SERIES
        a = np.array(
            [
                [-resistance / self.INDUCTANCE, -self.FORCE_FACTOR / self.INDUCTANCE, 0],
                [self.FORCE_FACTOR / moving, -self.DAMPING / moving, -self.STIFFNESS / moving],
                [0, 1, 0],
            ]
        )
        zeros = np.roots([moving, self.DAMPING, self.STIFFNESS])  # where the coil may move freely
        analog = zeros, np.linalg.eigvals(a), self.SERIES / self.INDUCTANCE
        self._sections = zpk2sos(*bilinear_zpk(*analog, fs=rate))
        self._state = np.zeros((len(self._sections), 2))
        self._late = np.zeros((self.DELAY, 2))
        self._noise, self._random = noise, np.random.default_rng(1)

    def advance(self, played: FloatArray) -> FloatArray:
        """Samples (n, 2) for samples (n, 1)."""
        over, self._state = sosfilt(self._sections, played[:, 0], zi=self._state)
        voltages = np.stack([played[:, 0], over], axis=1)
        whole = np.concatenate([self._late, voltages])
        self._late = whole[-self.DELAY :]
        heard = whole[: len(played)]
        return heard + self._noise * self._random.normal(size=heard.shape)
