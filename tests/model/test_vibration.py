"""Vibration in frequency, how far meshes are from converged, and what fingertips feel.

Against independent solvers, another element and exact integrals over the disc of a fingertip;
thresholds, levels, the band that is felt, and the grid of fingers.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import dblquad

from cases import shortly
from error_estimates import CASES, MAX_RATIO, judge
from kit.plates import LENGTH, WIDTH, make_paper_rig
from model.errors import InputError
from model.fem import Mesh
from model.finger import (
    FINE_POINTS,
    FIVE_POINTS,
    THRESHOLDS,
    DiscRule,
    Grid,
    check_has_threshold,
    detection_threshold,
    felt_part,
    highest_measured,
    sensation_level,
    sensitivities,
)
from model.rig.rig_mesh import mesh_of
from model.structure.material import Material
from model.structure.plate import Plate
from model.vibration import (
    Tone,
    default_frequencies,
    find_nulls,
    meshes_to_compare,
    peak_acceleration,
    plate_map,
    study_convergence,
    tone_fields,
)

# On four corner springs: founding paper, in-house column of Table 2, and converged (NGSolve).
PAPER = np.array([31.98, 68.50, 76.62, 107.84, 160.77])
CONVERGED = np.array([31.6186, 67.9034, 75.4567, 106.449, 156.821])


@pytest.fixture(scope="module")
def automatic():
    """The paper's rig with its automatic mesh."""
    rig = make_paper_rig(12, 9)
    mesh = mesh_of("auto", rig.plate, frequency_max=500.0, stiffness=17e3)
    return replace(rig, mesh=mesh)


def test_auto_mesh_has_the_stated_accuracy(automatic):
    """Frequencies within 0.1 %, acceleration at 110 Hz and 250 Hz within 1 % for every drive.

    On 12x9 the errors are the paper's Table 2 against converged values, to its last digit. Places
    and feet count more than the mesh: on the paper's plate, from another solver, 0.1 mm changes 0.4
    to 0.9 %, 5 mm of foot 19 %. Those are over 27 frequencies at 20 points; here at one frequency
    it may be twice as much.
    """
    limited = replace(automatic, limits=replace(automatic.limits, frequency_max=260.0))
    meshes, frequencies = (
        [Mesh(12, 9, LENGTH, WIDTH), automatic.mesh],
        default_frequencies(automatic),
    )
    study = study_convergence(limited, meshes, frequencies=frequencies)
    paper, auto = study.errors
    assert np.abs(auto.frequency).max() < 1e-3
    assert auto.response.max() < 1e-2
    assert auto.mesh.dof < Mesh(24, 18, LENGTH, WIDTH).dof
    np.testing.assert_allclose(paper.frequency[:5], PAPER / CONVERGED - 1, atol=2e-4)
    assert ((study.by_place > 0.002) & (study.by_place < 0.02)).all()
    assert ((study.by_foot > 0.09) & (study.by_foot < 0.4)).all()
    assert (study.by_place > 5 * auto.response).all()


@pytest.mark.long
def test_meshes_to_compare_converge_to_the_same_field(automatic):
    """12x9 and its doublings of MITC4, polynomials once, though they are the rig's, and Q5.

    MITC4 knows nothing of the reference's element, yet comes ever closer to its answer. Q5 with
    strips, which share nothing with polynomials over the plate, have the accuracy of mesh auto.
    """
    meshes = meshes_to_compare(automatic)
    whole = study_convergence(automatic, meshes, frequencies=default_frequencies(automatic))
    assert [str(error.mesh) for error in whole.errors] == [
        "12x9",
        "24x18",
        "48x36",
        "96x72",
        "13x11 Legendre",
        "10x8 Q5 with strips of 3 mm",
    ]
    errors = np.array([error.response for error in whole.errors[:4]])
    assert (np.diff(errors, axis=0) < 0).all()
    assert errors[-1].max() < 0.04
    elements = whole.errors[-1]
    assert np.abs(elements.frequency).max() < 1e-3
    assert elements.response.max() < 1e-2


FULL = 100e-6


def peak_over_time(rig, excitation, response):
    """Largest absolute acceleration over ten seconds of one point, sample by sample."""
    time = np.arange(0, 10, 1e-4)
    total = np.zeros_like(time)
    for name, tone in excitation.items():
        era = [e.name for e in rig.eras].index(name)
        complex_acceleration = response[tone.frequency][era] * tone.amplitude / FULL
        phasor = complex_acceleration * np.exp(1j * tone.phase)
        total += np.abs(phasor) * np.sin(2 * np.pi * tone.frequency * time + np.angle(phasor))
    return np.abs(total).max()


