"""Rig check: faults planted on boards that another solver computes are found, and nothing else.

Responses of the paper's plate come from one sparse solve per frequency (`model.fem`), of exciters
and hidden plates from functions over the whole plate; the check uses the reduced plate. Every
measurement of the paper's plate has random gains of 5 % and 5 degrees and noise of 2 % of each row.
`scenarios.yaml` lists planted faults and expected findings.
"""

import json
import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cases import read_yaml, shortly
from era_haptics.command import run_era
from era_haptics.lab.measuring import measure
from kit import plates
from kit.plates import (
    DISTORTIONS,
    as_sold,
    exciter_rig,
    make_paper_rig,
    noise_like,
    perturbed,
    random_gains,
    write_rig,
)
from kit.weekend_boards import FOLDER, BuiltBoard
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.estimate import hypotheses
from model.estimate.calibrate import calibrate
from model.estimate.check_report import as_json, channel_table, verdict_rows
from model.estimate.measurement import MeasuredPlate, Measurement, sensors_at
from model.estimate.rig_check import check_meaning, diagnose, judged_by_promises
from model.estimate.screening import check_consistency
from model.estimate.sensed_plate import sensed_plate
from model.fem import Mesh
from model.response_files import (
    measurement_of,
    read_measured,
    write_responses,
    write_responses_csv,
)
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, load_rig, parse_rig
from model.rig.rig_writing import change_rig
from model.spectral.direct_solution import direct_spectral_acceleration
from model.spectral.plate_mesh import SpectralMesh
from model.structure.plate import Plate
from model.structure.sources import Era
from tests.model.estimate.thin_plates import FAULTS, draw, measured_fault

WEEKEND = load_rig(FOLDER / "rig.yaml")
"""The board of the page, grain along its length."""
WEEKEND_FREQUENCIES = np.arange(91.0, 300.0, 20.0)
PAPER = make_paper_rig(16, 12)
PAPER_FREQUENCIES = np.linspace(57.0, 487.0, 10)
FREQUENCIES = np.arange(60.0, 421.0, 40.0)


# Boards on exciters


def with_exciter_keys(keys: Mapping[str, Any]) -> Rig:
    """The board of the page with these keys at each exciter."""
    return change_rig(WEEKEND, eras=dict.fromkeys(("NE", "NW", "SW", "SE"), keys))


def with_resonance(kind: str, resonance: float = 306.0) -> Rig:
    """The board of the page with a resonance, by default the data sheet's, of coil or magnet."""
    return with_exciter_keys({"resonance": resonance, "resonance_is": kind})


CUT_ACROSS = change_rig(WEEKEND, plate={"grain": "width"})


def measured_board(rig: Rig, seed: int) -> Measurement:
    """Responses of a board with tolerances at one moved sensor, at all positions or at four."""
    responses = BuiltBoard.drawn(rig, seed).measured(WEEKEND_FREQUENCIES, seed)
    return responses if seed % 2 else responses.without(np.arange(12) % 3 > 0)


@dataclass(frozen=True)
class Glued:
    """An exciter on a spring of glue [N/m], which loses a fifth."""

    exciter: Any
    spring: float

    def __getattr__(self, name: str) -> Any:
        """Its position, its foot and its full level."""
        return getattr(self.exciter, name)

    def dynamic_stiffness(self, omega: FloatArray) -> ComplexArray:
        """Stiffness of exciter and glue in series [N/m]."""
        return self.exciter.dynamic_stiffness(omega) * self._transmitted(omega)

    def force(self, omega: FloatArray) -> ComplexArray:
        """Force that the glue transmits [N]."""
        return self.exciter.force(omega) * self._transmitted(omega)

    def _transmitted(self, omega: FloatArray) -> ComplexArray:
        glue = self.spring * (1 + 0.2j)
        return glue / (glue + self.exciter.dynamic_stiffness(omega))


PARTS = "uncertainty: {gain: 0.2, phase_deg: 10, stiffness: 0.2, modulus: 0.1, thickness: 0.02}"


