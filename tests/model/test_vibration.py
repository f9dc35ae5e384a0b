"""Vibration in frequency, how far meshes are from converged, and the sensation of fingertips.

Against independent solvers, another element and exact integrals over the disc of a fingertip.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from cases import shortly
from error_estimates import CASES, MAX_RATIO, judge
from kit.plates import LENGTH, WIDTH, make_paper_rig
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.fem import Mesh
from model.finger import (
    FINE_POINTS,
    FIVE_POINTS,
    THRESHOLDS,
    DiscRule,
    check_has_threshold,
    detection_threshold,
    felt_part,
    sensation_level,
    sensitivities,
)
from model.rig.rig import Rig
from model.rig.rig_mesh import mesh_of
from model.vibration import (
    Excitation,
    Tone,
    damped_modes,
    default_frequencies,
    meshes_to_compare,
    peak_acceleration,
    plate_map,
    study_convergence,
    tone_fields,
)

# Meshes

PAPER = np.array([31.98, 68.50, 76.62, 107.84, 160.77])
"""On four corner springs: founding paper, in-house column of Table 2 [Hz]."""
CONVERGED = np.array([31.6186, 67.9034, 75.4567, 106.449, 156.821])
"""The same, by NGSolve."""


@pytest.fixture(scope="module")
def automatic() -> Rig:
    """The paper's rig with its automatic mesh."""
    rig = make_paper_rig(12, 9)
    mesh = mesh_of("auto", rig.plate, frequency_max=500.0, stiffness=17e3)
    return replace(rig, mesh=mesh)


def test_auto_mesh_has_the_stated_accuracy(automatic: Rig) -> None:
    """Frequencies within 0.1 %, acceleration at 110 Hz and 250 Hz within 1 % for every drive.

    On 12x9 the errors are the paper's Table 2 against converged values, to its last digit. Places
    and feet count more than the mesh: on the paper's plate, from another solver, 0.1 mm changes 0.4
    to 0.9 %, 5 mm of foot 19 %. Those are over 27 frequencies at 20 points; here, at one frequency,
    it may be twice as much.
    """
    limits = replace(automatic.limits, frequency_max=260.0)
    meshes = [Mesh(12, 9, LENGTH, WIDTH), automatic.mesh]
    frequencies = default_frequencies(automatic)

    study = study_convergence(replace(automatic, limits=limits), meshes, frequencies=frequencies)

    paper, auto = study.errors
    assert np.abs(auto.frequency).max() < 1e-3
    assert auto.response.max() < 1e-2
    assert auto.mesh.dof < Mesh(24, 18, LENGTH, WIDTH).dof
    np.testing.assert_allclose(paper.frequency[:5], PAPER / CONVERGED - 1, atol=2e-4)
    assert study.by_place.min() > 0.002
    assert study.by_place.max() < 0.02
    assert study.by_foot.min() > 0.09
    assert study.by_foot.max() < 0.4
    assert (study.by_place / auto.response).min() > 5


@pytest.mark.long
def test_meshes_to_compare_converge_to_the_same_field(automatic: Rig) -> None:
    """12x9 and its doublings of MITC4, polynomials once, though they are the rig's, and Q5.

    MITC4 has nothing in common with the reference's element, yet comes ever closer to its answer.
    Q5 with strips, which share nothing with polynomials over the plate, have the accuracy of mesh
    auto.
    """
    meshes = meshes_to_compare(automatic)

    study = study_convergence(automatic, meshes, frequencies=default_frequencies(automatic))

    *mitc4, _, q5 = study.errors
    names = [str(error.mesh) for error in study.errors]
    assert names[:4] == ["12x9", "24x18", "48x36", "96x72"]
    assert names[4:] == ["13x11 Legendre", "10x8 Q5 with strips of 3 mm"]
    responses = np.array([error.response for error in mitc4])
    assert np.diff(responses, axis=0).max() < 0
    assert responses[-1].max() < 0.04
    assert np.abs(q5.frequency).max() < 1e-3
    assert q5.response.max() < 1e-2


@pytest.mark.parametrize(
    "name",
    shortly(["the paper's", "thick, 10 mm", "5:1", "telephone"], ["thick, 10 mm"]),
)
def test_error_is_within_the_estimate_and_the_accuracy(name: str) -> None:
    """Wherever it is above 0.25 %: at most 1.4 times the estimate, and 1 % on mesh auto.

    A part of `make estimate-test`.
    """
    by_name = {case.name: case for case in CASES}
    case = by_name[name]

    estimates = judge(case, degrees=(-2, 0), every=6)

    assert {estimate.kind for estimate in estimates} >= {"corners", "edges", "inside"}
    assert max(estimate.ratio for estimate in estimates) < MAX_RATIO
    on_auto = [estimate.error for estimate in estimates if estimate.added == 0]
    assert max(on_auto) < 0.01


