"""Surfaces by their modes: the paper's plate through its own, odd files, cut-outs and curvature."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from benchmarks.promise.contents import share_kept
from benchmarks.setting import random_contacts
from benchmarks.surface import exported_modes
from cases import read_yaml
from controller.effects.kinds import Click
from controller.effects.layout import SurfaceLayout
from controller.sources.contact_tracker import ContactTracker
from controller.sources.touch import Touch, TouchFrame
from era_haptics.command import run_era
from era_haptics.lab.checks import layout_check
from era_haptics.lab.checks.layout_check import check_layout
from era_haptics.lab.design.problem import area_of
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus, check_on_plate
from model.arrays import FloatArray
from model.errors import InputError
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import load_rig, parse_rig
from model.rig.rig_writing import save_rig
from model.structure.statics import GRAVITY, center_of_mass, rigid_body_frequencies, static_loads
from model.structure.surface import is_within, rings_of
from model.study.exact_plates import amplitudes_on, draw_plates
from model.study.verification import verify_table
from model.study.weak_cells import map_grid, mirror_images, pair_questions
from model.table.table import LocalizationTable
from model.table.table_file import build_table, load_table, save_table
from sim.plant.imperfections import draw_of_ensemble

ERAS = """
eras:
  SW: {at: [0, 0], stiffness: 17000, amplifier: main, channel: 0}
  SE: {at: [0.3048, 0], stiffness: 17000, amplifier: main, channel: 1}
  NE: {at: [0.3048, 0.2286], stiffness: 17000, amplifier: main, channel: 2}
  NW: {at: [0, 0.2286], stiffness: 17000, amplifier: main, channel: 3}
amplifiers: {main: {url: "sim://"}}
limits: {frequency: [40, 150]}
"""
PAPER = parse_rig(
    "plate.yaml",
    "plate: {length: 0.3048, width: 0.2286, thickness: 1.5 mm, material: aluminium}" + ERAS,
)
HIGHEST = 2000.0  # Hz; modes are exported up to it: by fewer, resonances on ERAs are off
ODD = read_yaml(Path(__file__).parent / "odd_modes.yaml")


@pytest.fixture(scope="module")
def own() -> LocalizationTable:
    """The table of the paper's plate up to 150 Hz, by its sizes and material."""
    return build_table(PAPER)


@pytest.fixture(scope="module")
def modes() -> Mapping[str, FloatArray]:
    """Its modes at 21 x 16 nodes as another program would export them, along z."""
    return exported_modes(PAPER, HIGHEST, (21, 16))


def _universal(modes: Mapping[str, FloatArray], *, kind: int, length: float) -> str:
    """A universal file of modes, datasets 55 or 2414, in a unit of length per meter."""
    rows = ["    -1", "   164", f"{1:10d}{'SI':<20}{2:10d}", f"{length:25.16E}{1.0:25.16E}"]
    rows += [f"{0.0:25.16E}", "    -1", "    -1", "  2411"]
    for number, node in enumerate(modes["nodes"], start=1):
        at = "".join(f"{length * each:25.16E}" for each in node)
        rows += [f"{number:10d}{1:10d}{1:10d}{11:10d}", at]  # as mesh programs number systems
    rows.append("    -1")
    types = "".join(f"{each:10d}" for each in (1, 2, 2, 8, 2, 3))
    for frequency, shape in zip(modes["frequencies"], modes["shapes"], strict=True):
        reals = [frequency, 1 / length, 0.005, 0.0]
        head = ["NONE"] * 5 + [types, f"{2:10d}{4:10d}{0:10d}{1:10d}"]
        if kind == 2414:
            head = [f"{1:10d}", "modes", f"{1:10d}", *head[:5], types, "0 0 0 0 0 1 0 0", "0 0"]
            reals = [0.0, frequency, 0.0, *reals[1:]]
        rows += ["    -1", f"{kind:6d}", *head, "".join(f"{each:13.5E}" for each in reals)]
        rows += [f"{0.0:13.5E}" * 6] if kind == 2414 else []
        for number, w in enumerate(shape, start=1):
            rows += [f"{number:10d}", f"{0.0:13.5E}{0.0:13.5E}{w:13.5E}"]
        rows.append("    -1")
    return "\n".join(["", *rows, ""])[1:]