def measured_parts(seed: int, glue: Mapping[str, float]) -> tuple[Rig, Measurement]:
    """A board of another rigidity (10 %) with exciters whose parts differ (20 %, 10 degrees).

    At nine sensors with 0.5 % of noise; glue [N/m]: below exciters by name.
    """
    rig = exciter_rig("type: DAEX25FHE-4, power: 1 W", frequency="[40, 300]", more=PARTS)
    assert isinstance(rig.mesh, SpectralMesh)
    frequencies = np.arange(41.0, 300.0, 20.0)
    positions = np.array([(0.3 * x, 0.23 * y) for x in (0.1, 0.4, 0.88) for y in (0.15, 0.5, 0.85)])
    built = as_sold(rig, np.random.default_rng(seed), modulus=0.1)
    sources = [Glued(era, glue[era.name]) if era.name in glue else era for era in built.eras]
    fields = direct_spectral_acceleration(
        built.plate, rig.mesh, sources, frequencies, positions, loads=rig.masses
    )
    levels = np.array([era.full_level for era in rig.eras])
    values = fields.swapaxes(1, 2) / levels
    sizes = np.sqrt((np.abs(values) ** 2).mean(axis=1, keepdims=True))
    noise = np.random.default_rng([seed, 1]).standard_normal((*values.shape, 2)) @ [1, 1j]
    names = tuple(f"P{number}" for number in range(1, 10))
    sensors = sensors_at(positions, names)
    return rig, Measurement(sensors, frequencies, values + 0.005 * sizes * noise)


# Plates on ERAs


def within_tolerance(rig: Rig, rng: np.random.Generator) -> Rig:
    """A plate as builders build it by the rig's file: E ±5 %, h ±2 %, k ±10 %, damping x2."""
    modulus = rig.plate.material.E * rng.uniform(0.95, 1.05)
    thickness = rig.plate.thickness * rng.uniform(0.98, 1.02)
    loss_factor = rig.plate.loss_factor * 2 ** rng.uniform(-1, 1)
    eras = []
    for era in rig.eras:
        stiffness = era.stiffness * rng.uniform(0.9, 1.1)
        damping = era.damping * 2 ** rng.uniform(-1, 1)
        bolt_mass = rng.uniform(0, 0.004)
        eras.append(replace(era, stiffness=stiffness, damping=damping, bolt_mass=bolt_mass))
    plate = replace(
        rig.plate,
        material=replace(rig.plate.material, E=modulus),
        thickness=thickness,
        loss_factor=loss_factor,
    )
    return replace(rig, plate=plate, eras=tuple(eras))


def with_sides(rig: Rig, x: float, y: float) -> Rig:
    """A longer or wider plate with its ERAs at its corners."""
    plate = replace(rig.plate, length=x * rig.plate.length, width=y * rig.plate.width)
    eras = tuple(replace(era, x=x * era.x, y=y * era.y) for era in rig.eras)
    return replace(rig, plate=plate, eras=eras, mesh=Mesh(14, 11, plate.length, plate.width))


def with_plate(rig: Rig, plate: Plate) -> Rig:
    """The rig of another plate, on a mesh that resolves the tones."""
    highest, mesh = PAPER_FREQUENCIES[-1], rig.mesh
    if highest > mesh.highest_frequency(plate):
        mesh = mesh.resolving(plate, highest)
    return replace(rig, plate=plate, mesh=mesh)


def with_eras(rig: Rig, change: Callable[[Era], Era]) -> Rig:
    """The rig with each ERA changed."""
    return replace(rig, eras=tuple(change(era) for era in rig.eras))