@pytest.mark.parametrize(
    "excitation",
    [
        {"SW": Tone(110.0, FULL), "NE": Tone(110.0, FULL)},
        {"SW": Tone(110.0, FULL), "NE": Tone(110.0, 0.4 * FULL, np.pi / 2)},
        {"SW": Tone(171.3, FULL), "NE": Tone(110.9, FULL)},
    ],
    ids=["one frequency", "one frequency, out of phase", "two frequencies"],
)
def test_peak_acceleration_equals_maximum_over_time(coarse_rig, excitation):
    """Eq. 28 gives what summing the sinusoids in time gives, to the sampling of the signal."""
    rng = np.random.default_rng(3)
    tones = {tone.frequency for tone in excitation.values()}
    response = {f: rng.normal(size=4) + 1j * rng.normal(size=4) for f in tones}
    stacked = lambda f: np.array([response[float(v)] for v in f])[:, :, None]  # noqa: E731
    _, fields = tone_fields(excitation, coarse_rig.eras, stacked)
    expected = peak_over_time(coarse_rig, excitation, response)
    assert peak_acceleration(np.abs(fields))[0] == pytest.approx(expected, rel=2e-3)


def test_find_nulls_returns_each_null_once():
    """Two points that rest on a map that is no square: x by the column, y by the row."""
    x, y = np.linspace(0, 3, 16), np.linspace(0, 2, 11)
    rests = np.array([[0.4, 1.8], [2.2, 0.6]])
    peak = np.min([np.hypot(x - a, y[:, None] - b) for a, b in rests], axis=0)
    np.testing.assert_allclose(find_nulls(x, y, peak)[::-1], rests)


@pytest.mark.parametrize(
    ("excitation", "says"),
    [
        ({}, "excitation: "),
        ({"XX": Tone(110.0, FULL)}, "no ERA 'XX'"),
        ({"SW": Tone(0.0, FULL)}, "above zero"),
        ({"SW": Tone(float("nan"), FULL)}, "above zero"),
        ({"SW": Tone(60_000.0, FULL)}, "resolves, got 60000 Hz"),
    ],
)
def test_plate_map_refuses_invalid_excitations(coarse_rig, excitation, says):
    """No answer is given for no ERA, a foreign ERA, no frequency, or one the mesh cannot carry."""
    with pytest.raises(InputError, match=says):
        plate_map(coarse_rig, excitation)


@pytest.mark.parametrize(
    "name",
    shortly(["the paper's", "thick, 10 mm", "5:1", "telephone"], ["thick, 10 mm"]),
)
def test_error_is_within_the_estimate_and_the_accuracy(name):
    """Wherever it is above 0.25 %: at most 1.4 times the estimate, and 1 % on mesh auto.

    A part of `make estimate-test`.
    """
    case = next(case for case in CASES if case.name == name)
    judged = judge(case, degrees=(-2, 0), every=6)
    assert {each.kind for each in judged} >= {"corners", "edges", "inside"}
    assert max(each.ratio for each in judged) < MAX_RATIO
    assert max(each.error for each in judged if each.added == 0) < 0.01


PLATE = Plate(0.3, 0.2, 0.0015, Material("any", E=70e9, rho=2700.0, nu=0.33))


def disc_mean(i: int, j: int) -> float:
    """Mean of x^i y^j over the unit disc, by the beta function; zero for odd powers."""
    if i % 2 or j % 2:
        return 0.0
    beta = math.gamma((i + 1) / 2) * math.gamma((j + 1) / 2) / math.gamma((i + j) / 2 + 1)
    return beta / math.pi * 2 / (i + j + 2)


@pytest.mark.parametrize(("rule", "degree"), [(FIVE_POINTS, 3), (FINE_POINTS, 7)])
def test_rules_integrate_polynomials_up_to_their_degree(rule: DiscRule, degree: int) -> None:
    """Every monomial up to the degree has the exact mean over the disc, one beyond has not."""
    x, y = rule.points.T
    for i in range(degree + 1):
        for j in range(degree + 1 - i):
            assert rule.weights @ (x**i * y**j) == pytest.approx(disc_mean(i, j), abs=1e-14)
    beyond = degree + 1
    assert abs(rule.weights @ x**beyond - disc_mean(beyond, 0)) > 1e-3


@pytest.mark.parametrize("rule", [FIVE_POINTS, FINE_POINTS])
@pytest.mark.parametrize(
    ("low", "high"),
    [((0, -2), (2, 2)), ((0, 0), (2, 2)), ((-2, -2), (0.3, 0.8)), ((-0.31, -2), (2, 2))],
)
def test_cut_discs_keep_the_mean_of_linear_functions(
    rule: DiscRule, low: tuple[float, float], high: tuple[float, float]
) -> None:
    """At an edge and at corners the mean of a linear function is that over what remains."""
    area, *moments = (
        dblquad(
            function,
            max(low[0], -1),
            min(high[0], 1),
            lambda x: max(low[1], -math.sqrt(1 - x * x)),
            lambda x: min(high[1], math.sqrt(1 - x * x)),
            epsabs=1e-7,
        )[0]
        for function in (lambda y, x: 1.0, lambda y, x: x, lambda y, x: y)
    )
    points, weights = (each[0] for each in rule.cut(np.array([low]), np.array([high])))
    assert weights.min() >= 0
    assert weights.sum() == pytest.approx(1)
    np.testing.assert_allclose(weights @ points, np.array(moments) / area, atol=1e-5)


PROBE, PRESSING = "vibrotactile-probe", "pressing-fingertip"


