"""From accelerations to the samples of a sound card's inputs: noise, filter, delay, clipping."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from era_haptics.lab.measuring.sound_card import WiredSensor
from model.arrays import ComplexArray, FloatArray

_ORDER = 4
_CORNER = 0.42  # of the sample rate; anti-aliasing filters of converters pass all of the audio band


@dataclass(frozen=True)
class Converters:
    """What is between the plate and the samples.

    delay [samples]: of all channels; noise [m/s²/sqrt(Hz)]: of each accelerometer.
    """

    delay: int = 73
    noise: float = 5e-3

    def response(self, frequencies: FloatArray, *, rate: float) -> ComplexArray:
        """Closed-form response (f,) of filter and delay at frequencies [Hz]."""
        _, filtered = signal.freqz_sos(_filter(), worN=frequencies, fs=rate)
        angle = -2j * np.pi * np.asarray(frequencies) * self.delay / rate
        return np.asarray(filtered * np.exp(angle))


def _filter() -> FloatArray:
    return np.asarray(signal.butter(_ORDER, _CORNER, fs=1.0, output="sos"))


class SensorChannels:
    """Samples (n, inputs) of a sound card's inputs, block after block.

    Each sensor is on its input, the loop-back on its own (counted from 1), the rest is silent.
    """

    def __init__(
        self,
        sensors: Sequence[WiredSensor],
        *,
        loopback: int,
        converters: Converters,
        rate: float,
        seed: int,
    ) -> None:
        self.count = max(loopback, *(sensor.input for sensor in sensors))
        self._columns = [sensor.input - 1 for sensor in sensors]
        self._loopback = loopback - 1
        self._sensitivity = np.array([sensor.sensitivity for sensor in sensors])
        self._noise = converters.noise * np.sqrt(rate / 2)
        self._rng = np.random.default_rng([seed, 1])
        self._sos = _filter()
        self._memory = np.zeros((len(self._sos), 2, self.count))
        self._late = np.zeros((converters.delay, self.count))

    def samples(self, accelerations: FloatArray, looped: FloatArray) -> FloatArray:
        """Samples for accelerations (n, sensors) [m/s²] and what comes by the loop-back (n,)."""
        raw = np.zeros((len(looped), self.count))
        noise = self._noise * self._rng.standard_normal(accelerations.shape)
        raw[:, self._columns] = (accelerations + noise) * self._sensitivity
        raw[:, self._loopback] = looped
        filtered, self._memory = signal.sosfilt(self._sos, raw, axis=0, zi=self._memory)
        together = np.concatenate([self._late, filtered])
        self._late = together[len(looped) :]
        return np.asarray(np.clip(together[: len(looped)], -1.0, 1.0))
