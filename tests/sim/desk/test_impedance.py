"""An exciter's parts by its impedance, against the equations of coil, magnet and circuit."""

import numpy as np
import pytest

from era_haptics.lab.measuring.impedance import Bench, exciter_values, fitted
from model.errors import InputError

F = np.unique(np.geomspace(10, 1000, 100).round())
# A 25 mm exciter: coil, magnet [kg], k [N/m], c [N s/m], Bl [N/A], R [ohm], L [H].
COIL, MAGNET, STIFFNESS, DAMPING = 1.61e-3, 109.29e-3, 3189.2, 0.7553
FORCE_FACTOR, RESISTANCE, INDUCTANCE = 3.63, 4.3, 1e-4
WEIGHT = COIL + MAGNET
SCALE = 0.1e-3  # kg
SERIES = 10.0  # ohm
BASE = 0.3  # kg, not heavy


def impedance(f: float, *, is_glued: bool, base: float = np.inf, semi: float = 0.0) -> complex:
    """1 V by the current: the equations of current, coil and magnet, solved as they stand."""
    w = 2 * np.pi * f
    spring = STIFFNESS + 1j * w * DAMPING
    circuit = RESISTANCE + 1j * w * INDUCTANCE + semi * np.sqrt(1j * w)
    back = 1j * w * FORCE_FACTOR
    coil = COIL + base if is_glued and np.isfinite(base) else COIL
    equations = np.array(
        [
            [circuit, back, -back],
            [-FORCE_FACTOR, spring - w**2 * coil, -spring],
            [FORCE_FACTOR, -spring, spring - w**2 * MAGNET],
        ]
    )
    if is_glued and not np.isfinite(base):
        equations = equations[np.ix_([0, 2], [0, 2])]
    right = np.zeros(len(equations))
    right[0] = 1
    return complex(1 / np.linalg.solve(equations, right)[0])


def run(rng: np.random.Generator, *, is_glued: bool, noise: float, **parts: float) -> np.ndarray:
    """The impedance with noise, relative, of each part."""
    exact = np.array([impedance(f, is_glued=is_glued, **parts) for f in F])
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


@pytest.mark.parametrize(
    ("series_error", "input_error", "most"),
    [(0.0, 0.0, 188), (0.05, 0.01, 196)],
    ids=["noise", "bounds"],
)
def test_parts_are_within_their_intervals_in_nine_of_ten_draws(
    series_error: float, input_error: float, most: int
) -> None:
    """Noise of 0.1 %, a scale of 0.1 g, glued to 300 g; resistor and inputs anywhere within bounds.

    Of 200 draws 180 ± 2 sigma are expected of noise; 190 ± 2 sigma at most of a bound alone, of
    whose half width 1.645 / sqrt 3 = 0.95 are within.
    Inputs measure S (g V_1 / V_2 - 1) of the circuit's own voltages, V_1 / V_2 = Z / (s S) + 1.
    """
    exact = [
        np.array([impedance(f, is_glued=is_glued, base=BASE) for f in F])
        for is_glued in (False, True)
    ]
    inside = dict.fromkeys(TRUE, 0)
    for seed in range(200):
        rng = np.random.default_rng(seed)
        resistor = SERIES * (1 + series_error * rng.uniform(-1, 1))
        gain = 1 + input_error * rng.uniform(-1, 1)
        runs = []
        for each in exact:
            drawn = rng.normal(size=(2, len(F)))
            noisy = each + 1e-3 * np.abs(each) * (drawn[0] + 1j * drawn[1])
            runs.append(fitted(F, SERIES * (gain * (noisy / resistor + 1) - 1), what="run"))
        weight, base = np.array([WEIGHT, BASE]) + SCALE * rng.normal(size=2)
        bench = Bench(weight, None, base, SCALE, SERIES, series_error, input_error)
        for name, (value, width) in exciter_values(*runs, bench).items():
            inside[name] += abs(value - TRUE[name]) <= width
    assert all(172 <= count <= most for count in inside.values()), inside


def test_parts_are_those_of_the_circuit() -> None:
    """Without noise, each to 0.01 %: glued to something heavy or light, and of either run alone.

    Of the free run alone a rig's stiffness is the true one, by its resonance and the coil's mass.
    """
    rng = np.random.default_rng(0)
    free, glued, light = (
        fitted(F, run(rng, is_glued=is_glued, base=base, noise=1e-9), what="run")
        for is_glued, base in ((False, np.inf), (True, np.inf), (True, BASE))
    )
    for circuit, base in ((glued, np.inf), (light, BASE)):
        both = exciter_values(free, circuit, Bench(WEIGHT, base=base))
        assert {name: value for name, (value, _) in both.items()} == pytest.approx(TRUE, rel=1e-4)
    alone = exciter_values(None, glued, Bench(MAGNET))
    assert alone["force_factor"][0] == pytest.approx(FORCE_FACTOR, rel=1e-4)
    assert "coil_mass" not in alone
    hanging = exciter_values(free, None, Bench(WEIGHT, COIL))
    of_coil = {
        "resonance": np.sqrt(STIFFNESS / COIL) / (2 * np.pi),
        "q": np.sqrt(STIFFNESS * COIL) / DAMPING,
        "q_es": np.sqrt(STIFFNESS * COIL) * RESISTANCE / FORCE_FACTOR**2,
    }
    assert {name: value for name, (value, _) in hanging.items()} == pytest.approx(
        TRUE | of_coil, rel=1e-4
    )
    assert "weight" not in exciter_values(free, None, Bench())


def test_eddy_currents_are_no_error_of_the_parts() -> None:
    """A semi-inductance of 0.01 ohm s^0.5, 0.8 ohm at 1 kHz: what moves is found as without it."""
    rng = np.random.default_rng(1)
    glued = fitted(F, run(rng, is_glued=True, noise=1e-4, semi=0.01), what="run")
    found = exciter_values(None, glued, Bench(MAGNET))
    assert glued["semi_inductance"] == pytest.approx(0.01, rel=0.01)
    for name in ("resonance", "q", "resistance", "force_factor"):
        assert found[name][0] == pytest.approx(TRUE[name], rel=2e-3)
    at_300 = INDUCTANCE + 0.01 * np.sin(np.pi / 4) / np.sqrt(2 * np.pi * 300)
    assert found["inductance"][0] == pytest.approx(at_300, rel=5e-3)


def test_what_is_no_exciter_is_refused() -> None:
    """Open, short, a resistor, runs exchanged, runs of two exciters, masses: each by its cause."""
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
        exciter_values(glued, free, Bench(WEIGHT))
    other = fitted(
        F, RESISTANCE + 2 * (run(rng, is_glued=True, noise=1e-4) - RESISTANCE), what="run"
    )
    with pytest.raises(InputError, match="one exciter"):
        exciter_values(free, other, Bench(WEIGHT))
    with pytest.raises(InputError, match="--coil-mass follows"):
        exciter_values(free, glued, Bench(WEIGHT, COIL))
    with pytest.raises(InputError, match="--weight is missing"):
        Bench(base=BASE)
    with pytest.raises(InputError, match="must be below --weight"):
        Bench(COIL, WEIGHT)