def test_detection_thresholds_are_those_published():
    """At 250 Hz a fingertip detects 0.1 um, 0.247 m/s² (Verrillo 1963 and followers).

    0.065 m/s² rms at 40 Hz (Morioka and Griffin 2006), of a gripping hand, is 0.0919 m/s² peak.
    Where Pacinian corpuscles decide, from 100 to 400 Hz, thresholds of pressing fingertips lie 20
    to 35 dB lower; at 20 Hz within 5 dB. The probe's end at 500 Hz, those of pressing fingertips at
    315 Hz; a set that is not known is refused by the names of those that are.
    """
    displacement = detection_threshold(np.array([250.0])) / (2 * np.pi * 250.0) ** 2
    assert displacement[0] == pytest.approx(0.100e-6, rel=0.01)
    gripping = detection_threshold(np.array([40.0]), PRESSING)
    assert gripping[0] == pytest.approx(0.065 * np.sqrt(2), rel=1e-3)
    frequencies = np.array([20.0, 100.0, 160.0, 250.0, 400.0])
    low, *lower = 20 * np.log10(
        detection_threshold(frequencies, PROBE) / detection_threshold(frequencies, PRESSING)
    )
    assert abs(low) < 5
    assert 20 <= min(lower) <= max(lower) <= 35
    assert [highest_measured(name) for name in (PROBE, PRESSING)] == [500.0, 315.0]
    with pytest.raises(InputError, match=PRESSING):
        detection_threshold(np.array([100.0]), "thumb")


def test_sensation_level_adds_tones_as_powers():
    """Two tones each at threshold are together 3 dB above it; where nothing moves it is -inf."""
    frequencies = np.array([100.0, 250.0])
    level = sensation_level(frequencies, detection_threshold(frequencies))
    assert level == pytest.approx(10 * np.log10(2))
    assert sensation_level(np.array([100.0]), np.array([0.0])) == -np.inf


@pytest.mark.parametrize("name", THRESHOLDS)
def test_every_set_reaches_1000_hz_and_has_matching_columns(name, pytestconfig):
    """Displacement times omega squared is acceleration, in every row to the digits printed."""
    text = (pytestconfig.rootpath / f"model/data/thresholds/{name}.csv").read_text("utf-8")
    rows = [line.split(",") for line in text.splitlines() if line[0].isdigit()]
    for frequency, displacement, acceleration, _ in rows:
        expected = float(displacement) * 1e-6 * (2 * np.pi * float(frequency)) ** 2
        assert float(acceleration) == pytest.approx(expected, rel=0.01)
    assert float(rows[0][0]) == 10
    assert float(rows[-1][0]) == 1000


@pytest.mark.parametrize("frequency", [9.9, 1000.1, np.nan])
def test_frequencies_without_data_are_refused(frequency):
    """Neither a threshold nor a level nor a margin is made up outside of a set."""
    asked = np.array([100.0, frequency])
    for refused in (
        lambda: check_has_threshold(asked),
        lambda: detection_threshold(asked, PRESSING),
        lambda: sensation_level(asked, np.ones(2)),
        lambda: sensitivities(asked, THRESHOLDS),
    ):
        with pytest.raises(InputError, match="10 to 1000 Hz"):
            refused()


def test_sensitivities_are_ratios_of_thresholds():
    """At 250 Hz the probe's thresholds are 0.247 m/s² and those of pressing fingers 28 dB lower."""
    found = sensitivities(np.array([40.0, 250.0]), (PROBE, PRESSING), PROBE)
    assert found[0] == pytest.approx(1)
    assert found[1] == pytest.approx([0.251 / 0.0919, 0.247 / 0.0098], rel=0.02)


@pytest.mark.parametrize("rate", [8000.0, 10_000.0, 44_100.0])
@pytest.mark.parametrize(
    ("frequency", "passes"), [(40, 1), (300, 1), (850, 1), (1800, 0), (2500, 0), (3900, 0)]
)
def test_felt_part_passes_tones_up_to_a_kilohertz(
    rate: float, frequency: float, passes: float
) -> None:
    """Within 1 %, in phase and sample by sample; what is far above is gone.

    At 2 kHz nothing above 1 kHz is in them; none at all are none.
    """
    times = np.arange(round(0.1 * rate)) / rate
    tone = np.sin(2 * np.pi * frequency * times + 0.7)
    samples = np.column_stack([tone, -2 * tone])
    found = felt_part(samples, rate)
    inner = (times > 0.003) & (times < 0.097)
    np.testing.assert_allclose(found[inner, 0], passes * tone[inner], atol=0.01)
    np.testing.assert_allclose(found[:, 1], -2 * found[:, 0], atol=1e-12)
    np.testing.assert_array_equal(felt_part(samples, 2000.0), samples)
    assert felt_part(samples[:0], 10_000.0).shape == (0, 2)


def test_grid_numbers_cells_along_x_first():
    """Three by two cells of 100 mm."""
    centers = [[x, y] for y in (0.05, 0.15) for x in (0.05, 0.15, 0.25)]
    np.testing.assert_allclose(Grid(3, 2).centers(PLATE), centers)