# Tones

STROKE = 100e-6  # m
FULL = Tone(110.0, STROKE)


@pytest.mark.parametrize(
    "excitation",
    [
        {"SW": FULL, "NE": FULL},
        {"SW": FULL, "NE": Tone(110.0, 0.4 * STROKE, np.pi / 2)},
        {"SW": FULL, "NE": Tone(171.3, STROKE)},
    ],
    ids=["one frequency", "one frequency, out of phase", "two frequencies"],
)
def test_peak_acceleration_equals_maximum_over_time(
    coarse_rig: Rig, excitation: Excitation
) -> None:
    """Eq. 28 is the sum of the sinusoids over ten seconds, to the sampling of the signal."""
    rng = np.random.default_rng(3)
    responses = {}
    for tone in excitation.values():
        parts = rng.normal(size=(2, 4))
        responses.setdefault(tone.frequency, parts[0] + 1j * parts[1])

    def response(values: FloatArray) -> ComplexArray:
        return np.array([responses[float(value)] for value in values])[:, :, None]

    _, fields = tone_fields(excitation, coarse_rig.eras, response)
    (peak,) = peak_acceleration(np.abs(fields))

    time = np.arange(0, 10, 1e-4)
    names = [corner.name for corner in coarse_rig.eras]
    signal = np.zeros_like(time)
    for name, tone in excitation.items():
        gain = responses[tone.frequency][names.index(name)]
        amplitude = gain * tone.amplitude / STROKE
        angle = 2 * np.pi * tone.frequency * time + tone.phase
        signal += (amplitude * np.exp(1j * angle)).imag
    assert peak == pytest.approx(np.abs(signal).max(), rel=2e-3)


@pytest.mark.parametrize(
    ("excitation", "message"),
    [
        ({}, "excitation: "),
        ({"XX": FULL}, "no ERA 'XX'"),
        ({"SW": Tone(0.0, STROKE)}, "above zero"),
        ({"SW": Tone(math.nan, STROKE)}, "above zero"),
        ({"SW": Tone(60_000.0, STROKE)}, "resolves, got 60000 Hz"),
    ],
    ids=["none", "foreign ERA", "no frequency", "no number", "beyond the mesh"],
)
def test_plate_map_refuses_invalid_excitations(
    coarse_rig: Rig, excitation: Excitation, message: str
) -> None:
    """No ERA, a foreign ERA, no frequency, or a frequency that the mesh cannot carry."""
    with pytest.raises(InputError, match=message):
        plate_map(coarse_rig, excitation)


def test_damped_modes_of_a_rigid_plate_follow_from_springs_and_dampers() -> None:
    """By hand: it heaves at sqrt(4 k / m) with the ratio of its ERAs, and tilts sqrt(3) higher.

    Both tilts have sqrt(3) times the heave's damping ratio: dampers and springs are at the corners.
    """
    rig = make_paper_rig(12, 9, damping_ratio=0.05)
    stiff = replace(rig.plate.material, E=1e5 * rig.plate.material.E)
    rigid = replace(rig, plate=replace(rig.plate, material=stiff))

    modes = damped_modes(rigid)

    heave = math.sqrt(4 * 17e3 / rig.plate.mass) / (2 * math.pi)
    tilt = math.sqrt(3) * heave
    assert modes.natural_frequencies == pytest.approx([heave, tilt, tilt], rel=1e-3)
    tilt_damping = math.sqrt(3) * 0.05
    assert modes.damping_ratios == pytest.approx([0.05, tilt_damping, tilt_damping], rel=1e-2)


# Fingertips


def disc_mean(i: int, j: int) -> float:
    """Return the mean of x^i y^j over the unit disc, by the beta function; zero for odd powers."""
    if i % 2 or j % 2:
        return 0.0
    beta = math.gamma((i + 1) / 2) * math.gamma((j + 1) / 2) / math.gamma((i + j) / 2 + 1)
    return beta / math.pi * 2 / (i + j + 2)


@pytest.mark.parametrize(("rule", "degree"), [(FIVE_POINTS, 3), (FINE_POINTS, 7)], ids=["5", "21"])
def test_rules_integrate_polynomials_up_to_their_degree(rule: DiscRule, degree: int) -> None:
    """Every monomial up to the degree has the exact mean over the disc, the next does not."""
    x, y = rule.points.T
    for i in range(degree + 1):
        for j in range(degree + 1 - i):
            mean = rule.weights @ (x**i * y**j)
            assert mean == pytest.approx(disc_mean(i, j), abs=1e-14), (i, j)

    mean = rule.weights @ x ** (degree + 1)
    assert abs(mean - disc_mean(degree + 1, 0)) > 1e-3


