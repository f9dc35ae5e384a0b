"""Frequency responses from the runs of a multisine, with their noise, at the lines it has."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray
from sim.measuring.multisine import Multisine

_AROUND = 4  # lines of a period on either side, from which noise is taken


@dataclass(frozen=True, eq=False)
class Estimate:
    """Responses (f, inputs, sources) of samples to samples, H1 over all runs.

    std (f, inputs): standard deviation of each response's modulus; coherence (f, inputs): share of
    the power that comes from the sources; even (inputs,): what came back at even lines, which
    nobody played, relative to the lines played, amplitudes, noise taken off.
    """

    values: ComplexArray
    std: FloatArray
    coherence: FloatArray
    even: FloatArray


def estimate(multisine: Multisine, recorded: Sequence[FloatArray]) -> Estimate:
    """Estimate responses from whole periods of each run, (periods x samples, inputs).

    Two periods or more: between the lines of a period the spectrum of several has nothing but
    noise. Least squares of Y = U H^T at each line, U the amplitudes played (runs, sources).
    """
    n = multisine.samples
    periods = len(recorded[0]) // n
    spectra = np.array([np.fft.rfft(each, axis=0) for each in recorded], dtype=complex)
    spectra *= 2 / len(recorded[0])
    lines = multisine.lines * periods
    heard = spectra[:, lines]  # (runs, f, inputs)
    played = np.array([multisine.played(run) for run in range(len(recorded))])  # (runs, f, s)
    values = np.linalg.solve(played.transpose(1, 0, 2), heard.transpose(1, 0, 2))
    noise = _noise(spectra, lines, periods)
    power = (np.abs(heard) ** 2).mean(axis=0)
    size = np.abs(multisine.played(0)[:, :1])
    return Estimate(
        values.transpose(0, 2, 1),
        np.sqrt(noise / len(recorded)) / size,
        np.clip(1 - noise / np.maximum(power, 1e-300), 0.0, 1.0),
        _even(spectra, lines, periods, noise),
    )


def _noise(spectra: ComplexArray, lines: IntArray, periods: int) -> FloatArray:
    """Mean power of the bins around each line that no period has, (f, inputs)."""
    offsets = np.arange(-_AROUND * periods, _AROUND * periods + 1)
    offsets = offsets[offsets % periods != 0]
    bins = np.clip(lines[:, None] + offsets, 1, spectra.shape[1] - 1)
    return np.asarray((np.abs(spectra[:, bins]) ** 2).mean(axis=(0, 2)))


def _even(spectra: ComplexArray, lines: IntArray, periods: int, noise: FloatArray) -> FloatArray:
    """Amplitude at the even lines beside the odd ones, relative to those, (inputs,)."""
    beside = lines + periods
    power = (np.abs(spectra[:, beside]) ** 2).mean(axis=0) - noise
    played = (np.abs(spectra[:, lines]) ** 2).mean(axis=0).sum(axis=0)
    return np.asarray(np.sqrt(np.maximum(power.sum(axis=0), 0) / np.maximum(played, 1e-300)))