def _write(folder: Path, modes: Mapping[str, Any], **further: Any) -> Path:
    """Write a rig of modes in a .npz, with further arrays."""
    np.savez(folder / "modes.npz", **(dict(modes) | further))
    rig = folder / "rig.yaml"
    rig.write_text("surface: modes.npz" + ERAS)
    return rig


def _difference(own: LocalizationTable, other: LocalizationTable) -> float:
    """Relative L2 error of the fields at cells by the worst ERA, mean over frequencies."""
    points = own.cell_centers
    first, second = own.unit_fields(points), other.unit_fields(points)
    size = np.linalg.norm(first, axis=-1)
    return float((np.linalg.norm(first - second, axis=-1) / size).max(axis=1).mean())


def _lines(modes: Mapping[str, FloatArray]) -> str:
    """The same as CSV, a line for each node of each mode."""
    values = [
        f"{number},{frequency:.9g},{x:.9g},{y:.9g},{z:.9g},0,0,{w:.9g}"
        for number, frequency in enumerate(modes["frequencies"])
        for (x, y, z), w in zip(modes["nodes"], modes["shapes"][number], strict=True)
    ]
    return "\n".join(["mode,frequency_hz,x_m,y_m,z_m,shape_x,shape_y,shape_z", *values, ""])


@pytest.mark.parametrize(("kind", "length"), [(55, 1.0), (2414, 1.0), (55, 1000.0), (0, 1.0)])
def test_plate_by_its_own_modes_has_the_fields_of_its_table(
    modes: Mapping[str, FloatArray],
    own: LocalizationTable,
    kind: int,
    length: float,
    tmp_path: Path,
) -> None:
    """Modes of another program give the fields of the plate that they are of, in m, mm and CSV.

    With its last line twice the file is refused with its line.
    """
    text = _universal(modes, kind=kind, length=length) if kind else _lines(modes)
    (tmp_path / (name := "modes.uff" if kind else "modes.csv")).write_text(text)
    (tmp_path / "rig.yaml").write_text(f"surface: {name}{ERAS}")
    rig = load_rig(tmp_path / "rig.yaml")
    assert rig.plate.mass == pytest.approx(own.plate.mass, rel=1e-3)
    assert _difference(own, build_table(rig)) < 0.04
    (tmp_path / name).write_text(text + text.splitlines()[-1] + "\n")
    with pytest.raises(InputError, match=rf"{name}:\d+: (modes must follow|dataset must begin)"):
        load_rig(tmp_path / "rig.yaml")


def test_surface_has_the_center_of_mass_of_its_modes(
    modes: Mapping[str, FloatArray], tmp_path: Path
) -> None:
    """Of the paper's plate with 50 g at a node, solved from its own modes; in the middle without.

    The modal masses with m at a node of shapes phi are I + m phi phi'.
    """
    mass, node = 0.05, 40
    at = modes["shapes"][:, node]
    eigenvalues = (2 * np.pi * modes["frequencies"]) ** 2
    loaded = np.eye(len(at)) + mass * np.outer(at, at)
    solved, vectors = scipy.linalg.eigh(np.diag(eigenvalues), loaded)
    frequencies = np.sqrt(solved.clip(0)) / (2 * np.pi)
    rig = load_rig(
        _write(tmp_path, modes, frequencies=frequencies, shapes=vectors.T @ modes["shapes"])
    )
    whole = PAPER.plate.mass + mass
    middle = np.array([PAPER.plate.length, PAPER.plate.width]) / 2
    expected = (PAPER.plate.mass * middle + mass * modes["nodes"][node, :2]) / whole
    assert rig.plate.mass == pytest.approx(whole, rel=1e-3)
    assert center_of_mass(rig.plate) == pytest.approx(expected, abs=1e-5)
    assert GRAVITY * whole == pytest.approx(static_loads(rig.plate, rig.eras).sum(), rel=1e-3)
    moments = static_loads(rig.plate, rig.eras) @ [(era.x, era.y) for era in rig.eras]
    assert moments / (GRAVITY * whole) == pytest.approx(expected, rel=1e-3)
    # A uniform rectangle has the inertia m L² / 12 about its middle.
    sides = 2 * middle
    arms = np.array([[era.x, era.y] for era in rig.eras]) - middle
    arm = modes["nodes"][node, :2] - middle
    springs = np.array([era.stiffness for era in rig.eras])
    p = np.column_stack([np.ones(len(arms)), arms])
    node_p = np.array([1.0, *arm])
    inertia = PAPER.plate.mass * np.diag([1.0, *(sides**2 / 12)]) + mass * np.outer(node_p, node_p)
    bolts = np.array([era.support.mass for era in rig.eras])
    inertia += p.T @ (bolts[:, None] * p)
    squares = scipy.linalg.eigh(p.T @ (springs[:, None] * p), inertia, eigvals_only=True)
    rocking = rigid_body_frequencies(rig.plate, rig.eras)
    assert rocking == pytest.approx(np.sqrt(squares) / (2 * np.pi), rel=1e-3)
    plain = load_rig(_write(tmp_path, modes))
    assert center_of_mass(plain.plate) == pytest.approx(middle, abs=1e-5)