# Thresholds

PROBE, PRESSING = "vibrotactile-probe", "pressing-fingertip"


@pytest.mark.parametrize(
    ("name", "frequency", "acceleration"),
    [
        (PROBE, 250.0, 0.1e-6 * (2 * np.pi * 250.0) ** 2),
        (PRESSING, 40.0, 0.065 * np.sqrt(2)),
    ],
)
def test_detection_thresholds_are_the_published_ones(
    name: str, frequency: float, acceleration: float
) -> None:
    """At 250 Hz a fingertip detects 0.1 um (Verrillo 1963 and followers).

    At 40 Hz 0.065 m/s² RMS, of a gripping hand (Morioka and Griffin 2006).
    """
    (threshold,) = detection_threshold(np.array([frequency]), name)

    assert threshold == pytest.approx(acceleration, rel=0.01)


def test_pressing_fingertips_are_more_sensitive() -> None:
    """Where Pacinian corpuscles decide, from 100 to 400 Hz, by 20 to 35 dB; at 20 Hz within 5."""
    frequencies = np.array([20.0, 100.0, 160.0, 250.0, 400.0])

    (ratios,) = sensitivities(frequencies, (PRESSING,), PROBE)

    low, *pacinian = 20 * np.log10(ratios)
    assert abs(low) < 5
    assert min(pacinian) >= 20
    assert max(pacinian) <= 35


def test_unknown_set_of_thresholds_is_refused() -> None:
    """By the names of the known sets."""
    with pytest.raises(InputError, match=PRESSING):
        detection_threshold(np.array([100.0]), "thumb")


def test_sensation_level_adds_tones_as_powers() -> None:
    """Two tones at the threshold are together 3 dB above it; without motion it is -inf."""
    frequencies = np.array([100.0, 250.0])

    level = sensation_level(frequencies, detection_threshold(frequencies))

    assert level == pytest.approx(10 * np.log10(2))
    assert sensation_level(np.array([100.0]), np.array([0.0])) == -np.inf


@pytest.mark.parametrize("name", THRESHOLDS)
def test_set_of_thresholds_reaches_1000_hz_and_has_matching_columns(
    name: str, pytestconfig: pytest.Config
) -> None:
    """Displacement times omega squared is acceleration, in every row to the digits printed."""
    path = pytestconfig.rootpath / f"model/data/thresholds/{name}.csv"
    rows = np.loadtxt(path, delimiter=",", comments=("#", "f"), usecols=(0, 1, 2))

    frequencies, displacements, accelerations = rows.T
    expected = displacements * 1e-6 * (2 * np.pi * frequencies) ** 2
    np.testing.assert_allclose(accelerations, expected, rtol=0.01)
    assert frequencies[0] == 10
    assert frequencies[-1] == 1000


@pytest.mark.parametrize("frequency", [9.9, 1000.1, np.nan])
def test_frequencies_without_data_are_refused(frequency: float) -> None:
    """Outside of a set there is neither a threshold nor a level nor a margin."""
    frequencies = np.array([100.0, frequency])

    with pytest.raises(InputError, match="10 to 1000 Hz"):
        check_has_threshold(frequencies)
    with pytest.raises(InputError, match="10 to 1000 Hz"):
        detection_threshold(frequencies, PRESSING)
    with pytest.raises(InputError, match="10 to 1000 Hz"):
        sensation_level(frequencies, np.ones(2))
    with pytest.raises(InputError, match="10 to 1000 Hz"):
        sensitivities(frequencies, THRESHOLDS)


@pytest.mark.parametrize("rate", [8000.0, 44_100.0])
@pytest.mark.parametrize(
    ("frequency", "gain"), [(40, 1), (300, 1), (850, 1), (1800, 0), (2500, 0), (3900, 0)]
)
def test_felt_part_passes_tones_up_to_a_kilohertz(
    rate: float, frequency: float, gain: float
) -> None:
    """Within 1 %, in phase and sample by sample; tones far above are removed."""
    times = np.arange(round(0.1 * rate)) / rate
    phases = 2 * np.pi * frequency * times
    tone = np.sin(phases + 0.7)
    samples = np.column_stack([tone, -2 * tone])

    first, second = felt_part(samples, rate).T

    inner = slice(round(0.003 * rate), round(0.097 * rate))
    np.testing.assert_allclose(first[inner], gain * tone[inner], atol=0.01)
    np.testing.assert_allclose(second, -2 * first, atol=1e-12)
