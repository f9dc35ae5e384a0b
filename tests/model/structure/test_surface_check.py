"""Checks of a surface's modes against physics, by plates whose modes are known in closed form."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import era_haptics as era
from benchmarks.surface import exported_modes
from era_haptics.command import run_era
from model.arrays import ComplexArray, FloatArray, IntArray, lattice
from model.errors import InputError
from model.files.modal_file import read_modes
from model.rig.rig_file import load_rig, parse_rig

LENGTH = 0.4
WIDTH = 0.3
THICKNESS = 3e-3
MODULUS = 70e9
POISSON = 0.22
DENSITY = 2500.0
MASS = DENSITY * LENGTH * WIDTH * THICKNESS  # 0.9 kg
RIGIDITY = MODULUS * THICKNESS**3 / 12 / (1 - POISSON**2)
ERAS = """
eras:
  SW: {at: [0.04, 0.04], stiffness: 30000, amplifier: main, channel: 0}
  SE: {at: [0.36, 0.04], stiffness: 30000, amplifier: main, channel: 1}
  NE: {at: [0.36, 0.26], stiffness: 30000, amplifier: main, channel: 2}
  NW: {at: [0.04, 0.26], stiffness: 30000, amplifier: main, channel: 3}
amplifiers: {main: {url: "sim://"}}
limits: {frequency: [40, 200]}
"""

Modes = dict[str, FloatArray]


def node_grid(columns: int, rows: int) -> FloatArray:
    """Positions (n, 2) of a regular grid over the whole panel."""
    return lattice(np.linspace(0, LENGTH, columns), np.linspace(0, WIDTH, rows))


def scattered_nodes(count: int) -> FloatArray:
    """The corners of the panel and random positions on it."""
    positions = np.random.default_rng(count).uniform(0, 1, (count, 2))
    return np.vstack([node_grid(2, 2), positions * (LENGTH, WIDTH)])


def lowest_modes(positions: FloatArray, frequencies: FloatArray, shapes: FloatArray) -> Modes:
    """The lowest 24 modes, ascending; shapes (r, n) along z."""
    order = np.argsort(frequencies)[:24]
    nodes = np.column_stack([positions, np.zeros(len(positions))])
    return {"nodes": nodes, "frequencies": frequencies[order], "shapes": shapes[order]}


def simply_supported(positions: FloatArray) -> Modes:
    """Navier: 2/sqrt(M) sin(m pi x/a) sin(n pi y/b), pi/2 (m²/a² + n²/b²) sqrt(D/mu)."""
    m, n = np.indices((7, 7)).reshape(2, -1) + 1
    x, y = positions.T
    along = np.sin(np.outer(m, math.pi * x / LENGTH))
    across = np.sin(np.outer(n, math.pi * y / WIDTH))
    speed = math.sqrt(RIGIDITY / (DENSITY * THICKNESS))
    squares = (m / LENGTH) ** 2 + (n / WIDTH) ** 2
    frequencies = math.pi / 2 * squares * speed
    shapes = 2 / math.sqrt(MASS) * along * across
    return lowest_modes(positions, frequencies, shapes)


def cantilever(positions: FloatArray) -> Modes:
    """Euler and Bernoulli: a strip that is clamped at x = 0 and bends along its length alone."""
    roots = np.array([1.8751041, 4.6940911, 7.8547574, 10.9955407, 14.1371684, 17.2787596])
    even_end = np.cosh(roots) + np.cos(roots)
    odd_end = np.sinh(roots) + np.sin(roots)
    kx = np.outer(roots, positions[:, 0] / LENGTH)
    even = np.cosh(kx) - np.cos(kx)
    odd = np.sinh(kx) - np.sin(kx)
    ratio = even_end / odd_end
    bending = even - ratio[:, None] * odd
    speed = math.sqrt(MODULUS * THICKNESS**2 / 12 / DENSITY)
    frequencies = roots**2 / (2 * math.pi * LENGTH**2) * speed
    return lowest_modes(positions, frequencies, bending / math.sqrt(MASS))


@pytest.fixture(scope="module")
def free_modes() -> Modes:
    """Modes of the free panel at 15 x 12 nodes; its rigid-body modes are mixed, as solvers do."""
    material = f"{{E: {MODULUS}, nu: {POISSON}, rho: {DENSITY}}}"
    sides = f"length: {LENGTH}, width: {WIDTH}, thickness: {THICKNESS}"
    rig = parse_rig("plate.yaml", f"plate: {{{sides}, material: {material}}}{ERAS}")
    modes = dict(exported_modes(rig, 1250.0, (15, 12)))
    rotation, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    modes["shapes"][:3] = rotation @ modes["shapes"][:3]
    return modes


def write_surface(folder: Path, modes: Mapping[str, FloatArray], mass: float | None = None) -> Path:
    """Write a rig of a surface with these modes and, if stated, this mass."""
    np.savez(folder / "modes.npz", **modes)
    path = folder / "rig.yaml"
    mass_key = "" if mass is None else f", mass: {mass}"
    path.write_text(f"surface: {{modes: modes.npz{mass_key}}}{ERAS}")
    return path


# Sound modes


@pytest.mark.parametrize(
    "modes",
    [
        simply_supported(node_grid(6, 5)),
        simply_supported(scattered_nodes(40)),
        cantilever(node_grid(9, 4)),
    ],
    ids=["supported-few", "supported-scattered", "cantilever-few"],
)
def test_held_panel_passes_without_notes(modes: Modes, tmp_path: Path) -> None:
    """Modes in closed form of panels on rigid mounts cause no alarm, even at few nodes."""
    assert load_rig(write_surface(tmp_path, modes, MASS)).surface_notes == ()


def as_measured(modes: Modes, node_count: int) -> Modes:
    """The modes at a few nodes with 10 % of scatter, rounded to three digits.

    The rigid-body modes of a suspended panel follow from its mass and sides.
    """
    rng = np.random.default_rng(node_count)
    corners = [0, 14, 165, 179]
    inner_nodes = np.setdiff1d(np.arange(180), corners)
    chosen = rng.choice(inner_nodes, node_count - 4, replace=False)
    measured = at_nodes(modes, np.append(corners, chosen))
    shapes = measured["shapes"]
    shapes *= rng.normal(1, 0.1, (len(shapes), 1))
    shapes *= rng.normal(1, 0.1, shapes.shape)
    shapes = np.round(shapes, 3)
    x, y, _ = measured["nodes"].T
    shapes[0] = 1
    shapes[1] = (x / LENGTH - 0.5) * math.sqrt(12)
    shapes[2] = (y / WIDTH - 0.5) * math.sqrt(12)
    shapes[:3] /= math.sqrt(MASS)
    frequencies = np.round(modes["frequencies"], 1)
    return measured | {"frequencies": frequencies, "shapes": shapes}


@pytest.mark.parametrize("node_count", [None, 40, 16])
def test_free_panel_passes_without_notes_also_as_measured(
    free_modes: Modes, node_count: int | None, tmp_path: Path
) -> None:
    """The mass that follows from the rigid-body modes is the panel's, despite 10 % of scatter."""
    modes = as_measured(free_modes, node_count) if node_count else free_modes

    rig = load_rig(write_surface(tmp_path, modes))

    assert rig.surface_notes == ()
    assert rig.plate.mass == pytest.approx(MASS, rel=0.02)