def test_few_modes_are_off_as_much_as_stated(
    modes: Mapping[str, FloatArray], own: LocalizationTable, tmp_path: Path
) -> None:
    """Fields by few modes are off by what the table says, which has those of the free surface."""
    tables = []
    for multiple in (1.7, 3.5):
        few = modes["frequencies"] < multiple * 150
        known = {name: modes[name][few] for name in ("frequencies", "shapes")}
        rig = load_rig(_write(tmp_path, modes, **known))
        tables.append(build_table(rig))
        assert all(check.is_passed for check in verify_table(tables[-1], rig, samples=1).content)
    stated = float(tables[-1].discretization_error.mean())
    assert 0.01 < stated < 0.3
    assert stated / 2 < _difference(own, tables[-1]) < 1.5 * stated


def test_table_of_a_surface_is_verified_and_read_again(
    modes: Mapping[str, FloatArray], tmp_path: Path
) -> None:
    """Fields, answers, promises and motion in time agree; table and rig need no other folder.

    The table of another surface is refused, which differs by any key or by its modes.
    """
    path = _write(tmp_path, modes)
    rig = load_rig(path)
    table = build_table(rig)
    assert verify_table(table, rig, samples=1).failed_count == 0
    save_table(table, tmp_path / "table.npz")
    (elsewhere := tmp_path / "elsewhere").mkdir()
    save_rig(rig, elsewhere / "rig.yaml")
    load_table(tmp_path / "table.npz", rig=load_rig(elsewhere / "rig.yaml"))
    for other in (
        "{modes: modes.npz, normal: -z}",
        "{modes: modes.npz, mass: 290 g}",
        "{modes: modes.npz, loss_factor: 0.02}",
        "{modes: modes.npz, outline: [[[0, 0], [0.31, 0], [0.31, 0.23], [0, 0.23]]]}",
        "louder.npz",
    ):
        np.savez(tmp_path / "louder.npz", **dict(modes) | {"shapes": 1.01 * modes["shapes"]})
        path.write_text(f"surface: {other}" + ERAS)
        with pytest.raises(InputError, match="must be a table of this rig: plate"):
            load_table(tmp_path / "table.npz", rig=load_rig(path))


def test_curved_surface_counts_along_its_arc(
    modes: Mapping[str, FloatArray], own: LocalizationTable, tmp_path: Path
) -> None:
    """The same motion along the normals of a cylinder is that of the plate, unrolled."""
    radius, (x, y, _) = 0.4, modes["nodes"].T
    angle = x / radius
    normals = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    places = modes["nodes"][:, :2]
    nodes = radius * normals + np.column_stack([0 * x, y, 0 * x])
    shapes = modes["shapes"][:, :, None] * normals
    path = _write(tmp_path, modes, nodes=nodes, shapes=shapes, places=places)
    path.write_text("surface: {modes: modes.npz, normal: local z, mass: 282 g}" + ERAS)
    assert _difference(own, build_table(load_rig(path))) < 0.05


def _of_modes(rig: Rig, **known: float) -> Rig:
    """A rig of which each mode is uncertain by itself, and nothing else but fingers."""
    own = {"mode_frequency": 0.02, "mode_amplitude": 0.05, "fingertip": 0.5}
    return replace(rig, uncertainty=replace(Uncertainty.none(), **(own | known)))


