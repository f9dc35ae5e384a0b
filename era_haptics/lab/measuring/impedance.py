"""Determine an exciter's parameters from its electrical impedance, free and glued, and its weight.

The impedance is measured through a sound card, with one multisine and two voltages:

    output ──┬── exciter ──┬── resistor R ── ground
            V_1           V_2                         Z = R (V_1 / V_2 - 1)

Delay, filters and gain of the two inputs are assumed to be equal. With a single input, moved from
the first point to the second, they are equal by construction.

A coil of resistance R_e and inductance L in a field Bl, on a suspension k, c, has

    Z = R_e + i w L + K sqrt(i w) + R_m / (1 + i Q (f / f_0 - f_0 / f)),    R_m = Bl² / c,

where K is the semi-inductance of eddy currents, w_0² = k / u, and u is the reduced mass of the two
masses that move against each other: coil m and magnet M when hanging free, m + B and M when glued
to a mass B. With the total weight W = m + M and r = (f_g / f_f)²,

    m = r W / (1 + (1 - r) W / B),    k = u w_0²,    Bl² = R_m w_0 u / Q,    Q_es = Q R_e / R_m.

A rig's resonance and Q are those of a single mass m_0 on a fixed spring (the magnet if the coil was
glued, otherwise the coil): f = f_0 sqrt(u / m_0), and Q sqrt(m_0 / u).

If the resistor is s S instead of S, and the first input has g times the gain of the second, the
measured impedance is (Z / s + S) g - S. This is another circuit of the same kind, so the true
values follow from the fitted ones.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import approx_fprime, least_squares

from era_haptics.lab.measuring.measure import check_levels
from era_haptics.lab.measuring.sound_card import Multisine, SoundCard, play_on_one
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.files.csv_file import read_lines, write_columns

LOW, HIGH = 10.0, 1000.0
"""Frequencies [Hz] between which a resonance is sought."""

CIRCUIT_NAMES = (
    "resistance",
    "inductance",
    "semi_inductance",
    "motional_resistance",
    "resonance",
    "q",
)
"""Fitted values, in ohm, H, ohm s^0.5, ohm, Hz and 1."""

INDUCTANCE_AT = 300.0
"""Frequency [Hz] at which a semi-inductance is stated as an inductance."""

_HALF_WIDTH = 1.645  # standard errors to either side of a 90 % confidence interval
_LEAST_LINES = 12
_TRIED_Q = (0.4, 1.0, 2.5, 6.0, 15.0, 40.0)
_EACH = 3  # line that is tried as a peak
_CLEAR = 5.0  # standard errors of a peak
_SAME = 0.1  # relative, of Bl² by either run


@dataclass(frozen=True)
class ImpedanceSetup:
    """Known parameters of the setup.

    - weight, coil [kg]: of the whole exciter and of its coil, None if unknown.
    - base [kg]: mass that it was glued to.
    - scale_error [kg]: standard error of weight and base.
    - series [ohm]: the resistor.
    - series_error, input_error: relative bounds, uniformly distributed (JCGM 100:2008, 4.3.7), of
      the resistor's error and of the difference between the inputs' gains.
    """

    weight: float | None = None
    coil: float | None = None
    base: float = np.inf
    scale_error: float = 0.0
    series: float = 10.0
    series_error: float = 0.0
    input_error: float = 0.0

    def __post_init__(self) -> None:
        """Refuse masses that contradict each other."""
        if self.weight is None and (self.coil is not None or np.isfinite(self.base)):
            raise InputError("--weight is missing; --coil-mass and --base require it")
        if self.weight is not None and not (self.coil or 0.0) < self.weight:
            raise InputError(
                f"--coil-mass must be below --weight, {1e3 * self.weight:g} g, got "
                f"{1e3 * (self.coil or 0.0):g} g"
            )

    @property
    def values(self) -> FloatArray:
        """Weight, inverse of the base, factor of the resistor, ratio of the inputs, (4,)."""
        return np.array([self.weight or 1.0, 1 / self.base, 1.0, 1.0])

    @property
    def errors(self) -> FloatArray:
        """Standard errors of the parameters, (4,)."""
        even = np.array([self.series_error, self.input_error]) / np.sqrt(3)
        return np.array([self.scale_error, self.scale_error / self.base**2, *even])


@dataclass(frozen=True, eq=False)
class Circuit:
    """A fitted impedance: values in the order of CIRCUIT_NAMES, their covariance, and the misfit.

    misfit: root mean square of the differences, relative.
    """

    values: FloatArray
    covariance: FloatArray
    misfit: float

    def __getitem__(self, name: str) -> float:
        """Return a parameter by name."""
        return float(self.values[CIRCUIT_NAMES.index(name)])


def fit_circuit(frequencies: FloatArray, impedance: ComplexArray, *, what: str) -> Circuit:
    """Fit the circuit to an impedance (f,) [ohm] at frequencies (f,) [Hz].

    Errors are assumed to be relative, with a size estimated from the misfit. what: names the run.
    Raises InputError for an open or short circuit, exchanged inputs, or a missing resonance.
    """
    if len(frequencies) < _LEAST_LINES or not np.isfinite(impedance).all():
        raise InputError(
            f"{what}: an impedance must have at least {_LEAST_LINES} frequencies and finite "
            f"values, got {len(frequencies)} frequencies"
        )
    if not 0.2 < np.median(impedance.real) < 500:
        raise InputError(
            f"{what}: the resistance must be that of a coil, 0.2 to 500 ohm, got "
            f"{np.median(impedance.real):.3g} ohm; check for an open or short circuit, --series, "
            "and that the first input is before the exciter, the second one across the resistor"
        )
    found = _fit(frequencies, impedance)
    peak = CIRCUIT_NAMES.index("motional_resistance")
    error = np.sqrt(found.covariance[peak, peak])
    if not (found.values[peak] > _CLEAR * error and LOW < found["resonance"] < HIGH):
        raise InputError(
            f"{what}: the impedance must have a resonance between {LOW:g} and {HIGH:g} Hz, got "
            "none; check that the exciter's moving part is free to move, and the level"
        )
    return found


def _fit(f: FloatArray, impedance: ComplexArray) -> Circuit:
    """Least squares of relative differences, from the best of resonances and Q that are tried."""
    size = np.abs(impedance)
    ones = _parts(impedance / size)

    def matrix(resonance: float, q: float) -> FloatArray:
        omega = 2 * np.pi * f
        motion = 1 / (1 + 1j * q * (f / resonance - resonance / f))
        # What R_e, L, K and R_m are multiplied by.
        shares: ComplexArray = np.stack(
            [np.ones_like(f), 1j * omega, np.sqrt(1j * omega), motion], axis=1
        )
        return _parts(shares / size[:, None])

    def residual(x: FloatArray) -> FloatArray:
        return np.asarray(matrix(*x[4:]) @ x[:4] - ones)

    # The rest of the circuit follows linearly from resonance and Q.
    tried = [(float(peak), q) for peak in f[::_EACH] for q in _TRIED_Q]
    linear = [np.linalg.lstsq(matrix(*each), ones, rcond=None) for each in tried]
    best = min(range(len(tried)), key=lambda n: float(linear[n][1].sum()))
    first = np.array([*linear[best][0], *tried[best]])
    done = least_squares(residual, first, x_scale=np.maximum(np.abs(first), 1e-6), method="lm")
    slopes: FloatArray = np.asarray(done.jac)
    variance = 2 * done.cost / (2 * len(f) - len(first))
    covariance = np.asarray(np.linalg.pinv(slopes.T @ slopes) * variance)
    return Circuit(done.x, covariance, float(np.sqrt((done.fun**2).mean())))


def _parts(values: ComplexArray) -> FloatArray:
    return np.concatenate([values.real, values.imag])


def exciter_values(
    free: Circuit | None, glued: Circuit | None, bench: ImpedanceSetup
) -> dict[str, tuple[float, float]]:
    """Derive the values of a rig's exciter, each with half its 90 % confidence interval.

    Raises InputError for exchanged runs, or runs of different exciters.
    """
    runs = [each for each in (free, glued) if each is not None]
    if not runs:
        raise InputError("--free or --glued is missing; measure one, or give its file")
    if len(runs) == 2 and bench.coil is not None:
        raise InputError(
            "--coil-mass is computed from --free and --glued; remove it, or one of them"
        )
    x = np.concatenate([*(each.values for each in runs), bench.values])
    covariance = block_diag(*(each.covariance for each in runs), np.diag(bench.errors**2))

    def values(x: FloatArray) -> dict[str, float]:
        named = [
            dict(zip(CIRCUIT_NAMES, x[6 * n : 6 * n + 6], strict=True)) for n in range(len(runs))
        ]
        one, (weight, by_base, resistor, ratio) = named[-1], x[-4:]
        coil = bench.coil or 0.0
        if len(runs) == 2:
            share = (one["resonance"] / named[0]["resonance"]) ** 2
            coil = share * weight / (1 + (1 - share) * weight * by_base)
        magnet = weight - coil
        if glued is not None:
            mass, over = magnet, (1 + weight * by_base) / (1 + coil * by_base)  # m_0, m_0 / u
        else:
            mass, over = coil, weight / magnet
        resonance, q = one["resonance"] / np.sqrt(over), one["q"] * np.sqrt(over)
        resistance = resistor * ((one["resistance"] + bench.series) / ratio - bench.series)
        motional = one["motional_resistance"] * resistor / ratio
        semi = one["semi_inductance"] / np.sqrt(4 * np.pi * INDUCTANCE_AT)
        found = {
            "resonance": resonance,
            "q": q,
            "q_es": q * resistance / motional,
            "resistance": resistance,
            "inductance": (one["inductance"] + semi) * resistor / ratio,
        }
        if bench.weight is not None and mass > 0:
            omega = 2 * np.pi * resonance
            found |= {"coil_mass": coil} if coil else {}
            found |= {
                "weight": magnet,
                "stiffness": mass * omega**2,
                "force_factor": np.sqrt(motional * omega * mass / q),
            }
        return found

    def listed(x: FloatArray) -> FloatArray:
        return np.array(list(values(x).values()))

    if free is not None and glued is not None:
        _check_pair(free, glued)
    steps = np.maximum(1e-3 * np.sqrt(np.diag(covariance)), 1e-9)
    slopes = approx_fprime(x, listed, steps)
    widths = _HALF_WIDTH * np.sqrt(np.einsum("vn,nm,vm->v", slopes, covariance, slopes))
    return {
        name: (float(value), float(width))
        for (name, value), width in zip(values(x).items(), widths, strict=True)
    }


def _check_pair(free: Circuit, glued: Circuit) -> None:
    """Raise InputError for two runs of different exciters."""
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
            "--free and --glued must be of the same exciter, got a force factor squared that "
            f"differs by {100 * abs(ratio - 1):.0f} %; glue the coil's side firmly to something "
            "heavy, and let the exciter hang by its wires, touching nothing"
        )


_POSITIONS = ("before the exciter", "over the resistor")
_COLUMNS = ("frequency_hz", "real_ohm", "imag_ohm")
_READ = ("frequency_hz", "real", "imag", "magnitude", "phase_deg")
_UNNAMED = ("frequency_hz", "magnitude", "phase_deg")

LINES: FloatArray = np.unique(np.geomspace(LOW, HIGH, 120).round())
"""Whole frequencies [Hz] from 10 to 1000, nearly at equal ratios."""


def measured_impedance(
    card: SoundCard,
    *,
    inputs: tuple[int, ...],
    series: float,
    level: float,
    periods: int,
    move: Callable[[str], None],
) -> tuple[FloatArray, ComplexArray]:
    """Measure the impedance (f,) [ohm] in series with a resistor [ohm] at frequencies (f,) [Hz].

    inputs: before the exciter and across the resistor, counted from 1, or a single one that is
    moved: `move` is then called with the next point before each run. Raises InputError, LinkError.
    """
    sines = Multisine(LINES, 1, card.rate, level)
    voltages = list[ComplexArray]()
    for at, place in zip((inputs[0], inputs[-1]), _POSITIONS, strict=True):
        if len(inputs) == 1:
            move(place)
        if len(inputs) == 1 or not voltages:
            recorded = play_on_one(card, sines, 1, outputs=1, periods=periods)
        check_levels(recorded, {at: f"the signal {place}"})
        voltages.append(sines.found(recorded[:, at - 1]))
    return sines.frequencies, np.asarray(series * (voltages[0] / voltages[1] - 1))


def write_impedance(path: Path, frequencies: FloatArray, impedance: ComplexArray) -> None:
    """Write a file of frequencies [Hz] and an impedance [ohm], atomically; raises OSError."""
    columns = (frequencies, impedance.real, impedance.imag)
    write_columns(path, dict(zip(_COLUMNS, columns, strict=True)))


def read_impedance(path: Path) -> tuple[FloatArray, ComplexArray]:
    """Read frequencies (f,) [Hz] and impedance (f,) [ohm] from a file, also of another program.

    It contains magnitude and phase (ZMA, LIMP, REW) or real and imaginary part, with any column
    names and units that `model.files.csv_file.read_lines` knows. Raises InputError.
    """
    frequencies = []
    impedance = []
    for line in read_lines(path, _READ[:1], optional=_READ[1:], unnamed=_UNNAMED):
        frequencies.append(line.number("frequency_hz"))
        impedance.append(line.complex_number())
    if min(frequencies) <= 0:
        raise InputError(f"{path}: frequency_hz must be above 0, got {min(frequencies):g}")
    return np.array(frequencies), np.array(impedance)
