"""An exciter's parts by its impedance, against the equations of coil, magnet and circuit."""

import numpy as np
import pytest

from model.errors import InputError
from sim.desk.measuring.impedance import HALF_WIDTH, exciter_values, fitted

F = np.unique(np.geomspace(10, 1000, 100).round())
# A 25 mm exciter: coil, magnet [kg], k [N/m], c [N s/m], Bl [N/A], R [ohm], L [H].
COIL, MAGNET, STIFFNESS, DAMPING = 1.61e-3, 109.29e-3, 3189.2, 0.7553
FORCE_FACTOR, RESISTANCE, INDUCTANCE = 3.63, 4.3, 1e-4
WEIGHT = COIL + MAGNET
SCALE = 0.1e-3  # kg


def impedance(f: float, *, is_glued: bool, semi: float = 0.0) -> complex:
    """1 V by the current: the equations of current, coil and magnet, solved as they stand."""
    w = 2 * np.pi * f
    spring = STIFFNESS + 1j * w * DAMPING
    circuit = RESISTANCE + 1j * w * INDUCTANCE + semi * np.sqrt(1j * w)
    back = 1j * w * FORCE_FACTOR
    equations = np.array(
        [
            [circuit, back, -back],
            [-FORCE_FACTOR, spring - w**2 * COIL, -spring],
            [FORCE_FACTOR, -spring, spring - w**2 * MAGNET],
        ]
    )
    if is_glued:
        equations = equations[np.ix_([0, 2], [0, 2])]
    right = np.zeros(len(equations))
    right[0] = 1
    return complex(1 / np.linalg.solve(equations, right)[0])


def run(rng: np.random.Generator, *, is_glued: bool, noise: float, semi: float = 0.0) -> np.ndarray:
    """The impedance with noise, relative, of each part."""
    exact = np.array([impedance(f, is_glued=is_glued, semi=semi) for f in F])
    drawn = rng.normal(size=(2, len(F)))
    return exact + noise * np.abs(exact) * (drawn[0] + 1j * drawn[1])


TRUE = {
    "resonance": np.sqrt(STIFFNESS / MAGNET) / (2 * np.pi),
    "q": np.sqrt(STIFFNESS * MAGNET) / DAMPING,
    "q_es": np.sqrt(STIFFNESS * MAGNET) * RESISTANCE / FORCE_FACTOR**2,
    "resistance": RESISTANCE,
    "inductance": INDUCTANCE,
    "coil_mass": COIL,
    "weight": MAGNET,
    "stiffness": STIFFNESS,
    "force_factor": FORCE_FACTOR,
}


def test_parts_are_within_their_intervals_in_nine_of_ten_draws() -> None:
    """Noise of 0.1 % and a scale of 0.1 g; 120 draws, of which 108 ± 3 sigma are expected."""
    inside = dict.fromkeys(TRUE, 0)
    for seed in range(120):
        rng = np.random.default_rng(seed)
        free, glued = (
            fitted(F, run(rng, is_glued=is_glued, noise=1e-3), what="run")
            for is_glued in (False, True)
        )
        weighed = WEIGHT + SCALE * rng.normal()
        for name, (value, error) in exciter_values(free, glued, weighed, SCALE).items():
            inside[name] += abs(value - TRUE[name]) <= HALF_WIDTH * error
    assert all(98 <= count <= 118 for count in inside.values()), inside


def test_parts_are_those_of_the_circuit() -> None:
    """Without noise, each to 0.01 %; of the glued run alone with the weight of the magnet."""
    rng = np.random.default_rng(0)
    free, glued = (
        fitted(F, run(rng, is_glued=is_glued, noise=1e-9), what="run") for is_glued in (False, True)
    )
    found = exciter_values(free, glued, WEIGHT, 0.0)
    assert {name: value for name, (value, _) in found.items()} == pytest.approx(TRUE, rel=1e-4)
    alone = exciter_values(None, glued, MAGNET, 0.0)
    assert alone["force_factor"][0] == pytest.approx(FORCE_FACTOR, rel=1e-4)
    assert "coil_mass" not in alone
    assert "weight" not in exciter_values(free, None, None, 0.0)


def test_eddy_currents_are_no_error_of_the_parts() -> None:
    """A semi-inductance of 0.01 ohm s^0.5, 0.8 ohm at 1 kHz: what moves is found as without it."""
    rng = np.random.default_rng(1)
    glued = fitted(F, run(rng, is_glued=True, noise=1e-4, semi=0.01), what="run")
    found = exciter_values(None, glued, MAGNET, 0.0)
    assert glued["semi_inductance"] == pytest.approx(0.01, rel=0.01)
    for name in ("resonance", "q", "resistance", "force_factor"):
        assert found[name][0] == pytest.approx(TRUE[name], rel=2e-3)
    at_300 = INDUCTANCE + 0.01 * np.sin(np.pi / 4) / np.sqrt(2 * np.pi * 300)
    assert found["inductance"][0] == pytest.approx(at_300, rel=5e-3)


def test_what_is_no_exciter_is_refused() -> None:
    """Open, short, a resistor, runs exchanged, runs of two exciters: each by its cause."""
    rng = np.random.default_rng(2)
    for values, cause in (
        (np.full(len(F), 1e5 + 0j), "open or short"),
        (np.full(len(F), 0.01 + 0j), "open or short"),
        (8 * (1 + 1e-3 * rng.normal(size=len(F))) + 0j, "resonance"),
    ):
        with pytest.raises(InputError, match=cause):
            fitted(F, values, what="run")
    free, glued = (
        fitted(F, run(rng, is_glued=is_glued, noise=1e-4), what="run") for is_glued in (False, True)
    )
    with pytest.raises(InputError, match="exchanged"):
        exciter_values(glued, free, WEIGHT, 0.0)
    other = fitted(
        F, RESISTANCE + 2 * (run(rng, is_glued=True, noise=1e-4) - RESISTANCE), what="run"
    )
    with pytest.raises(InputError, match="one exciter"):
        exciter_values(free, other, WEIGHT, 0.0)