def test_modes_that_differ_are_those_of_the_bench_and_of_drawn_plates(
    modes: Mapping[str, FloatArray], tmp_path: Path
) -> None:
    """As of a file whose modes have these frequencies and sizes.

    Within what those modes add that are truncated, whose frequencies stay.
    """
    rig = _of_modes(load_rig(_write(tmp_path, modes)), fingertip=0.0, mode_amplitude=0.2)
    realised = draw_of_ensemble(rig, seed=3).plate.realised(rig)
    known, bench = build_table(rig), build_table(replace(realised, mesh=rig.mesh))
    plates = draw_plates(
        np.random.default_rng(3), rig.uncertainty, of=rig, count=1, contact_count=3
    )
    squares, sizes = plates.modes[0][:, : (modes["frequencies"] > 1).sum()]
    changed = {name: each.copy() for name, each in modes.items()}
    changed["frequencies"][-len(squares) :] *= np.sqrt(squares)
    changed["shapes"][-len(sizes) :] *= np.sqrt(sizes)[:, None]
    other = build_table(load_rig(_write(tmp_path, changed)))
    assert _difference(other, known) > 0.1
    assert _difference(other, bench) < 0.04
    places = [(0.1, 0.1), (0.2, 0.05), (0.15, 0.2)]
    asked = [Finger(places[0], Stimulus())]
    drive = answer(known, asked, drive_mode="switched").layers[0].excitation
    of_each = (known, plates), (other, replace(plates, modes=np.ones((1, 2, 0))))
    drawn, expected = (amplitudes_on(table, places, drive, on)[1] for table, on in of_each)
    np.testing.assert_allclose(drawn, expected, rtol=0.1)


def test_promises_are_kept_where_each_mode_differs(
    modes: Mapping[str, FloatArray], tmp_path: Path
) -> None:
    """On nine of ten plates, which promises that know of no such modes are not."""
    rig, size = load_rig(_write(tmp_path, modes)), (0.3048, 0.2286)
    uncertain, blind = (
        build_table(_of_modes(rig, **known))
        for known in ({}, {"mode_frequency": 0.0, "mode_amplitude": 0.0})
    )
    kept, rng = list[list[float]](), np.random.default_rng(1)
    for seed in range(12):
        target, *quiet = [(float(x), float(y)) for x, y in random_contacts(rng, 2, size)]
        found = [
            answer(each, [Finger(target, Stimulus())], quiet=quiet, min_contrast_db=-np.inf)
            for each in (uncertain, blind)
        ]
        kept.append([share_kept(uncertain, each, quiet, seed=seed) for each in found])
    knowing, not_knowing = np.mean(kept, axis=0)
    assert 0.8 < knowing < 0.98
    assert not_knowing < knowing - 0.15


@pytest.mark.parametrize("ratio", [-0.1, 0.5, 1.5])
def test_modes_of_impossible_damping_are_refused(
    modes: Mapping[str, FloatArray], tmp_path: Path, ratio: float
) -> None:
    """A loss factor, twice the damping ratio, is from 0 to 1; the rig may state one instead."""
    path = _write(tmp_path, modes, damping_ratios=np.full(len(modes["frequencies"]), ratio))
    with pytest.raises(
        InputError, match=rf"modes\.npz: damping ratios must be .* got {ratio:g} in"
    ):
        load_rig(path)
    path.write_text("surface: {modes: modes.npz, loss_factor: 0.02}" + ERAS)
    assert load_rig(path).plate.loss_factor == 0.02


def test_modes_below_zero_are_refused(modes: Mapping[str, FloatArray], tmp_path: Path) -> None:
    """They would count as rigid-body modes, whose frequencies only rounding makes negative."""
    frequencies = modes["frequencies"].copy()
    frequencies[0] = -0.5
    load_rig(_write(tmp_path, modes, frequencies=frequencies))
    frequencies[5] *= -1
    with pytest.raises(InputError, match=r"modes\.npz: frequencies of modes must be 0 Hz or above"):
        load_rig(_write(tmp_path, modes, frequencies=frequencies))


