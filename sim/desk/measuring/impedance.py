"""An exciter by its electrical impedance, hanging free and glued, and its weight.

A coil of resistance R_e and inductance L in a field Bl, on a suspension k, c, has

    Z = R_e + i w L + K sqrt(i w) + R_m / (1 + i Q (f / f_0 - f_0 / f)),    R_m = Bl² / c,

K the semi-inductance of eddy currents. Hanging free, coil m and magnet M move against each other:
w_f² = k (1 / m + 1 / M). Glued to something heavy the coil is held: w_g² = k / M. With the whole
weight W = m + M therefore

    m = W (f_g / f_f)²,    k = M w_g²,    Bl² = R_m w_g M / Q,    Q_es = Q R_e / R_m.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError

LOW, HIGH = 10.0, 1000.0
"""Frequencies [Hz] between which a resonance is sought."""

NAMES = ("resistance", "inductance", "semi_inductance", "motional_resistance", "resonance", "q")
"""Fitted values, in ohm, H, ohm s^0.5, ohm, Hz and 1."""

INDUCTANCE_AT = 300.0
"""Frequency [Hz] at which a semi-inductance is stated as an inductance."""

HALF_WIDTH = 1.645
"""Standard errors on either side that hold nine of ten values."""

_LEAST_LINES = 12
_TRIED_Q = (0.4, 1.0, 2.5, 6.0, 15.0, 40.0)
_EACH = 3  # line that is tried as a peak
_CLEAR = 5.0  # standard errors of a peak
_SEMI = 25.0  # variances by which a semi-inductance must improve the fit
_SAME = 0.1  # relative, of Bl² by either run

Known = Mapping[str, tuple[float, float]]
"""Values with their standard errors."""


@dataclass(frozen=True, eq=False)
class Circuit:
    """A fitted impedance: values in the order of NAMES, their covariance, and the misfit.

    misfit: root mean square of the differences, relative.
    """

    values: FloatArray
    covariance: FloatArray
    misfit: float

    def __getitem__(self, name: str) -> float:
        """A value by its name."""
        return float(self.values[NAMES.index(name)])


def fitted(frequencies: FloatArray, impedance: ComplexArray, *, what: str) -> Circuit:
    """Fit the circuit to an impedance (f,) [ohm] at frequencies (f,) [Hz].

    Errors are taken as relative, and their size from the misfit. what: names the run. Raises
    InputError for what is no exciter: open, short, inputs exchanged, without a resonance.
    """
    _check(frequencies, impedance, what=what)
    start = _start(frequencies, impedance)
    plain = _fit(frequencies, impedance, start, has_semi=False)
    semi = _fit(frequencies, impedance, start, has_semi=True)
    gained = (plain.misfit / semi.misfit) ** 2 - 1 if semi.misfit > 0 else 0.0
    found = semi if gained * 2 * len(frequencies) > _SEMI else plain
    peak = NAMES.index("motional_resistance")
    error = np.sqrt(found.covariance[peak, peak])
    if not (found.values[peak] > _CLEAR * error and LOW < found["resonance"] < HIGH):
        raise InputError(
            f"{what}: the impedance must have a resonance between {LOW:g} and {HIGH:g} Hz, got "
            "none; check that the exciter's moving part is free to move, and the level"
        )
    return found


def _check(frequencies: FloatArray, impedance: ComplexArray, *, what: str) -> None:
    if len(frequencies) < _LEAST_LINES or not np.isfinite(impedance).all():
        raise InputError(
            f"{what}: an impedance must have at least {_LEAST_LINES} frequencies and finite "
            f"values, got {len(frequencies)} frequencies"
        )
    if not 0.2 < np.median(impedance.real) < 500:
        raise InputError(
            f"{what}: the resistance must be that of a coil, 0.2 to 500 ohm, got "
            f"{np.median(impedance.real):.3g} ohm; check for an open or short circuit, --series, "
            "and that the first input is before the resistor, the second one over it"
        )


def _shares(f: FloatArray, resonance: float, q: float) -> ComplexArray:
    """What R_e, L, K and R_m are multiplied by, (f, 4)."""
    omega = 2 * np.pi * f
    motion = 1 / (1 + 1j * q * (f / resonance - resonance / f))
    return np.stack([np.ones_like(f), 1j * omega, np.sqrt(1j * omega), motion], axis=1)


def _start(f: FloatArray, impedance: ComplexArray) -> tuple[float, float]:
    """The resonance and Q, of those tried, that explain most with the rest fitted linearly."""

    def misfit(tried: tuple[float, float]) -> float:
        matrix = _parts(_shares(f, *tried) / np.abs(impedance)[:, None])
        return float(np.linalg.lstsq(matrix, ones, rcond=None)[1].sum())

    ones = _parts(impedance / np.abs(impedance))
    return min(((float(peak), q) for peak in f[::_EACH] for q in _TRIED_Q), key=misfit)


def _fit(
    f: FloatArray, impedance: ComplexArray, start: tuple[float, float], *, has_semi: bool
) -> Circuit:
    size = np.abs(impedance)
    kept = [0, 1, 2, 3] if has_semi else [0, 1, 3]

    def matrix(x: FloatArray) -> FloatArray:
        return _parts(_shares(f, *np.exp(x[-2:]))[:, kept] / size[:, None])

    def residual(x: FloatArray) -> FloatArray:
        return np.asarray(matrix(x) @ x[:-2] - ones)

    ones, nonlinear = _parts(impedance / size), np.log(start)
    linear = np.linalg.lstsq(matrix(nonlinear), ones, rcond=None)[0]
    first = np.concatenate([linear, nonlinear])
    done = least_squares(residual, first, x_scale=np.maximum(np.abs(first), 1e-6), method="lm")
    free = max(2 * len(f) - len(first), 1)
    slopes: FloatArray = np.asarray(done.jac)
    inner = np.linalg.pinv(slopes.T @ slopes) * float((done.fun**2).sum()) / free
    at = [*kept, 4, 5]
    values, covariance = np.zeros(6), np.zeros((6, 6))
    values[at] = [*done.x[:-2], *np.exp(done.x[-2:])]
    slope = np.diag([*np.ones(len(kept)), *values[4:]])
    covariance[np.ix_(at, at)] = slope @ inner @ slope
    return Circuit(values, covariance, float(np.sqrt((done.fun**2).mean())))


def _parts(values: ComplexArray) -> FloatArray:
    return np.concatenate([values.real, values.imag])


def exciter_values(
    free: Circuit | None, glued: Circuit | None, weight: float | None, weight_error: float
) -> dict[str, tuple[float, float]]:
    """The values of a rig's exciter that follow, each with its standard error.

    weight, weight_error [kg]: of the whole exciter, None if unknown. Raises InputError for runs
    that are exchanged or not of one exciter.
    """
    circuit = glued or free
    if circuit is None:
        raise InputError("--free or --glued is missing; measure one of them, or give its file")
    runs = [each for each in (free, glued) if each is not None]
    x = np.concatenate([*(each.values for each in runs), [weight or 1.0]])
    covariance = np.zeros((len(x), len(x)))
    for n, each in enumerate(runs):
        covariance[6 * n : 6 * n + 6, 6 * n : 6 * n + 6] = each.covariance
    covariance[-1, -1] = weight_error**2

    def values(x: FloatArray) -> dict[str, float]:
        named = [dict(zip(NAMES, x[6 * n : 6 * n + 6], strict=True)) for n in range(len(runs))]
        one, has_weight = named[-1], weight is not None
        root = 1 / np.sqrt(4 * np.pi * INDUCTANCE_AT)
        found = {
            "resonance": one["resonance"],
            "q": one["q"],
            "q_es": one["q"] * one["resistance"] / one["motional_resistance"],
            "resistance": one["resistance"],
            "inductance": one["inductance"] + one["semi_inductance"] * root,
        }
        if glued is not None and has_weight:
            coil = x[-1] * (one["resonance"] / named[0]["resonance"]) ** 2 if free else 0.0
            omega, magnet = 2 * np.pi * one["resonance"], x[-1] - coil
            found |= {"coil_mass": coil} if free else {}
            found |= {
                "weight": magnet,
                "stiffness": magnet * omega**2,
                "force_factor": np.sqrt(one["motional_resistance"] * omega * magnet / one["q"]),
            }
        return found

    if free is not None and glued is not None:
        _check_pair(free, glued)
    return _with_errors(values, x, covariance)


def _check_pair(free: Circuit, glued: Circuit) -> None:
    """Raise InputError for two runs that are not of one exciter."""
    low, high = glued["resonance"], free["resonance"]
    if not low < high:
        raise InputError(
            "--free must have a higher resonance than --glued, whose coil is held, got "
            f"{high:.4g} and {low:.4g} Hz: are the two exchanged?"
        )
    # R_m w / Q is Bl² by the mass that moves, and these masses are as the squares of frequencies.
    powers = [each["motional_resistance"] / each["q"] * each["resonance"] for each in (free, glued)]
    ratio = powers[0] / powers[1] * (low / high) ** 2
    if abs(ratio - 1) > _SAME:
        raise InputError(
            "--free and --glued must be of one exciter, got a force factor squared that differs "
            f"by {100 * abs(ratio - 1):.0f} %; glue the coil's side firmly to something heavy, and "
            "let the exciter hang by its wires, touching nothing"
        )


def _with_errors(
    function: Callable[[FloatArray], dict[str, float]], x: FloatArray, covariance: FloatArray
) -> dict[str, tuple[float, float]]:
    """Values of a function and their standard errors, by its slopes."""

    def listed(x: FloatArray) -> FloatArray:
        return np.array(list(function(x).values()))

    errors = np.sqrt(np.diag(covariance))
    slopes = np.zeros((len(listed(x)), len(x)))
    for n in np.flatnonzero(errors):
        step = 1e-3 * errors[n] * np.eye(len(x))[n]
        slopes[:, n] = (listed(x + step) - listed(x - step)) / (2 * step[n])
    found = np.sqrt(np.einsum("vn,nm,vm->v", slopes, covariance, slopes))
    return {
        name: (float(value), float(error))
        for (name, value), error in zip(function(x).items(), found, strict=True)
    }