def test_supported_panel_with_a_maximum_of_1_passes_when_its_mass_is_4_kg(tmp_path: Path) -> None:
    """Shapes 2/sqrt(M) sin sin of 4 kg have a maximum of 1 and are of unit modal mass."""
    modes = scaled(simply_supported(node_grid(21, 13)), math.sqrt(MASS) / 2)

    assert load_rig(write_surface(tmp_path, modes, 4.0)).surface_notes == ()


# Impossible modes


def scaled(modes: Modes, factors: FloatArray | float) -> Modes:
    """The modes with shapes multiplied by a factor per mode."""
    return modes | {"shapes": modes["shapes"] * np.reshape(factors, (-1, 1))}


def with_maximum_of_1(modes: Modes) -> Modes:
    """The modes normalized to their largest value."""
    return scaled(modes, 1 / np.abs(modes["shapes"]).max(axis=1))


def with_unit_length(modes: Modes) -> Modes:
    """The modes normalized to the length of their vector."""
    return scaled(modes, 1 / np.linalg.norm(modes["shapes"], axis=1))


def at_nodes(modes: Modes, chosen: IntArray | slice) -> Modes:
    """The modes at some of their nodes."""
    return modes | {"nodes": modes["nodes"][chosen], "shapes": modes["shapes"][:, chosen]}