def test_cut_out_has_no_fingers(
    modes: Mapping[str, FloatArray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Faces around a hole give two rings; a finger in the hole is refused, no cell is there.

    A panel that reports one there has it rejected, so that all others are served. Along the wrong
    normal the surface would be a line. A check of a layout touches the plate only, although the
    hole is also at the center of a quarter, where a second finger would rest.
    """
    first = (21 * np.arange(15)[:, None] + np.arange(20)).ravel()
    faces = np.setdiff1d(first, 21 * np.arange(2, 9)[:, None] + np.arange(3, 13))[:, None]
    rig = load_rig(_write(tmp_path, modes, faces=np.add(faces, [0, 1, 22, 21])))
    assert len(getattr(rig.plate.surface, "outline", ())) == 2
    with pytest.raises(InputError, match=r"finger must be within the outline"):
        check_on_plate("finger", [(0.152, 0.1)], rig.plate)
    with pytest.raises(InputError, match=r"nodes must extend along both axes across x, got a line"):
        parse_rig(str(tmp_path / "rig.yaml"), "surface: {modes: modes.npz, normal: x}" + ERAS)
    change = ContactTracker(rig.plate).update(
        TouchFrame("panel", 0.0, (Touch(1, 0.5, 0.56), Touch(2, 0.2, 0.2)))  # shares, y downwards
    )
    assert ([each.key.id for each in change.down], change.rejected) == ([2], ("off_plate",))
    table = build_table(rig)
    assert len(table.cell_centers) < table.grid.cell_count
    cells, questions = map_grid(table).centers(rig.plate), pair_questions(table)
    assert [bool(each) for each in questions] == rig.plate.covers(cells).tolist()
    asked = [placed.contacts for of_cell in questions for placed in of_cell]
    assert rig.plate.covers(np.vstack(asked)).all()
    assert mirror_images(table) == [(False, False)]
    candidates = area_of("anywhere", rig.plate).candidates(0.02)  # for ERAs
    assert rig.plate.covers(np.vstack([table.cell_centers, candidates])).all()
    monkeypatch.setattr(layout_check, "MAX_REGION_TOUCHES", 6)
    (checked,) = check_layout(SurfaceLayout((), {"click": Click()}, elsewhere="click"), table)
    fingers = [touch.at for touch in checked.touches]
    fingers += [touch.resting for touch in checked.touches if touch.resting is not None]
    assert rig.plate.covers(np.array(fingers)).all()


def test_even_odd_rule_counts_holes_and_edges() -> None:
    """A square ring has neither its hole nor the outside, but both of its edges."""
    points = np.array([[x, y] for y in range(4) for x in range(4)], dtype=float)
    faces = [(a, a + 1, a + 5, a + 4) for a in (0, 1, 2, 4, 6, 8, 9, 10)]
    rings = rings_of(faces, points)
    asked = np.array([[0.5, 0.5], [1.5, 1.5], [3.5, 1], [1, 1.5], [3, 2]])
    assert is_within(rings, asked).tolist() == [True, False, False, True, True]


@pytest.mark.parametrize("odd", ODD, ids=str)
def test_odd_modes_are_read_or_refused_with_their_place(
    odd: Mapping[str, Any],
    modes: Mapping[str, FloatArray],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A damaged or unusual file of modes is read rightly, or one message says what and where.

    What needs a plate says of a surface that is read that it has no thickness, size or modulus.
    """
    text, rig = _universal(modes, kind=55, length=1.0), tmp_path / "rig.yaml"
    old, new = odd.get("modes", ("", ""))
    if old == "cut":
        text = text[: int(new)]
    elif old:
        assert old in text
        text = text.replace(old, new, -1 if old in ("E+", "\n") else 1)
    (tmp_path / "modes.uff").write_bytes(text.encode())
    rig.write_text(("surface: modes.uff" + ERAS).replace(*odd.get("rig", ("", "")), 1))
    status = run_era(["plate", "show", str(rig)])
    said = capsys.readouterr()
    assert status == (2 if odd["said"] else 0), said.err
    shown = r"surface by \d+ modes up to \d+ Hz of .*modes.uff, 3 of the rigid body(.|\n)*mass  282"
    assert re.search(odd["said"] or shown, said.err if odd["said"] else said.out)
    if not odd["said"]:
        assert run_era(["config", "check", str(rig)]) == 0
        for command in ("plate convergence {0}", "rig identify {0} -o {0}.new --measured {0}"):
            assert run_era(command.format(rig).split()) == 2
            assert (
                "surface given by modes, which has no thickness, size or" in capsys.readouterr().err
            )
