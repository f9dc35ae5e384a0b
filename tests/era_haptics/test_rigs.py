"""Rigs made in Python: as those of files, changed with what follows, written and read back."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import era_haptics as era
from model.reduction.free_plate import solve_free_plate

EXAMPLES = Path(__file__).parents[2] / "examples"
FILES = sorted(
    path
    for path in (*EXAMPLES.glob("*.yaml"), EXAMPLES / "desk" / "rig.yaml")
    if "plate" in yaml.safe_load(path.read_text("utf-8"))
)
CORNERS = {"SW": (0, 0), "SE": ("12 in", 0), "NE": ("12 in", "9 in"), "NW": (0, "9 in")}
SHEET = era.Plate(length="12 in", width="9 in", thickness="1.5 mm", material="aluminium")
SPRINGS = {
    name: era.Era(at=at, stiffness="17 kN/m", amplifier="main", channel=number)
    for number, (name, at) in enumerate(CORNERS.items())
}
MAIN = {"main": {"url": "sim://"}}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_rig_by_its_keys_is_that_of_the_file_and_reads_back(path: Path, tmp_path: Path) -> None:
    """Every example by PyYAML's reading of it; written from Python, and the file's own text."""
    data = yaml.safe_load(path.read_text("utf-8"))
    eras = {name: era.Era(**each) for name, each in data.pop("eras").items()}
    made = era.rig(era.Plate(**data.pop("plate")), eras, **data)
    read = era.load_rig(path)
    assert made == read
    for rig in (made, read):
        era.save_rig(rig, tmp_path / "rig.yaml")
        assert era.load_rig(tmp_path / "rig.yaml") == made
    assert (tmp_path / "rig.yaml").read_text("utf-8") == path.read_text("utf-8")


def test_rig_with_defaults_is_the_papers_and_has_its_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without damping, loss factor and stroke, which the example states as they are by default."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    rig = era.rig(SHEET, SPRINGS, amplifiers=MAIN)
    assert rig == era.load_rig(EXAMPLES / "paper_plate.yaml")
    bare = {name: era.Era(at=each["at"], stiffness=17e3) for name, each in SPRINGS.items()}
    assert era.rig(SHEET, bare) == rig  # a simulated amplifier, channels in order
    steps: list[tuple[int, int]] = []
    table = era.table(rig, frequencies=[60], progress=lambda *done: steps.append(done))
    assert (table.fingerprint, steps) == (rig.fingerprint, [(1, 2), (2, 2)])


def test_thickness_takes_the_damping_the_mesh_and_the_frequencies_with_it() -> None:
    """c = 2 zeta sqrt(k m / n) by hand; a thin free plate's elastic frequencies go with h.

    Shear and rotary inertia lower those of 1 mm by 0.1 % more than those of 0.5 mm.
    """
    rig = era.rig(SHEET, SPRINGS, amplifiers=MAIN)
    thin, thick = (rig.replaced(thickness=each) for each in ("0.5 mm", 0.001))
    assert thin.mesh != thick.mesh
    mass = 2700 * 0.001 * 0.3048 * 0.2286
    assert thick.eras[0].damping == pytest.approx(2 * 0.05 * math.sqrt(17e3 * mass / 4))
    low, high = (
        np.sort(solve_free_plate(each.plate, thin.mesh, frequency_max=500).modes.eigenvalues)[3:13]
        for each in (thin, thick)
    )
    assert np.sqrt(high / low) == pytest.approx(2, rel=2e-3)


def test_places_keep_their_share_of_the_plates_sides() -> None:
    """Corners stay corners, of ERAs and masses; those given beside sides are taken as given."""
    rig = era.rig(
        SHEET, SPRINGS, amplifiers=MAIN, masses={"camera": {"at": (0.1, 0.05), "mass": 0.01}}
    )
    wider = rig.replaced(length=0.4, width=np.float32(0.3))
    assert np.allclose(
        [(each.x, each.y) for each in wider.eras], [(0, 0), (0.4, 0), (0.4, 0.3), (0, 0.3)]
    )
    camera = wider.masses[0]
    assert (camera.x, camera.y) == pytest.approx((0.1 * 0.4 / 0.3048, 0.05 * 0.3 / 0.2286))
    assert wider.replaced(length="12 in", width="9 in").eras == rig.eras
    assert rig.replaced(length=0.4, eras=SPRINGS).eras[1].x == 0.3048


def test_keys_of_the_plate_and_of_single_eras_are_changed_alone() -> None:
    """The damping goes with the stiffness; an ERA is added, another left out; others stay."""
    changed = RIG.replaced(
        plate={"thickness": "2 mm"}, length=0.4, eras={"SW": {"stiffness": 2e4}, "NW": None}
    )
    assert changed.plate.thickness == 0.002
    assert [(each.name, each.x, each.stiffness) for each in changed.eras] == [
        ("SW", 0, 2e4), ("SE", pytest.approx(0.4), 17e3), ("NE", pytest.approx(0.4), 17e3)
    ]  # fmt: skip
    mass = 2700 * 0.002 * 0.4 * 0.2286
    assert changed.eras[0].damping == pytest.approx(2 * 0.05 * math.sqrt(2e4 * mass / 3))
    assert changed.replaced(eras={"NW": SPRINGS["NW"]}).eras[3].stiffness == 17e3
    assert RIG.replaced(fingertip=None) == RIG
    assert RIG.replaced(fingertip="none").fingertip is None


def test_keys_that_cannot_follow_are_refused() -> None:
    """Deviations of modes were identified on the plate before; None leaves a key out."""
    rig = era.rig({**SHEET, "modes": [(1.02, 1.1)]}, SPRINGS, amplifiers=MAIN)
    with pytest.raises(era.InputError, match=r"plate\.modes must be given"):
        rig.replaced(thickness="2 mm")
    assert rig.replaced(thickness="2 mm", modes=None).plate.mode_deviations == ()
    assert rig.replaced(loss_factor=0.02).plate.mode_deviations != ()


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: era.Plate(length=-1, widht=2), ["length: must be above 0", "widht: unknown key"]),
        (lambda: era.Era(at=(0, 0)), ["era.Era: stiffness: missing"]),
        (lambda: era.rig(SHEET, SPRINGS, amplifiers={}), ["eras.SW.amplifier: unknown"]),
        (lambda: era.rig(3, 4, amplifiers=5), ["plate: must be a map", "eras: must be a map"]),
        (lambda: RIG.replaced(thicknes=1), ["plate.thicknes: unknown key; did you mean thickness"]),
        (lambda: RIG.replaced(plate={"thicknes": 1}), ["plate.thicknes: unknown key"]),
        (lambda: RIG.replaced(plate=3, length=2), ["plate must be a Mapping, got 3"]),
        (lambda: RIG.replaced(eras={"SW": 3}, length=2), ["eras.SW: must be a map"]),
        (lambda: era.rig(SHEET, 4), ["eras must be a Mapping, got 4"]),
        (lambda: era.rig(SHEET, {"SW": 4}), ["eras.SW: must be a map"]),
        (lambda: RIG.replaced(length="2 kg"), ["plate.length: '2 kg' is not a length"]),
        (lambda: RIG.replaced(mesh="2x2"), ["rig.replaced: mesh: 2x2 is too coarse"]),
        (lambda: era.save_rig(RIG, "rig.txt"), ["must end in .yaml"]),
    ],
)  # fmt: skip
def test_errors_name_the_argument_as_a_file_its_key(make, named: list[str]) -> None:
    """All at once, without the line of a file that there is not."""
    with pytest.raises(era.InputError) as refused:
        make()
    assert all(each in str(refused.value) for each in named)


RIG = era.rig(SHEET, SPRINGS, amplifiers=MAIN)


def test_fitted_rig_is_saved_and_changed_but_not_another(tmp_path: Path) -> None:
    """Of values that a calibration changes; without the finger of its keys a rig is another one."""
    plate = replace(RIG.plate, material=replace(RIG.plate.material, E=72.5e9))
    fitted = replace(RIG, plate=plate, uncertainty=era.Uncertainty(thickness=0.002))
    era.save_rig(fitted, tmp_path / "rig.yaml")
    back = era.load_rig(tmp_path / "rig.yaml")
    assert (back.plate, back.uncertainty) == (plate, fitted.uncertainty)
    assert back.eras[0].damping == pytest.approx(RIG.eras[0].damping, rel=1e-5)
    assert fitted.replaced(thickness=0.002).plate == replace(plate, thickness=0.002)
    for other in (replace(RIG, fingertip=None), replace(RIG, document=None)):
        with pytest.raises(era.InputError, match="rig must"):
            era.save_rig(other, tmp_path / "rig.yaml")