def selected(modes: Modes, chosen: NDArray[np.bool_] | slice) -> Modes:
    """Some of the modes."""
    frequencies, shapes = modes["frequencies"][chosen], modes["shapes"][chosen]
    return modes | {"frequencies": frequencies, "shapes": shapes}


def joined(modes: Modes, added: Modes) -> Modes:
    """The modes of two exports in one file."""
    frequencies = np.concatenate([modes["frequencies"], added["frequencies"]])
    shapes = np.concatenate([modes["shapes"], added["shapes"]])
    return modes | {"frequencies": frequencies, "shapes": shapes}


def without_peak_nodes(modes: Modes) -> Modes:
    """The modes with a maximum of 1 at nodes that are not exported, such as on ribs."""
    peak_nodes = np.abs(modes["shapes"][:3]).argmax(axis=1)
    node_numbers = np.arange(len(modes["nodes"]))
    return at_nodes(with_maximum_of_1(modes), np.setdiff1d(node_numbers, peak_nodes))


def relative_to_first_node(modes: Modes) -> Modes:
    """The modes normalized to one node."""
    return scaled(modes, 1 / modes["shapes"][:, 0])


def over_root_of_frequency(modes: Modes) -> Modes:
    """The modes scaled as some experimental software does."""
    frequencies = np.maximum(modes["frequencies"], 1.0)
    return scaled(modes, (4 * math.pi * frequencies) ** -0.5)


def in_tonnes(modes: Modes) -> Modes:
    """The modes of a model in tonnes."""
    return scaled(modes, 1000**0.5)


def without_rigid_modes(modes: Modes) -> Modes:
    """The elastic modes."""
    return selected(modes, slice(3, None))


def without_one_rigid_mode(modes: Modes) -> Modes:
    """All modes but the second."""
    is_exported = np.arange(len(modes["frequencies"])) != 1
    return selected(modes, is_exported)


def with_held_modes(modes: Modes) -> Modes:
    """The modes of a free and of a held panel."""
    held_modes = simply_supported(modes["nodes"][:, :2])
    return joined(modes, held_modes)


def written_twice(modes: Modes) -> Modes:
    """The modes of one export, twice."""
    return joined(modes, modes)


def of_two_steps(modes: Modes) -> Modes:
    """The modes of two load steps, which differ in their frequencies."""
    frequencies = 1.004 * modes["frequencies"] + 3
    return joined(modes, modes | {"frequencies": frequencies})


def with_one_duplicate(modes: Modes) -> Modes:
    """The modes with mode 9 written twice."""
    return joined(modes, selected(modes, slice(8, 9)))


def in_millimeters(modes: Modes) -> Modes:
    """The modes with nodes in millimeters."""
    return modes | {"nodes": 1000 * modes["nodes"]}


def in_kilometers(modes: Modes) -> Modes:
    """The modes with nodes in kilometers."""
    return modes | {"nodes": modes["nodes"] / 1000}


def in_two_rows(modes: Modes) -> Modes:
    """The modes at two rows of nodes."""
    return at_nodes(modes, slice(30))


LARGEST_VALUE = "got shapes that look normalized to their largest value"
NO_RIGID_MOTION = "modes must include rigid-body motion, got 0 %: "


