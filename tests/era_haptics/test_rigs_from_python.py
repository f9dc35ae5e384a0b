"""Rigs made, changed, written and read back from Python, and errors that name an argument."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import era_haptics as era
from kit.plates import small_table
from model.reduction.free_plate import solve_free_plate
from model.rig.rig_writing import change_rig

EXAMPLES = Path(__file__).parents[2] / "examples"
SHEET = era.Plate(length="12 in", width="9 in", thickness="1.5 mm", material="aluminium")
CORNERS = {"SW": (0, 0), "SE": ("12 in", 0), "NE": ("12 in", "9 in"), "NW": (0, "9 in")}


def springs(**keys: object) -> dict[str, era.Era]:
    """Return ERAs of 17 kN/m at the corners."""
    return {name: era.Era(at=at, stiffness="17 kN/m", **keys) for name, at in CORNERS.items()}


RIG = era.rig(SHEET, springs())
WITH_MODES = era.rig({**SHEET, "modes": [(1.02, 1.1)]}, springs())


def critical_damping(
    thickness: float, stiffness: float, eras: int, length: float = 0.3048
) -> float:
    """Return 2 sqrt(k m / n) of an aluminium plate 9 in wide on n ERAs."""
    mass = 2700 * thickness * length * 0.2286
    return 2 * math.sqrt(stiffness * mass / eras)


# Making and saving

RIG_FILES = []
for path in sorted((*EXAMPLES.glob("*.yaml"), EXAMPLES / "desk" / "rig.yaml")):
    if "plate" in yaml.safe_load(path.read_text("utf-8")):
        RIG_FILES.append(path)


@pytest.mark.parametrize("path", RIG_FILES, ids=lambda path: path.stem)
def test_rig_by_its_keys_is_that_of_the_file_and_reads_back(path: Path, tmp_path: Path) -> None:
    """Every example by PyYAML's reading of it; written from Python, and the file's own text."""
    data = yaml.safe_load(path.read_text("utf-8"))
    eras = {name: era.Era(**keys) for name, keys in data.pop("eras").items()}
    plate = era.Plate(**data.pop("plate"))
    copy = tmp_path / "rig.yaml"

    by_keys = era.rig(plate, eras, **data)
    by_file = era.load_rig(path)

    assert by_keys == by_file
    era.save_rig(by_keys, copy)
    assert era.load_rig(copy) == by_keys
    era.save_rig(by_file, copy)
    assert copy.read_text("utf-8") == path.read_text("utf-8")


def test_rig_from_keys_has_its_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Progress is reported in steps."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    steps: list[tuple[int, int]] = []

    table = era.table(RIG, frequencies=[60], progress=lambda *step: steps.append(step))

    assert table.fingerprint == RIG.fingerprint
    assert steps == [(1, 2), (2, 2)]


def test_calibrated_rig_is_saved_and_changed(tmp_path: Path) -> None:
    """With the values that a calibration has changed."""
    material = replace(RIG.plate.material, E=72.5e9)
    plate = replace(RIG.plate, material=material)
    calibrated = replace(RIG, plate=plate, uncertainty=era.Uncertainty(thickness=0.002))

    era.save_rig(calibrated, tmp_path / "rig.yaml")

    read = era.load_rig(tmp_path / "rig.yaml")
    assert read.plate == plate
    assert read.uncertainty == calibrated.uncertainty
    assert read.eras[0].damping == pytest.approx(RIG.eras[0].damping, rel=1e-5)
    assert change_rig(calibrated, thickness=0.002).plate == replace(plate, thickness=0.002)


# Changing


def lowest_elastic(rig: era.Rig, mesh_of: era.Rig) -> np.ndarray:
    """Return the lowest ten elastic frequencies [rad/s] of a free plate, on the mesh of a rig."""
    free = solve_free_plate(rig.plate, mesh_of.mesh, frequency_max=500)
    return np.sqrt(np.sort(free.modes.eigenvalues)[3:13])


def test_thickness_changes_damping_mesh_and_frequencies() -> None:
    """c = 2 zeta sqrt(k m / n) by hand; a thin free plate's frequencies are proportional to h.

    Shear and rotary inertia lower those of 1 mm by 0.1 % more than those of 0.5 mm.
    """
    thin = change_rig(RIG, thickness="0.5 mm")
    thick = change_rig(RIG, thickness=0.001)

    assert thin.mesh != thick.mesh
    damping = 0.05 * critical_damping(0.001, 17e3, 4)
    assert thick.eras[0].damping == pytest.approx(damping)
    ratios = lowest_elastic(thick, thin) / lowest_elastic(thin, thin)
    np.testing.assert_allclose(ratios, 2, rtol=2e-3)


def test_positions_keep_their_share_of_the_plates_sides() -> None:
    """Corners remain corners, for ERAs and masses; positions that are stated are kept."""
    camera = {"at": (0.1, 0.05), "mass": 0.01}
    rig = era.rig(SHEET, springs(), masses={"camera": camera})

    wider = change_rig(rig, length=0.4, width=np.float32(0.3))

    corners = [(corner.x, corner.y) for corner in wider.eras]
    np.testing.assert_allclose(corners, [(0, 0), (0.4, 0), (0.4, 0.3), (0, 0.3)], atol=1e-6)
    (mass,) = wider.masses
    assert mass.x == pytest.approx(0.1 * 0.4 / 0.3048)
    assert mass.y == pytest.approx(0.05 * 0.3 / 0.2286)
    assert change_rig(wider, length="12 in", width="9 in").eras == rig.eras
    assert change_rig(rig, length=0.4, eras=springs()).eras[1].x == 0.3048


def test_keys_of_the_plate_and_of_single_eras_are_changed() -> None:
    """The damping follows the stiffness; an ERA is removed; others stay."""
    changed = change_rig(
        RIG, plate={"thickness": "2 mm"}, length=0.4, eras={"SW": {"stiffness": 2e4}, "NW": None}
    )

    first, *unchanged = changed.eras
    assert changed.plate.thickness == 0.002
    assert (first.name, first.x, first.stiffness) == ("SW", 0, 2e4)
    damping = 0.05 * critical_damping(0.002, 2e4, 3, length=0.4)
    assert first.damping == pytest.approx(damping)
    assert [corner.name for corner in unchanged] == ["SE", "NE"]
    assert [corner.x for corner in unchanged] == pytest.approx([0.4, 0.4])
    assert [corner.stiffness for corner in unchanged] == [17e3, 17e3]


def test_deviations_of_modes_are_kept_if_the_modes_do_not_change() -> None:
    """Or are removed by None."""
    without = change_rig(WITH_MODES, thickness="2 mm", modes=None)
    damped = change_rig(WITH_MODES, loss_factor=0.02)

    assert without.plate.mode_deviations == ()
    assert damped.plate.mode_deviations == WITH_MODES.plate.mode_deviations != ()


# Errors

UNKNOWN = (
    "length: must be above 0",
    "widht: unknown key",
)
NO_MAPPINGS = ("plate: must be a map", "eras: must be a map")
ERRORS: dict[str, tuple[Callable[[], object], tuple[str, ...]]] = {
    "plate": (lambda: era.Plate(length=-1, widht=2), UNKNOWN),
    "era": (lambda: era.Era(at=(0, 0)), ("era.Era: stiffness: missing",)),
    "plate that is a number": (lambda: era.rig(3, 4, amplifiers=5), NO_MAPPINGS),
    "eras that are a number": (lambda: era.rig(SHEET, 4), ("eras must be a Mapping, got 4",)),
    "era that is a number": (lambda: era.rig(SHEET, {"SW": 4}), ("eras.SW: must be a map",)),
    "file": (lambda: era.save_rig(RIG, "rig.txt"), ("must end in .yaml",)),
}
"""Calls, and what their errors contain."""


@pytest.mark.parametrize("name", ERRORS)
def test_errors_name_all_wrong_keys(name: str) -> None:
    """Without the line of a file, since there is none."""
    call, sentences = ERRORS[name]

    with pytest.raises(era.InputError) as error:
        call()

    for sentence in sentences:
        assert sentence in str(error.value)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"thicknes": 1}, "plate.thicknes: unknown key; did you mean"),
        ({"plate": {"thicknes": 1}}, "plate.thicknes: unknown key"),
        ({"plate": 3, "length": 2}, "plate must be a Mapping, got 3"),
        ({"eras": {"SW": 3}, "length": 2}, "eras.SW: must be a map"),
        ({"length": "2 kg"}, "plate.length: '2 kg' is not a length"),
        ({"mesh": "2x2"}, "change_rig: mesh: 2x2 is too coarse"),
    ],
    ids=str,
)
def test_change_is_refused_by_its_key(changes: dict[str, object], sentence: str) -> None:
    """As in a file."""
    with pytest.raises(era.InputError) as error:
        change_rig(RIG, **changes)

    assert sentence in str(error.value)


def test_change_of_the_modes_needs_their_deviations() -> None:
    """Which were identified on the original plate."""
    with pytest.raises(era.InputError, match=r"plate\.modes must be given"):
        change_rig(WITH_MODES, thickness="2 mm")


@pytest.mark.parametrize("field", ["fingertip", "document"])
def test_rig_that_differs_from_its_keys_is_not_saved(field: str) -> None:
    """Without the fingertip of its keys, or without its keys, it is another rig."""
    with pytest.raises(era.InputError, match="rig must"):
        era.save_rig(replace(RIG, **{field: None}), "rig.yaml")


@pytest.fixture(scope="module")
def plate() -> era.SolvedPlate:
    """The example's plate on the paper's mesh."""
    return era.SolvedPlate(era.load_rig(era.example_rig_path(), mesh="12x9"))


@pytest.fixture(scope="module")
def answer() -> era.Answer:
    """An answer for a finger."""
    return era.query(small_table(), (0.08, 0.06))


def test_playback_needs_the_target_of_a_drive(plate: era.SolvedPlate, answer: era.Answer) -> None:
    """Drives have no fingers; those of an answer have their own loads and quiet fingers."""
    with pytest.raises(era.InputError, match="target must be"):
        plate.play({"SW": 110})
    with pytest.raises(era.InputError, match="target must be"):
        plate.play(answer, quiet=[(0.15, 0.11)])
    with pytest.raises(era.InputError, match="target must be"):
        plate.play(answer, loads=[1])


def test_answer_without_a_layer_has_no_map(plate: era.SolvedPlate, answer: era.Answer) -> None:
    """Silence is not drawn."""
    silent = replace(answer, contents=replace(answer.contents, streams=()))

    with pytest.raises(era.InputError, match="must have a layer"):
        plate.map(silent)
