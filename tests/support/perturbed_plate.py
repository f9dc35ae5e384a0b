"""A plate that is not quite the paper's, and responses measured on it, from the direct solve."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from benchmarks.direct_plate import direct_acceleration
from model.calibration.responses import Responses
from model.fem import assemble
from model.rig.rig import Rig
from model.structure.attachments import Gain

# Relative to the rig, bolt masses in kg: what assembly and ageing do.
STIFFNESS = (1.15, 0.9, 1.05, 0.82)
DAMPING = (1.4, 0.8, 1.1, 1.3)
BOLT_MASS = (0.012, 0.008, 0.015, 0.010)
MODULUS, LOSS_FACTOR = 1.07, 1.3

FREQUENCIES = np.arange(40.0, 501.0, 20.0)
# On no line of symmetry, so that every mode is seen.
POINTS = np.array(
    [
        *([0.021, 0.035], [0.114, 0.018], [0.205, 0.041], [0.287, 0.027]),
        *([0.043, 0.101], [0.129, 0.122], [0.188, 0.094], [0.276, 0.131]),
        *([0.017, 0.208], [0.096, 0.182], [0.217, 0.197], [0.293, 0.213]),
    ]
)
NAMES = tuple(f"P{number}" for number in range(1, len(POINTS) + 1))


def perturbed(rig: Rig, *, frequencies: np.ndarray = FREQUENCIES, seed: int = 1) -> Rig:
    """The true rig, with gains of 8 % and 6 degrees at random at every frequency."""
    rng = np.random.default_rng(seed)
    eras = []
    for era, k, c, m in zip(rig.eras, STIFFNESS, DAMPING, BOLT_MASS, strict=True):
        gains = random_gains(rng, frequencies, size=0.08, phase=0.1)
        eras.append(
            replace(
                era,
                stiffness=k * era.stiffness,
                damping=c * era.damping,
                bolt_mass=m,
                gains=gains,
            )
        )
    material = replace(rig.plate.material, E=MODULUS * rig.plate.material.E)
    loss_factor = LOSS_FACTOR * rig.plate.loss_factor
    plate = replace(rig.plate, material=material, loss_factor=loss_factor)
    return replace(rig, plate=plate, eras=tuple(eras))


def random_gains(
    rng: np.random.Generator, frequencies: np.ndarray, *, size: float, phase: float
) -> tuple[Gain, ...]:
    """Gains at frequencies, off by standard deviations of their size and of their phase [rad]."""
    sizes = 1 + size * rng.standard_normal(len(frequencies))
    phases = phase * rng.standard_normal(len(frequencies))
    return tuple(zip(frequencies.tolist(), sizes.tolist(), phases.tolist(), strict=True))


def noise_like(values: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Complex white noise, a share of each row's rms over the sensors."""
    size = np.sqrt((np.abs(values) ** 2).mean(axis=2, keepdims=True))
    white = rng.standard_normal(values.shape) + 1j * rng.standard_normal(values.shape)
    return np.asarray(share * size * white / np.sqrt(2))


def measured(
    truth: Rig,
    *,
    frequencies: np.ndarray = FREQUENCIES,
    noise: float = 0.01,
    scales: Mapping[str, float] | None = None,
    seed: int = 2,
) -> Responses:
    """Responses by one sparse solve a frequency, noise relative to each row's rms over sensors."""
    rng = np.random.default_rng(seed)
    matrices = assemble(truth.plate, truth.mesh)
    strokes = np.array([era.stroke for era in truth.eras])[:, None]
    values = (
        direct_acceleration(matrices, truth.eras, frequencies, POINTS, loads=truth.masses) / strokes
    )
    heard = noise_like(values, noise, rng)
    for name, scale in (scales or {}).items():
        values[:, :, NAMES.index(name)] *= scale
    return Responses(NAMES, POINTS, frequencies, values + heard)
