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
from era_haptics.lab.design.era_area import area_of
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
SIDES = np.array([PAPER.plate.length, PAPER.plate.width])
ODD_MODES = read_yaml(Path(__file__).parent / "odd_modes.yaml")

Modes = Mapping[str, FloatArray]


@pytest.fixture(scope="module")
def paper_table() -> LocalizationTable:
    """The table of the paper's plate up to 150 Hz, from its sizes and material."""
    return build_table(PAPER)


@pytest.fixture(scope="module")
def modes() -> Modes:
    """Its modes up to 2 kHz at 21 x 16 nodes as another program would export them, along z.

    With fewer modes resonances on ERAs are off.
    """
    return exported_modes(PAPER, 2000.0, (21, 16))


def write_rig(folder: Path, modes: Mapping[str, Any], keys: str = "", **arrays: Any) -> Path:
    """Write a rig of modes in an .npz, with further arrays and further keys of the surface."""
    np.savez(folder / "modes.npz", **(dict(modes) | arrays))
    path = folder / "rig.yaml"
    path.write_text(f"surface: {{modes: modes.npz{keys}}}{ERAS}")
    return path


def field_difference(table: LocalizationTable, expected: LocalizationTable) -> float:
    """Relative L2 error of the fields at cells by the worst ERA, mean over frequencies."""
    points = expected.cell_centers
    expected_fields = expected.unit_fields(points)
    differences = np.linalg.norm(table.unit_fields(points) - expected_fields, axis=-1)
    errors = differences / np.linalg.norm(expected_fields, axis=-1)
    return float(errors.max(axis=1).mean())


# Files of modes


def integers(*values: int) -> str:
    """Integers in the columns of a universal file."""
    return "".join(f"{value:10d}" for value in values)


def reals(*values: float) -> str:
    """Real numbers in the columns of a universal file."""
    return "".join(f"{value:13.5E}" for value in values)


def long_reals(*values: float) -> str:
    """Real numbers of double precision in the columns of a universal file."""
    return "".join(f"{value:25.16E}" for value in values)


def universal_file(modes: Modes, *, kind: int, length: float) -> str:
    """A universal file of modes, datasets 55 or 2414, in a unit of length per meter."""
    rows = ["    -1", "   164", f"{1:10d}{'SI':<20}{2:10d}", long_reals(length, 1.0)]
    rows += [long_reals(0.0), "    -1", "    -1", "  2411"]
    for number, node in enumerate(modes["nodes"], start=1):
        rows.append(integers(number, 1, 1, 11))  # as mesh programs number systems
        rows.append(long_reals(*(length * node)))
    rows.append("    -1")
    types = integers(1, 2, 2, 8, 2, 3)
    for frequency, shape in zip(modes["frequencies"], modes["shapes"], strict=True):
        rows += ["    -1", f"{kind:6d}"]
        if kind == 55:
            rows += [*["NONE"] * 5, types, integers(2, 4, 0, 1)]
            rows.append(reals(frequency, 1 / length, 0.005, 0.0))
        else:
            rows += [integers(1), "modes", integers(1), *["NONE"] * 5, types]
            rows += ["0 0 0 0 0 1 0 0", "0 0", reals(0.0, frequency, 0.0, 1 / length, 0.005, 0.0)]
            rows.append(reals(*[0.0] * 6))
        for number, w in enumerate(shape, start=1):
            rows.append(integers(number))
            rows.append(reals(0.0, 0.0, w))
        rows.append("    -1")
    return "\n".join([*rows, ""])


def csv_file(modes: Modes) -> str:
    """A line for each node of each mode."""
    rows = ["mode,frequency_hz,x_m,y_m,z_m,shape_x,shape_y,shape_z"]
    for number, frequency in enumerate(modes["frequencies"]):
        for node, w in zip(modes["nodes"], modes["shapes"][number], strict=True):
            values = [number, frequency, *node, 0, 0, w]
            rows.append(",".join(f"{value:.9g}" for value in values))
    return "\n".join([*rows, ""])