def changed_plate(rig: Rig, name: str, value: Any) -> Rig:
    """A plate that is not the rig's, by one factor, by heavier bolts or with a loose bolt."""
    plate = rig.plate
    match name:
        case "thickness":
            return with_plate(rig, replace(plate, thickness=value * plate.thickness))
        case "modulus":
            return with_plate(rig, plate.scaled(modulus=value))
        case "loss":
            return replace(rig, plate=replace(plate, loss_factor=value * plate.loss_factor))
        case "length":
            return with_sides(rig, value, 1.0)
        case "width":
            return with_sides(rig, 1.0, value)
        case "bolts":
            return with_eras(rig, lambda era: replace(era, bolt_mass=era.bolt_mass + value))
        case "stiffness":
            return with_eras(rig, lambda era: era.varied(stiffness=value))
    assert name == "loose"
    loose_era = replace(rig.era(value), stiffness=200.0, damping=0.05)
    return with_eras(rig, lambda era: loose_era if era.name == value else era)


def measured_on_paper(rig: Rig, rng: np.random.Generator) -> Measurement:
    """Responses with the gains and the noise of every measurement."""
    eras = []
    for era in rig.eras:
        gains = random_gains(rng, PAPER_FREQUENCIES, size=0.05, phase=np.radians(5))
        eras.append(replace(era, gains=gains))
    gained = replace(rig, eras=tuple(eras))
    return plates.measured(gained, frequencies=PAPER_FREQUENCIES, noise=0.02)


# Scenarios


def board_of(case: Mapping[str, Any]) -> tuple[Rig, Measurement]:
    """The rig of a scenario's board, and its responses before faults are planted."""
    kind, _, number = case["board"].partition(" ")
    seed = int(number or 0)
    match kind:
        case "paper":
            rig, rng = make_paper_rig(12, 9), np.random.default_rng(seed)
            true_rig = within_tolerance(rig, rng)
            if case.get("plate") == {"stiffness": 2.2}:
                true_rig = rig
            for name, value in case.get("plate", {}).items():
                true_rig = changed_plate(true_rig, name, value)
            return rig, measured_on_paper(true_rig, rng)
        case "sold":
            return measured_parts(seed, case.get("glue", {}))
        case "hidden":
            responses = measured_fault(FAULTS[case["fault"]], seed)
            return load_rig(example_rig_path()), responses
        case "weekend":
            return WEEKEND, measured_board(with_exciter_keys(case.get("eras", {})), seed)
    assert kind == "example"
    responses = measurement_of(read_measured(FOLDER / "measured.uff"), WEEKEND)
    step = len(responses.frequencies) // 12
    rows = np.flatnonzero(responses.frequencies < 400)[::step]
    frequencies, values = responses.frequencies[rows], responses.values[rows]
    return WEEKEND, replace(responses, frequencies=frequencies, values=values)


def with_glitches(measurement: Measurement, share: float) -> Measurement:
    """A share of the values wrong by a large factor or in sign."""
    rng = np.random.default_rng(0)
    values = measurement.values.swapaxes(1, 2).copy()  # (f, eras, s)
    is_wrong = rng.random(values.shape) < share
    values[is_wrong] *= rng.choice([0.1, 4.0, -1.0], is_wrong.sum())
    return replace(measurement, values=values.swapaxes(1, 2))


def with_faults(case: Mapping[str, Any], rig: Rig, measurement: Measurement) -> Measurement:
    """A measurement with the faults of a scenario in wiring, sensors and notes."""
    eras, sensors = [era.name for era in rig.eras], [*measurement.names]
    plugs, places = case.get("plugs", {}), case.get("places", {})
    driven = [eras.index(plugs.get(name, name)) for name in eras]
    noted = [sensors.index(places.get(name, name)) for name in sensors]
    values = measurement.values[:, noted][..., driven]
    factors = dict(case.get("channels", {}))
    for name, degrees in case.get("turned", {}).items():
        factors[name] = np.exp(1j * np.radians(degrees))
    for name, factor in factors.items():
        values[..., eras.index(name)] *= factor
    for name, factor in case.get("sensors", {}).items():
        values[:, sensors.index(name)] *= factor
    for name in case.get("undriven", ()):
        values[..., eras.index(name)] = np.nan
    if "noise" in case:
        column, rng = eras.index(case["noise"]), np.random.default_rng(3)
        noise = noise_like(measurement.values.swapaxes(1, 2), 0.1, rng)
        values[..., column] = noise[:, column]
    if "loose_contact" in case:
        values[:8:2, sensors.index(case["loose_contact"])] *= -1
    if case.get("without_phases"):
        phases = np.random.default_rng(5).uniform(0, 6, values.shape[::2])
        values = values * np.exp(1j * phases[:, None])
        measurement = replace(measurement, has_phases=False)
    axes = case.get("mirrored", ())
    if "frequency" in axes:
        values = values[::-1]
    sides = np.array([rig.plate.length, rig.plate.width])
    is_mirrored = ["x" in axes, "y" in axes]
    points = np.where(is_mirrored, sides - measurement.points, measurement.points)
    faulty = replace(measurement, values=values).moved(points)
    return with_glitches(faulty, case["glitches"]) if "glitches" in case else faulty