@pytest.mark.parametrize(
    ("damage", "mass", "message"),
    [
        (with_maximum_of_1, None, LARGEST_VALUE),
        (without_peak_nodes, None, LARGEST_VALUE),
        (with_unit_length, MASS, "got shapes that look normalized to unit length"),
        (relative_to_first_node, MASS, "got shapes that look normalized to one node"),
        (over_root_of_frequency, MASS, r"integral of shape² over 0\.9 kg is 0\.000\d+ in most"),
        (in_tonnes, None, r"mass must be plausible, got 0\.0009 kg on 0\.12 m², 0\.0075 kg/m²"),
        (without_rigid_modes, MASS, NO_RIGID_MOTION),
        (without_one_rigid_mode, MASS, NO_RIGID_MOTION),
        (with_held_modes, MASS, "a free part must be orthogonal to rigid-body motion"),
        (written_twice, None, "got modes 1 and 25 .* 24 pairs in all; keep one export"),
        (of_two_steps, None, r"modes must differ, got modes \d+ and \d+ .* 13 pairs in all"),
        (with_one_duplicate, None, r"modes 9 and 25 \(at 290\.\d+ and 290\.\d+ Hz\)"),
        (in_millimeters, None, r"got 400 x 300 m \(0\.4 x 0\.3 m if they are in mm\)"),
        (in_kilometers, None, r"sides must be in meters, got 0\.0004 x 0\.0003 m; convert"),
        (in_two_rows, None, "nodes must be in three rows or more along both sides"),
    ],
    ids=[
        *("maximum-of-1", "maximum-of-1-elsewhere", "unit-length", "one-node"),
        *("root-of-the-frequency", "tonnes", "no-rigid-modes", "one-rigid-mode-missing"),
        *("free-and-held", "twice", "two-steps", "one-mode-twice"),
        *("millimeters", "kilometers", "two-rows"),
    ],
)
def test_impossible_modes_of_a_free_panel_are_rejected(
    damage: Callable[[Modes], Modes],
    mass: float | None,
    message: str,
    free_modes: Modes,
    tmp_path: Path,
) -> None:
    """The message states file, physical quantity and remedy, before anything is computed."""
    path = write_surface(tmp_path, damage(free_modes), mass)

    with pytest.raises(InputError, match=rf"rig\.yaml:1: surface: .*modes\.npz: .*{message}"):
        load_rig(path)


SUPPORTED = simply_supported(node_grid(12, 9))


@pytest.mark.parametrize(
    ("modes", "message"),
    [
        (with_maximum_of_1(SUPPORTED), "normalized to their largest value"),
        (with_unit_length(SUPPORTED), "normalized to unit length"),
        (scaled(SUPPORTED, 1000**-0.5), "integral of shape² over 0.9 kg is 0.0009"),
    ],
    ids=["maximum-of-1", "unit-length", "grams"],
)
def test_held_panel_of_another_scale_is_rejected(
    modes: Modes, message: str, tmp_path: Path
) -> None:
    """Shapes of a supported panel are compared with its stated mass."""
    with pytest.raises(InputError, match=message):
        load_rig(write_surface(tmp_path, modes, MASS))


# Suspicious modes