@pytest.mark.parametrize(
    ("kind", "length"),
    [pytest.param(55, 1.0, marks=pytest.mark.long), (2414, 1.0), (55, 1000.0), (0, 1.0)],
)
def test_plate_by_its_own_modes_has_the_fields_of_its_table(
    modes: Modes, paper_table: LocalizationTable, kind: int, length: float, tmp_path: Path
) -> None:
    """Modes of another program give the fields of the plate that they are of, in m, mm and CSV.

    A file with its last line twice is rejected with its line.
    """
    name = "modes.uff" if kind else "modes.csv"
    text = universal_file(modes, kind=kind, length=length) if kind else csv_file(modes)
    (tmp_path / name).write_text(text)
    path = tmp_path / "rig.yaml"
    path.write_text(f"surface: {name}{ERAS}")

    rig = load_rig(path)

    assert rig.plate.mass == pytest.approx(PAPER.plate.mass, rel=1e-3)
    assert field_difference(build_table(rig), paper_table) < 0.04
    (tmp_path / name).write_text(text + text.splitlines()[-1] + "\n")
    with pytest.raises(InputError, match=rf"{name}:\d+: (modes must follow|dataset must begin)"):
        load_rig(path)


SURFACE_READ = (
    r"surface by \d+ modes up to \d+ Hz of .*modes.uff, 3 of the rigid body(.|\n)*mass  282"
)


@pytest.fixture(scope="module")
def universal_text(modes: Modes) -> str:
    """The universal file that the cases of `odd_modes.yaml` change."""
    return universal_file(modes, kind=55, length=1.0)