def checked_rig(case: Mapping[str, Any], rig: Rig) -> Rig:
    """The rig of a scenario with the mistakes of its file."""
    match case.get("rig", {}):
        case {"gain": gain}:
            return with_eras(rig, lambda era: replace(era, gains=((200.0, gain, 0.0),)))
        case {"stroke of SE": factor}:
            southwest, southeast, *others = rig.eras
            southeast = replace(southeast, stroke=factor * southwest.stroke)
            return replace(rig, eras=(southwest, southeast, *others))
        case {"eras": keys}:
            return with_exciter_keys(keys)
        case {"plate": keys}:
            return change_rig(rig, plate=keys)
    return rig


def planted(case: Mapping[str, Any]) -> tuple[Rig, Measurement]:
    """The rig that is checked, and a measurement with all faults of a scenario."""
    rig, measurement = board_of(case)
    return checked_rig(case, rig), with_faults(case, rig, measurement)


@pytest.fixture(autouse=True, scope="module")
def plates_solved_once():
    """Share the free plates of hypotheses among the tests."""
    solved = {}

    def solve(rig, sensors, frequencies):
        key = (rig.plate, rig.mesh, sensors, frequencies.tobytes())
        if key not in solved:
            solved[key] = sensed_plate(rig, sensors, frequencies)
        return solved[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hypotheses, "sensed_plate", solve)
        yield


SCENARIOS: dict[str, dict[str, Any]] = {
    case["planted"].replace(" ", "-").replace(",", ""): case
    for case in read_yaml(Path(__file__).with_name("scenarios.yaml"))
}
SHORT_SCENARIOS = [name for name, case in SCENARIOS.items() if not case.get("long")]


def hidden_masses(case: Mapping[str, Any]) -> list[list[float]]:
    """Position [m] and mass [kg] of each mass on a hidden plate."""
    seed, fault = int(case["board"].split()[1]), FAULTS[case["fault"]]
    if not fault.mass:
        return draw(fault.kind, seed).mounted.masses.tolist()
    shares = np.random.default_rng([seed, 93]).uniform(0.1, 0.9, 2)
    return [[*(shares * [0.3048, 0.2286]), fault.mass]]


def assert_masses_are_found(report: Mapping[str, Any], masses: list[list[float]]) -> None:
    """Compare the masses of a report, in any order: within 1.5 cm and 1.5 g."""
    loads = {(load["x_m"], load["y_m"]): load for load in report["plate"]["beyond"]["loads"]}
    assert len(loads) == len(masses), report["plate"]["beyond"]
    for *position, mass in masses:
        distances = {math.dist(position, found): found for found in loads}
        nearest = distances[min(distances)]
        assert nearest == pytest.approx(tuple(position), abs=0.015)
        assert loads[nearest]["mass_kg"] == pytest.approx(mass, abs=1.5e-3)


