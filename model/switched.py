"""The drive mode `switched`: one or two ERAs at full stroke, each at a frequency of its own.

The paper's idea: switching frequencies and activation sets moves the nulls about. Four ERAs and 27
frequencies make 4 * 27 + 6 * 27² = 4482 patterns.
"""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray

SILENT = -1
"""Stands for an ERA that a pattern does not drive."""


def enumerate_patterns(era_count: int, frequency_count: int) -> NDArray[np.int16]:
    """All patterns: index of each ERA's frequency, or SILENT, (n, era_count).

    First every ERA alone, then every pair; frequencies of the pair's first ERA run slowest.
    """
    index = np.arange(frequency_count, dtype=np.int16)
    blocks = []
    for era in range(era_count):
        block = np.full((frequency_count, era_count), SILENT, dtype=np.int16)
        block[:, era] = index
        blocks.append(block)
    for first, second in combinations(range(era_count), 2):
        block = np.full((frequency_count**2, era_count), SILENT, dtype=np.int16)
        block[:, first] = np.repeat(index, frequency_count)
        block[:, second] = np.tile(index, frequency_count)
        blocks.append(block)
    return np.concatenate(blocks)


def peak_of_patterns(acceleration: ComplexArray) -> FloatArray:
    """Peak acceleration of every pattern, (n, p), from each ERA's at full stroke (f, eras, p).

    Two ERAs at one frequency add as complex numbers, at two frequencies their magnitudes add
    (paper Eq. 28).
    """
    return _combine(np.abs(acceleration), np.abs(_together(acceleration)))


def sensation_of_patterns(acceleration: ComplexArray, threshold: FloatArray) -> FloatArray:
    """How many times above threshold every pattern is felt, (n, p).

    threshold: (f,), same unit as the acceleration; frequencies add as powers:
    sqrt(sum over f of (a_f / T_f)²).
    """
    scale = threshold[:, None, None]
    alone = (np.abs(acceleration) / scale) ** 2
    together = (np.abs(_together(acceleration)) / scale) ** 2
    return np.asarray(np.sqrt(_combine(alone, together)))


def _together(acceleration: ComplexArray) -> ComplexArray:
    """The coherent sum of every pair of ERAs at each frequency, (f, pairs, p)."""
    pairs = list(combinations(range(acceleration.shape[1]), 2))
    if not pairs:
        return acceleration[:, :0]
    return np.stack([acceleration[:, i] + acceleration[:, j] for i, j in pairs], axis=1)


def _combine(alone: FloatArray, together: FloatArray) -> FloatArray:
    """Rows in the order of `enumerate_patterns`: values of ERAs alone, then of pairs.

    Where the frequencies of a pair differ its values add, where they agree `together` holds.
    """
    frequency_count, era_count, point_count = alone.shape
    blocks = [alone[:, era] for era in range(era_count)]
    same = np.arange(frequency_count)
    for pair, (first, second) in enumerate(combinations(range(era_count), 2)):
        block = alone[:, None, first] + alone[None, :, second]
        block[same, same] = together[:, pair]
        blocks.append(block.reshape(-1, point_count))
    return np.concatenate(blocks)