@pytest.mark.parametrize("case", ODD_MODES, ids=str)
@pytest.mark.usefixtures("assumed_costs")
def test_odd_modes_are_read_or_rejected_with_their_location(
    case: Mapping[str, Any], universal_text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A damaged or unusual file of modes is read correctly, or one message says what and where."""
    old, new = case.get("modes", ("", ""))
    text = universal_text[: int(new)] if old == "cut" else universal_text
    if old not in ("", "cut"):
        assert old in text
        text = text.replace(old, new, -1 if old in ("E+", "\n") else 1)
    (tmp_path / "modes.uff").write_bytes(text.encode())
    path = tmp_path / "rig.yaml"
    old_keys, new_keys = case.get("rig", ("", ""))
    path.write_text(f"surface: modes.uff{ERAS}".replace(old_keys, new_keys, 1))

    status = run_era(["plate", "show", str(path)])
    streams = capsys.readouterr()

    error = case["said"]
    assert status == (2 if error else 0), streams.err
    if error:
        assert re.search(error, streams.err)
    else:
        assert re.search(SURFACE_READ, streams.out)
        assert run_era(["config", "check", str(path)]) == 0


@pytest.mark.parametrize(
    "words", ["plate convergence RIG", "rig identify RIG -o new --measured RIG"]
)
def test_command_that_needs_a_plate_rejects_a_surface(
    words: str, modes: Modes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The message says that a surface has no thickness, size or modulus."""
    path = write_rig(tmp_path, modes)

    status = run_era(words.replace("RIG", str(path)).split())

    assert status == 2
    error = capsys.readouterr().err
    assert "surface given by modes, which has no thickness, size or" in error


@pytest.mark.parametrize("ratio", [-0.1, 0.5, 1.5])
def test_modes_of_impossible_damping_are_rejected(
    modes: Modes, tmp_path: Path, ratio: float
) -> None:
    """A loss factor, twice the damping ratio, is from 0 to 1; the rig can state one instead."""
    ratios = np.full(len(modes["frequencies"]), ratio)
    message = rf"modes\.npz: damping ratios must be .* got {ratio:g} in"

    with pytest.raises(InputError, match=message):
        load_rig(write_rig(tmp_path, modes, damping_ratios=ratios))
    stated = write_rig(tmp_path, modes, ", loss_factor: 0.02", damping_ratios=ratios)
    assert load_rig(stated).plate.loss_factor == 0.02


def test_modes_below_zero_are_rejected(modes: Modes, tmp_path: Path) -> None:
    """Only frequencies of rigid-body modes can be negative, by rounding."""
    frequencies = modes["frequencies"].copy()
    frequencies[0] = -0.5
    load_rig(write_rig(tmp_path, modes, frequencies=frequencies))

    frequencies[5] *= -1
    with pytest.raises(InputError, match=r"modes\.npz: frequencies of modes must be 0 Hz or above"):
        load_rig(write_rig(tmp_path, modes, frequencies=frequencies))


# Mass, fields and tables


def test_surface_has_the_center_of_mass_of_its_modes(modes: Modes, tmp_path: Path) -> None:
    """The paper's plate with 50 g at a node, solved from its own modes.

    The modal masses with m at a node of shapes phi are I + m phi phi'. A uniform rectangle has the
    inertia m L² / 12 about its middle.
    """
    mass, node = 0.05, 40
    at_node = modes["shapes"][:, node]
    stiffness = np.diag((2 * np.pi * modes["frequencies"]) ** 2)
    loaded_mass = np.eye(len(at_node)) + mass * np.outer(at_node, at_node)
    squares, vectors = scipy.linalg.eigh(stiffness, loaded_mass)
    frequencies = np.sqrt(squares.clip(0)) / (2 * np.pi)
    shapes = vectors.T @ modes["shapes"]

    rig = load_rig(write_rig(tmp_path, modes, frequencies=frequencies, shapes=shapes))
    loads = static_loads(rig.plate, rig.eras)
    rocking = rigid_body_frequencies(rig.plate, rig.eras)

    middle, position = SIDES / 2, modes["nodes"][node, :2]
    total_mass = PAPER.plate.mass + mass
    center = (PAPER.plate.mass * middle + mass * position) / total_mass
    era_positions = np.array([[era.x, era.y] for era in rig.eras])
    assert rig.plate.mass == pytest.approx(total_mass, rel=1e-3)
    assert center_of_mass(rig.plate) == pytest.approx(center, abs=1e-5)
    assert loads.sum() == pytest.approx(GRAVITY * total_mass, rel=1e-3)
    assert loads @ era_positions / loads.sum() == pytest.approx(center, rel=1e-3)
    era_motions = np.insert(era_positions - middle, 0, 1.0, axis=1)
    node_motion = np.array([1.0, *(position - middle)])
    inertia = PAPER.plate.mass * np.diag([1.0, *(SIDES**2 / 12)])
    inertia += mass * np.outer(node_motion, node_motion)
    springs = 17000 * era_motions.T @ era_motions
    expected_squares = scipy.linalg.eigh(springs, inertia, eigvals_only=True)
    assert rocking == pytest.approx(np.sqrt(expected_squares) / (2 * np.pi), rel=1e-3)


def test_table_of_a_surface_is_verified_and_read_again(modes: Modes, tmp_path: Path) -> None:
    """Fields, answers, promises and motion in time agree; table and rig need no other folder.

    The table is rejected for another surface, which differs by any key or by its modes.
    """
    rig = load_rig(write_rig(tmp_path, modes))
    table, path, copy = build_table(rig), tmp_path / "table.npz", tmp_path / "copy" / "rig.yaml"

    assert verify_table(table, rig, samples=1).failed_count == 0
    save_table(table, path)
    copy.parent.mkdir()
    save_rig(rig, copy)
    load_table(path, rig=load_rig(copy))

    outline = "[[[0, 0], [0.31, 0], [0.31, 0.23], [0, 0.23]]]"
    for keys in (", normal: -z", ", mass: 290 g", ", loss_factor: 0.02", f", outline: {outline}"):
        with pytest.raises(InputError, match="must be a table of this rig: plate"):
            load_table(path, rig=load_rig(write_rig(tmp_path, modes, keys)))
    louder = write_rig(tmp_path, modes, shapes=1.01 * modes["shapes"])
    with pytest.raises(InputError, match="must be a table of this rig: plate"):
        load_table(path, rig=load_rig(louder))


def test_curved_surface_counts_along_its_arc(
    modes: Modes, paper_table: LocalizationTable, tmp_path: Path
) -> None:
    """The same motion along the normals of a cylinder is that of the plate, unrolled."""
    radius, (x, y, _) = 0.4, modes["nodes"].T
    zeros, angle = np.zeros(len(x)), x / radius
    normals = np.column_stack([np.sin(angle), zeros, np.cos(angle)])
    nodes = radius * normals + np.column_stack([zeros, y, zeros])
    arrays = {
        "nodes": nodes,
        "shapes": modes["shapes"][:, :, None] * normals,
        "places": modes["nodes"][:, :2],
    }

    path = write_rig(tmp_path, modes, ", normal: local z, mass: 282 g", **arrays)

    assert field_difference(build_table(load_rig(path)), paper_table) < 0.05


# Tolerances of modes


def with_uncertain_modes(rig: Rig, **values: float) -> Rig:
    """The rig with independent tolerances of modes, and of nothing else but fingers."""
    tolerances = {"mode_frequency": 0.02, "mode_amplitude": 0.05, "fingertip": 0.5} | values
    return replace(rig, uncertainty=replace(Uncertainty.none(), **tolerances))


def test_drawn_modes_are_those_of_the_bench_and_of_drawn_plates(
    modes: Modes, tmp_path: Path
) -> None:
    """A plate drawn with a seed is that of a file whose modes have its frequencies and sizes.

    Within what truncated modes add, whose frequencies stay.
    """
    rig = with_uncertain_modes(
        load_rig(write_rig(tmp_path, modes)), fingertip=0.0, mode_amplitude=0.2
    )
    rng = np.random.default_rng(3)
    plates = draw_plates(rng, rig.uncertainty, of=rig, count=1, contact_count=3)
    elastic_count = (modes["frequencies"] > 1).sum()
    squares, sizes = plates.modes[0][:, :elastic_count]
    frequencies, shapes = modes["frequencies"].copy(), modes["shapes"].copy()
    frequencies[-elastic_count:] *= np.sqrt(squares)
    shapes[-elastic_count:] *= np.sqrt(sizes)[:, None]
    drawn_rig = load_rig(write_rig(tmp_path, modes, frequencies=frequencies, shapes=shapes))

    table, drawn_table = build_table(rig), build_table(drawn_rig)
    bench_rig = draw_of_ensemble(rig, seed=3).plate.realised(rig)
    bench_table = build_table(replace(bench_rig, mesh=rig.mesh))
    fingers = [(0.1, 0.1), (0.2, 0.05), (0.15, 0.2)]
    layer = answer(table, [Finger(fingers[0], Stimulus())], drive_mode="switched").layers[0]
    drive, exact_plates = layer.excitation, replace(plates, modes=np.ones((1, 2, 0)))
    _, amplitudes = amplitudes_on(table, fingers, drive, plates)
    _, expected = amplitudes_on(drawn_table, fingers, drive, exact_plates)

    assert field_difference(table, drawn_table) > 0.1
    assert field_difference(bench_table, drawn_table) < 0.04
    np.testing.assert_allclose(amplitudes, expected, rtol=0.1)


def test_promises_are_kept_where_each_mode_differs(modes: Modes, tmp_path: Path) -> None:
    """On 90 % of plates; promises that ignore tolerances of modes are kept on fewer."""
    rig = load_rig(write_rig(tmp_path, modes))
    table = build_table(with_uncertain_modes(rig))
    exact_table = build_table(with_uncertain_modes(rig, mode_frequency=0.0, mode_amplitude=0.0))
    rng = np.random.default_rng(1)
    shares, exact_shares = [], []

    for seed in range(12):
        target, *quiet = [(float(x), float(y)) for x, y in random_contacts(rng, 2, tuple(SIDES))]
        fingers = [Finger(target, Stimulus())]
        promise = answer(table, fingers, quiet=quiet, min_contrast_db=-np.inf)
        exact_promise = answer(exact_table, fingers, quiet=quiet, min_contrast_db=-np.inf)
        shares.append(share_kept(table, promise, quiet, seed=seed))
        exact_shares.append(share_kept(table, exact_promise, quiet, seed=seed))

    assert 0.8 < np.mean(shares) < 0.98
    assert np.mean(exact_shares) < np.mean(shares) - 0.15


# Outlines


@pytest.fixture(scope="module")
def cut_out(modes: Modes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig of a surface with a hole around its center, from its faces."""
    all_faces = (21 * np.arange(15)[:, None] + np.arange(20)).ravel()
    hole = 21 * np.arange(2, 9)[:, None] + np.arange(3, 13)
    faces = np.setdiff1d(all_faces, hole)[:, None] + [0, 1, 22, 21]
    return write_rig(tmp_path_factory.mktemp("cut-out"), modes, faces=faces)


def test_cut_out_has_no_fingers(cut_out: Path) -> None:
    """A question at the hole is rejected, and so is a touch there, while others are served."""
    rig = load_rig(cut_out)
    touches = (Touch(1, 0.5, 0.56), Touch(2, 0.2, 0.2))  # shares of the sides, y downwards

    change = ContactTracker(rig.plate).update(TouchFrame("panel", 0.0, touches))

    assert len(getattr(rig.plate.surface, "outline", ())) == 2
    assert [contact.key.id for contact in change.down] == [2]
    assert change.rejected == ("off_plate",)
    with pytest.raises(InputError, match=r"finger must be within the outline"):
        check_on_plate("finger", [(0.152, 0.1)], rig.plate)


def test_surface_seen_along_its_plane_is_rejected(cut_out: Path) -> None:
    """Along a wrong normal the surface is a line."""
    text = f"surface: {{modes: modes.npz, normal: x}}{ERAS}"

    with pytest.raises(InputError, match=r"nodes must extend along both axes across x, got a line"):
        parse_rig(str(cut_out), text)


def test_nothing_is_computed_in_a_cut_out(cut_out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells, questions, ERA candidates and touches of a layout check are on the plate only.

    The hole is also at the center of a quarter, where a second finger would rest.
    """
    monkeypatch.setattr(layout_check, "MAX_REGION_TOUCHES", 6)
    rig = load_rig(cut_out)
    table, covers = build_table(rig), rig.plate.covers
    layout = SurfaceLayout((), {"click": Click()}, elsewhere="click")

    cells, questions = map_grid(table).centers(rig.plate), pair_questions(table)
    contacts = [placed.contacts for cell_questions in questions for placed in cell_questions]
    candidates = area_of("anywhere", rig.plate).candidates(0.02)
    (checked,) = check_layout(layout, table)
    fingers = [touch.at for touch in checked.touches]
    fingers += [touch.resting for touch in checked.touches if touch.resting is not None]

    assert len(table.cell_centers) < table.grid.cell_count
    assert [len(cell_questions) > 0 for cell_questions in questions] == covers(cells).tolist()
    assert mirror_images(table) == [(False, False)]
    for positions in (np.vstack(contacts), table.cell_centers, candidates, np.array(fingers)):
        np.testing.assert_array_equal(positions[~covers(positions)], np.empty((0, 2)))


def test_even_odd_rule_counts_holes_and_edges() -> None:
    """A square ring has neither its hole nor the outside, but both of its edges."""
    nodes = np.array([[x, y] for y in range(4) for x in range(4)], dtype=float)
    faces = [(corner, corner + 1, corner + 5, corner + 4) for corner in (0, 1, 2, 4, 6, 8, 9, 10)]
    points = np.array([[0.5, 0.5], [1.5, 1.5], [3.5, 1], [1, 1.5], [3, 2]])

    is_on_ring = is_within(rings_of(faces, nodes), points)

    assert is_on_ring.tolist() == [True, False, False, True, True]