@pytest.mark.parametrize("name", shortly(SCENARIOS, SHORT_SCENARIOS))
def test_check_finds_planted_faults_and_nothing_else(name: str) -> None:
    """Kinds and names in order, values, and the same in the report for programs."""
    case = SCENARIOS[name]
    rig, measurement = planted(case)
    is_hidden = "fault" in case

    verdict = diagnose(rig, measurement, has_form=is_hidden)
    if is_hidden:
        verdict = judged_by_promises(verdict, rig)
    report = json.loads(json.dumps(as_json(verdict)))

    findings = [{finding.kind: finding.of} for finding in verdict.findings]
    if not any("outliers" in finding for finding in case["finds"]):
        findings = [finding for finding in findings if "outliers" not in finding]
    assert findings == case["finds"]
    assert verdict.is_well == case.get("well", not case["finds"])
    for finding, value in zip(verdict.findings, case.get("values", ()), strict=False):
        assert finding.value == pytest.approx(value, rel=0.12, abs=1e-6), finding
    for finding in verdict.of_kinds("swapped", "cycle"):
        assert finding.confidence > 0.95, finding
    if "explains" in case:
        hypothesis = verdict.hypotheses[0]
        assert hypothesis.value == pytest.approx(case["explains"], rel=0.12)
        assert hypothesis.share > 0.5
    assert report["all_well"] == verdict.is_well
    assert report["findings"] == verdict_rows(verdict)
    assert len(channel_table(verdict)) == len(report["channels"]) + 1 == len(rig.eras) + 1
    for path, expected in case.get("json", {}).items():
        entry = report
        for key in path.split("."):
            entry = entry[key]
        assert entry == expected, path
    if case.get("placed"):
        assert_masses_are_found(report, hidden_masses(case))


# Mistakes of a file, found before anything is fitted


@pytest.mark.parametrize("count", shortly([2, 10], [2]))
@pytest.mark.parametrize(
    ("true_rig", "rig", "message"),
    [
        (
            with_resonance("free"),
            with_resonance("mounted"),
            r"^resonance_is of NE, NW, SW, SE must be free, got mounted: .* at 60 Hz",
        ),
        pytest.param(
            with_resonance("mounted"),
            with_resonance("free"),
            r"^resonance_is of NE, NW, SW, SE must be mounted, got free: .* at 306 Hz",
            marks=pytest.mark.long,
        ),
        pytest.param(
            CUT_ACROSS,
            WEEKEND,
            r"^plate\.grain must be width, got length: ",
            marks=pytest.mark.long,  # `test_command_writes_no_rig_for_a_board_cut_the_other_way`
        ),
    ],
    ids=["free", "mounted", "cut the other way"],
)
def test_misread_key_is_named_before_anything_is_fitted(
    true_rig: Rig, rig: Rig, message: str, count: int
) -> None:
    """306 Hz of a coil of 1.29 g are 306 sqrt(1.29 / 33.5) = 60 Hz of a magnet.

    Boards that match their file pass. All boards have tolerances, and half of them are measured at
    four of the twelve positions.
    """
    for seed in range(count):
        with pytest.raises(InputError, match=message):
            check_consistency(rig, measured_board(true_rig, seed))
        check_meaning(WEEKEND, measured_board(WEEKEND, 2 * count - seed))


@pytest.mark.long
def test_parts_far_from_their_file_are_rejected_with_the_bound() -> None:
    """60 Hz of the magnet, stated for its coil, are 12 Hz: from 91 Hz on both move alike.

    Foam below the board is ten times softer than the rubber of another file, or more.
    """
    responses = measured_board(with_resonance("free"), 1)
    text = (FOLDER / "rig.yaml").read_text(encoding="utf-8")
    on_rubber = parse_rig("rig.yaml", text.replace("foam", "rubber"))

    with pytest.raises(InputError, match=r"^stiffness of .* 10 times it.* resonance_is"):
        calibrate(with_resonance("free", 60.0), responses)
    with pytest.raises(InputError, match=r"^stiffness of feet .* 0\.1 times it"):
        calibrate(on_rubber, responses)