@pytest.mark.usefixtures("assumed_costs")
def test_mode_identified_twice_is_a_warning_in_every_entry(
    free_modes: Modes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Commands and Python warn of one mode at two frequencies, with both mode numbers."""
    duplicate = selected(free_modes, slice(10, 11))
    duplicate["frequencies"] = 1.004 * duplicate["frequencies"]
    path = write_surface(tmp_path, joined(free_modes, duplicate))

    def warned_by(*words: str | Path) -> bool:
        assert run_era([str(word) for word in words]) == 0
        streams = capsys.readouterr()
        return "surface: modes.npz: modes 11 and 25 (at " in streams.out + streams.err

    assert warned_by("config", "check", path)
    assert warned_by("plate", "show", path)
    table_options = ["-o", tmp_path / "table.npz", "--frequencies", "150"]
    assert warned_by("table", "build", path, *table_options)
    with pytest.warns(UserWarning, match="modes 11 and 25 .* nearly the same shape"):
        era.SolvedPlate(load_rig(path))


@pytest.mark.parametrize(("mass", "note_count"), [(MASS, 0), (2 * MASS, 0), (4 * MASS, 1)])
def test_stated_mass_is_compared_with_the_modes(
    mass: float, note_count: int, tmp_path: Path
) -> None:
    """A heavy frame can double the mass; four times as much is suspicious."""
    notes = load_rig(write_surface(tmp_path, SUPPORTED, mass)).surface_notes

    assert len(notes) == note_count
    for note in notes:
        assert "over 3.6 kg is 3.9 in most elastic modes instead of 1" in note


# Complex modes


def integers(*numbers: int) -> str:
    """Integers in the columns of a universal file."""
    return "".join(f"{number:10d}" for number in numbers)


def numbers(*values: complex) -> str:
    """Real and imaginary parts in the columns of a universal file."""
    parts = np.array(values, dtype=complex).view(float)
    return "".join(f"{part:13.5E}" for part in parts)


RESPONSE_HEADER = integers(2, 6, 0, 1)


def mode_rows(
    kind: int, analysis: int, pole: complex, scale: complex, shape: ComplexArray
) -> list[str]:
    """A data set 55 or 2414 of a complex mode."""
    type_row = integers(1, analysis, 2, 8, 5, 3)
    scale_row = numbers(pole, scale, -pole * scale)
    rows = ["    -1", f"{kind:6d}"]
    if kind == 55:
        rows += [*["NONE"] * 5, type_row, RESPONSE_HEADER, scale_row]
    else:
        rows += [integers(1), "modes", integers(1), *["NONE"] * 5, type_row]
        rows += [integers(*[0] * 8), integers(0, 0), numbers(0, 0, 0), scale_row]
    for node_number, value in enumerate(shape, start=1):
        rows.append(integers(node_number))
        rows.append(numbers(0, 0, value))
    rows.append("    -1")
    return rows


def complex_universal(modes: Modes, *, kind: int, analysis: int, has_conjugates: bool) -> str:
    """A universal file of complex modes of a maximum of 1, with poles, modal A or modal masses.

    A is psi' (2 pole M + C) psi, with mass and viscous damper of each mode.
    """
    rows = ["    -1", "  2411"]
    for node_number, (x, y, _) in enumerate(modes["nodes"], start=1):
        rows.append(integers(node_number, 0, 0, 1))
        rows.append(f"{x:25.16E}{y:25.16E}{0:25.16E}")
    rows.append("    -1")
    for frequency, shape in zip(modes["frequencies"], modes["shapes"], strict=True):
        largest = np.abs(shape).max()
        rotated = shape / largest * np.exp(0.7j)  # as measured at a lagging reference
        mass = complex(np.exp(1.4j) / largest**2)
        omega = 2 * math.pi * frequency
        damping_ratio = 0.01
        pole = omega * complex(-damping_ratio, math.sqrt(1 - damping_ratio**2))
        modal_a = (2 * pole + 2 * damping_ratio * omega) * mass
        scale = mass if analysis == 7 else modal_a
        rows += mode_rows(kind, analysis, pole, scale, rotated)
        if has_conjugates:
            conjugate_scale = scale.conjugate()
            rows += mode_rows(kind, analysis, pole.conjugate(), conjugate_scale, rotated.conj())
    return "\n".join([*rows, ""])


FEW_MODES = simply_supported(node_grid(6, 5))


@pytest.mark.parametrize(
    ("kind", "analysis", "has_conjugates"), [(55, 3, True), (2414, 3, False), (2414, 7, False)]
)
def test_complex_modes_are_scaled_by_their_modal_a_or_mass(
    kind: int, analysis: int, has_conjugates: bool, tmp_path: Path
) -> None:
    """Complex modes of any size and phase get unit modal mass; conjugates are left out."""
    text = complex_universal(FEW_MODES, kind=kind, analysis=analysis, has_conjugates=has_conjugates)

    modes = read_modes(tmp_path / "modes.uff", text.encode())

    np.testing.assert_allclose(modes.frequencies, FEW_MODES["frequencies"], rtol=1e-4)
    np.testing.assert_allclose(modes.damping_ratios, 0.01, rtol=1e-3)
    expected = FEW_MODES["shapes"]
    shapes = modes.shapes[:, :, 2]
    signs = np.sign((shapes * expected).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(signs * shapes, expected, atol=1e-4 * np.abs(expected).max())


def test_complex_modes_without_modal_a_are_rejected(tmp_path: Path) -> None:
    """A modal A of 0 gives no scale; the message names the line."""
    text = complex_universal(FEW_MODES, kind=55, analysis=3, has_conjugates=False)
    column = text.index(RESPONSE_HEADER) + len(RESPONSE_HEADER) + 1 + 26
    without_modal_a = text[:column] + numbers(0) + text[column + 26 :]

    with pytest.raises(
        InputError, match=r"modes\.uff:\d+: modal A and the imaginary part .* got 0\+0j"
    ):
        read_modes(tmp_path / "modes.uff", without_modal_a.encode())