@dataclass(frozen=True)
class Files:
    """Paths of a rig, its measurement and the rig that a command would write."""

    rig: Path
    measured: Path
    output: Path

    def run(self, command: str) -> int:
        """Run a command in which names in capitals are paths."""
        paths = {"RIG": self.rig, "MEASURED": self.measured, "OUTPUT": self.output}
        words = [str(paths.get(word, word)) for word in command.split()]
        return run_era(words)


@pytest.fixture
def files(tmp_path: Path) -> Files:
    """The rig of the page in a folder of its own."""
    rig = Path(shutil.copy(FOLDER / "rig.yaml", tmp_path))
    return Files(rig, tmp_path / "measured.uff", tmp_path / "output.yaml")


@pytest.mark.parametrize(
    ("command", "status"),
    [
        ("rig identify RIG --yes --device card --sensors MEASURED -o OUTPUT", 1),
        pytest.param("calibrate RIG MEASURED -o OUTPUT", 2, marks=pytest.mark.long),
        pytest.param("rig identify RIG --measured MEASURED -o OUTPUT", 2, marks=pytest.mark.long),
        pytest.param("rig check RIG --measured MEASURED", 1, marks=pytest.mark.long),
    ],
)
def test_command_writes_no_rig_for_a_board_cut_the_other_way(
    command: str,
    status: int,
    files: Files,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The message names the key, for a file and through a sound card."""
    responses = measured_board(CUT_ACROSS, 1)
    measured_plate = MeasuredPlate(responses, None, None, (), (), {})
    monkeypatch.setattr(measure, "measure_plate", lambda *_, **__: measured_plate)
    write_responses(files.measured, responses, WEEKEND)

    assert files.run(command) == status

    streams = capsys.readouterr()
    assert "plate.grain must be width, got length" in streams.out + streams.err
    assert not files.output.exists()


def test_calibrate_writes_no_rig_for_a_dead_exciter(
    files: Files, capsys: pytest.CaptureFixture[str]
) -> None:
    """A fitted rig would claim that it moves the plate; the message says which command to run."""
    responses = measured_board(with_resonance("free"), 1)
    responses.values[..., 2] *= 1e-4
    write_responses(files.measured, responses, WEEKEND)

    assert files.run("calibrate RIG MEASURED -o OUTPUT") == 1

    streams = capsys.readouterr()
    output = streams.out + streams.err
    assert "SW did not; no rig is written. Find the cause with era rig check" in output
    assert "Next:" not in output
    assert not files.output.exists()


def test_check_fails_for_a_plate_that_misses_its_promises(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """10 % thinner with all else as written: within tolerances, but fewer than half are kept."""
    path, file = write_rig(tmp_path / "rig.yaml", mesh="12x9"), tmp_path / "measured.csv"
    rig = load_rig(path)
    thinner_plate = replace(rig.plate, thickness=0.9 * rig.plate.thickness)
    thinner = replace(rig, plate=thinner_plate)
    write_responses_csv(file, plates.measured(thinner, frequencies=PAPER_FREQUENCIES), rig)

    assert run_era(["rig", "check", str(path), "--measured", str(file), "--json"]) == 1

    report = json.loads(capsys.readouterr().out)
    assert report["plate"]["matches"]
    assert report["plate"]["kept_share"] < 0.5
    assert any(row.startswith("PROMISE: ") for row in report["findings"])


# Distorted and insufficient measurements


# tests/errors provokes the errors of the other distortions.
@pytest.mark.parametrize(
    ("name", "cause"),
    [
        ("velocity", "velocity in m/s"),
        pytest.param("displacement", "displacement in m", marks=pytest.mark.long),
        pytest.param("opposite", "SW, SE, NE and NW", marks=pytest.mark.long),
        ("two_sensors", "got 2"),
    ],
)
def test_distorted_responses_are_rejected_with_their_cause(name: str, cause: str) -> None:
    """Of a plate within a builder's tolerances."""
    true_rig = perturbed(PAPER, frequencies=FREQUENCIES)
    responses = plates.measured(true_rig, frequencies=FREQUENCIES)

    with pytest.raises(InputError, match=cause):
        check_consistency(PAPER, DISTORTIONS[name](responses))


@pytest.mark.long
def test_plate_of_another_length_is_rejected_with_its_length(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A plate that is a fifth longer than the rig's, sensors where they are said to be.

    With few sizes and causes; whole searches are tested with diagnoses.
    """
    monkeypatch.setattr(hypotheses, "SIZE_FACTORS", (0.82, 1.21))
    monkeypatch.setattr(hypotheses, "FITTED_HYPOTHESES", 3)
    monkeypatch.setattr(hypotheses, "REFINED_HYPOTHESES", 1)
    true_rig = perturbed(with_sides(PAPER, 1.2, 1.0), frequencies=FREQUENCIES)

    with pytest.raises(InputError, match=r"plate\.length"):
        check_consistency(PAPER, plates.measured(true_rig, frequencies=FREQUENCIES))


@pytest.mark.parametrize(
    ("loss", "stiffness", "loss_tolerance", "stiffness_tolerance"),
    [(1.6, 0.8, 0.15, 0.03), (1.0, 1.0, 0.05, 0.05)],
    ids=["changed", "nominal"],
)
def test_verdict_states_loss_and_stiffness_of_the_plate(
    loss: float, stiffness: float, loss_tolerance: float, stiffness_tolerance: float
) -> None:
    """60 % more loss and 20 % less stiffness are both named, and the wiring is fine.

    The rig's own plate has no change of more than 5 %, and keeps more than 90 % of its promises.
    """
    true_rig = changed_plate(changed_plate(PAPER, "loss", loss), "stiffness", stiffness)
    responses = plates.measured(true_rig, frequencies=FREQUENCIES, noise=0.005)

    verdict = judged_by_promises(diagnose(PAPER, responses), PAPER)
    report = as_json(verdict)

    assert report["wiring_matches"]
    changes = report["plate"]["changes"]
    assert changes["loss_factor"] == pytest.approx(loss - 1, abs=loss_tolerance)
    assert changes["stiffness"] == pytest.approx(stiffness - 1, abs=stiffness_tolerance)
    if loss == 1:
        assert verdict.is_well
        np.testing.assert_allclose([*verdict.changes.values()], 0, atol=0.05)
        assert (verdict.kept_share or 0) > 0.9


@pytest.fixture(scope="module")
def responses(coarse_rig: Rig) -> Measurement:
    """Responses of one plate within tolerance."""
    rng = np.random.default_rng(7)
    return measured_on_paper(within_tolerance(coarse_rig, rng), rng)


def test_mirrored_positions_on_a_symmetric_plate_can_be_exchanged_channels(
    coarse_rig: Rig, responses: Measurement
) -> None:
    """At the paper's corners: a calibration states both causes, a check the exchanged plugs."""
    x, y = responses.points.T
    mirrored = responses.moved(np.column_stack([coarse_rig.plate.length - x, y]))

    verdict = diagnose(coarse_rig, mirrored)

    findings = [(finding.kind, finding.of) for finding in verdict.findings]
    assert findings == [("swapped", "SW, SE"), ("swapped", "NE, NW")]
    with pytest.raises(InputError, match=r"mirrored in x.*channels"):
        check_consistency(coarse_rig, mirrored)


def test_diagnose_rejects_too_few_sensors_or_frequencies(
    coarse_rig: Rig, responses: Measurement
) -> None:
    """Two sensors, three frequencies, or no channel at all."""
    frequencies, values = responses.frequencies[:3], responses.values[:3]
    undriven = np.full_like(responses.values, np.nan)

    with pytest.raises(InputError, match=r"at least 3 sensors .* got 2"):
        diagnose(coarse_rig, DISTORTIONS["two_sensors"](responses))
    with pytest.raises(InputError, match="got 3"):
        diagnose(coarse_rig, replace(responses, frequencies=frequencies, values=values))
    with pytest.raises(InputError, match="driven"):
        diagnose(coarse_rig, replace(responses, values=undriven))
