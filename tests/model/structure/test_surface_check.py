"""Checks of a surface's modes against physics, by plates whose modes are known in closed form."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

import era_haptics as era
from benchmarks.surface import exported_modes
from era_haptics.command import run_era
from model.arrays import FloatArray, lattice
from model.errors import InputError
from model.files.modal_file import read_modes
from model.rig.rig import Rig
from model.rig.rig_file import load_rig, parse_rig

LENGTH, WIDTH, THICKNESS = 0.4, 0.3, 3e-3
MODULUS, POISSON, DENSITY = 70e9, 0.22, 2500.0
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


def _grid(columns: int, rows: int) -> FloatArray:
    return lattice(np.linspace(0, LENGTH, columns), np.linspace(0, WIDTH, rows))


def _modes(places: FloatArray, frequencies: FloatArray, shapes: FloatArray) -> Modes:
    """The lowest 24 modes, ascending; shapes (r, n) along z."""
    order = np.argsort(frequencies)[:24]
    nodes = np.column_stack([places, np.zeros(len(places))])
    return {"nodes": nodes, "frequencies": frequencies[order], "shapes": shapes[order]}


def simply_supported(places: FloatArray) -> Modes:
    """Navier: 2/sqrt(M) sin(m pi x/a) sin(n pi y/b), pi/2 (m²/a² + n²/b²) sqrt(D/mu)."""
    m, n = np.meshgrid(np.arange(1, 8), np.arange(1, 8))
    m, n = m.ravel(), n.ravel()
    x, y = places.T
    along = np.sin(np.outer(m, math.pi * x / LENGTH))
    across = np.sin(np.outer(n, math.pi * y / WIDTH))
    speed = math.sqrt(RIGIDITY / (DENSITY * THICKNESS))
    frequencies = math.pi / 2 * (m**2 / LENGTH**2 + n**2 / WIDTH**2) * speed
    return _modes(places, frequencies, 2 / math.sqrt(MASS) * along * across)


def cantilever(places: FloatArray) -> Modes:
    """Euler and Bernoulli: a strip that is clamped at x = 0 and bends along its length alone."""
    roots = np.array([1.8751041, 4.6940911, 7.8547574, 10.9955407, 14.1371684, 17.2787596])
    k = roots[:, None] / LENGTH
    x = places[:, 0]
    ratio = (np.cosh(roots) + np.cos(roots)) / (np.sinh(roots) + np.sin(roots))
    bending = np.cosh(k * x) - np.cos(k * x) - ratio[:, None] * (np.sinh(k * x) - np.sin(k * x))
    speed = math.sqrt(MODULUS * THICKNESS**2 / 12 / DENSITY)
    frequencies = roots**2 / (2 * math.pi * LENGTH**2) * speed
    return _modes(places, frequencies, bending / math.sqrt(MASS))


@pytest.fixture(scope="module")
def free_plate() -> Rig:
    """A rig of the plate of the same sizes, by its polynomials."""
    plate = (
        f"plate: {{length: {LENGTH}, width: {WIDTH}, thickness: {THICKNESS}, "
        f"material: {{E: {MODULUS}, nu: {POISSON}, rho: {DENSITY}}}}}"
    )
    return parse_rig("plate.yaml", plate + ERAS)


@pytest.fixture(scope="module")
def free(free_plate: Rig) -> Modes:
    """Its modes at 15 x 12 nodes, rigid-body modes turned into mixtures as solvers have them."""
    modes = dict(exported_modes(free_plate, 1250.0, (15, 12)))
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    modes["shapes"][:3] = turn @ modes["shapes"][:3]
    return modes


def _write(folder: Path, modes: Mapping[str, FloatArray], mass: float | None = None) -> Path:
    np.savez(folder / "modes.npz", **modes)
    rig = folder / "rig.yaml"
    of_mass = "" if mass is None else f", mass: {mass}"
    rig.write_text(f"surface: {{modes: modes.npz{of_mass}}}{ERAS}")
    return rig


def _scattered(count: int) -> FloatArray:
    """The corners of the panel, and so many places anywhere on it."""
    places = np.random.default_rng(count).uniform(0, 1, (count, 2)) * (LENGTH, WIDTH)
    return np.vstack([_grid(2, 2), places])


@pytest.mark.parametrize(
    "modes",
    [
        simply_supported(_grid(21, 16)),
        simply_supported(_grid(6, 5)),
        simply_supported(_scattered(40)),
        cantilever(_grid(21, 5)),
        cantilever(_grid(9, 4)),
    ],
    ids=["supported", "supported-few", "supported-scattered", "cantilever", "cantilever-few"],
)
def test_held_panel_passes_without_notes(modes: Modes, tmp_path: Path) -> None:
    """Modes in closed form of panels that their mounts hold give no alarm, at few nodes neither."""
    assert load_rig(_write(tmp_path, modes, MASS)).surface_notes == ()


@pytest.mark.parametrize("nodes", [0, 40, 16])
def test_measured_free_panel_passes_without_notes(free: Modes, nodes: int, tmp_path: Path) -> None:
    """A free panel passes, also as measured: few positions, 10 % of scatter, three digits."""
    rng = np.random.default_rng(nodes)
    measured = dict(free)
    if nodes:
        corners = [0, 14, 165, 179]
        others = np.setdiff1d(np.arange(len(free["nodes"])), corners)
        chosen = np.append(corners, rng.choice(others, nodes - 4, replace=False))
        shapes = free["shapes"][:, chosen]
        scatter = rng.normal(1, 0.1, (len(shapes), 1)) * rng.normal(1, 0.1, shapes.shape)
        measured["nodes"] = free["nodes"][chosen]
        measured["shapes"] = np.round(shapes * scatter, 3)
        # Rigid-body modes of a suspended panel from its mass and sides, as the page recommends.
        x, y, _ = (measured["nodes"] - (LENGTH / 2, WIDTH / 2, 0)).T
        tilts = x * math.sqrt(12) / LENGTH, y * math.sqrt(12) / WIDTH
        measured["shapes"][:3] = np.array([x**0, *tilts]) / math.sqrt(MASS)
        measured["frequencies"] = np.round(free["frequencies"], 1)
    rig = load_rig(_write(tmp_path, measured))
    assert rig.surface_notes == ()
    assert rig.plate.mass == pytest.approx(MASS, rel=0.02)


def _scaled(modes: Modes, sizes: FloatArray | float) -> Modes:
    return modes | {"shapes": modes["shapes"] / np.reshape(sizes, (-1, 1))}


def _largest(modes: Modes) -> FloatArray:
    return np.asarray(np.abs(modes["shapes"]).max(axis=1))


def _only(modes: Modes, kept: FloatArray) -> Modes:
    return modes | {name: modes[name][kept] for name in ("frequencies", "shapes")}


def _joined(modes: Modes, others: Modes) -> Modes:
    arrays = {
        name: np.concatenate([modes[name], others[name]]) for name in ("frequencies", "shapes")
    }
    return modes | arrays


def _without_point(modes: Modes) -> Modes:
    """Without the nodes whose displacement is largest in three modes: on ribs, say."""
    kept = np.setdiff1d(np.arange(len(modes["nodes"])), np.abs(modes["shapes"][:3]).argmax(axis=1))
    return modes | {"nodes": modes["nodes"][kept], "shapes": modes["shapes"][:, kept]}


FREE_FAULTS: dict[str, tuple[Callable[[Modes], Modes], float | None, str]] = {
    "maximum-of-1": (
        lambda free: _scaled(free, _largest(free)),
        None,
        "got shapes that look normalized to their largest value",
    ),
    "maximum-of-1-elsewhere": (
        lambda free: _without_point(_scaled(free, _largest(free))),
        None,
        "got shapes that look normalized to their largest value",
    ),
    "unit-length": (
        lambda free: _scaled(free, np.linalg.norm(free["shapes"], axis=1)),
        MASS,
        "got shapes that look normalized to unit length",
    ),
    "one-node": (
        lambda free: _scaled(free, free["shapes"][:, 0]),
        MASS,
        "got shapes that look normalized to one node",
    ),
    "root-of-the-frequency": (
        lambda free: _scaled(free, np.sqrt(4 * math.pi * np.maximum(free["frequencies"], 1.0))),
        MASS,
        r"the integral of shape² over 0\.9 kg is 0\.000\d+ in most elastic modes",
    ),
    "tonnes": (
        lambda free: _scaled(free, 1000**-0.5),
        None,
        r"mass must be plausible, got 0\.0009 kg on 0\.12 m², 0\.0075 kg/m²",
    ),
    "no-rigid-modes": (
        lambda free: _only(free, free["frequencies"] > 1),
        MASS,
        r"modes must include rigid-body motion, got 0 %: ",
    ),
    "one-rigid-mode-missing": (
        lambda free: _only(free, np.arange(len(free["frequencies"])) != 1),
        MASS,
        r"modes must include rigid-body motion, got 0 %: ",
    ),
    "free-and-held": (
        lambda free: _joined(free, simply_supported(free["nodes"][:, :2])),
        MASS,
        r"elastic modes of a free part must be orthogonal to rigid-body motion, got",
    ),
    "twice": (
        lambda free: _joined(free, free),
        None,
        r"modes must differ, got modes 1 and 25 .* 24 pairs in all; keep one export",
    ),
    "two-steps": (
        lambda free: _joined(free, free | {"frequencies": 1.004 * free["frequencies"] + 3}),
        None,
        r"modes must differ, got modes \d+ and \d+ .* 13 pairs in all",
    ),
    "one-mode-twice": (
        lambda free: _joined(free, _only(free, np.array([8]))),
        None,
        r"modes must differ, got modes 9 and 25 \(at 290\.\d+ and 290\.\d+ Hz\)",
    ),
    "millimeters": (
        lambda free: free | {"nodes": 1000 * free["nodes"]},
        None,
        r"sides must be in meters, got 400 x 300 m \(0\.4 x 0\.3 m if they are in mm\)",
    ),
    "kilometers": (
        lambda free: free | {"nodes": free["nodes"] / 1000},
        None,
        r"sides must be in meters, got 0\.0004 x 0\.0003 m; convert",
    ),
    "two-rows": (
        lambda free: {
            "nodes": free["nodes"][:30],
            "frequencies": free["frequencies"],
            "shapes": free["shapes"][:, :30],
        },
        None,
        r"nodes must be in three rows or more along both sides",
    ),
}


@pytest.mark.parametrize("name", FREE_FAULTS)
def test_impossible_modes_of_a_free_panel_are_rejected(
    name: str, free: Modes, tmp_path: Path
) -> None:
    """The message states file, physical quantity and remedy, before anything is computed."""
    damage, mass, message = FREE_FAULTS[name]
    rig = _write(tmp_path, damage(free), mass)
    with pytest.raises(InputError, match=rf"rig\.yaml:1: surface: .*modes\.npz: .*{message}"):
        load_rig(rig)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        (_largest, "normalized to their largest value"),
        (lambda modes: np.linalg.norm(modes["shapes"], axis=1), "normalized to unit length"),
        (lambda modes: 1000**0.5, "integral of shape² over 0.9 kg is 0.0009"),
    ],
    ids=["maximum-of-1", "unit-length", "grams"],
)
def test_held_panel_of_another_scale_is_rejected(
    sizes: Callable[[Modes], FloatArray | float], message: str, tmp_path: Path
) -> None:
    """Shapes of a supported panel are compared with its stated mass."""
    modes = simply_supported(_grid(12, 9))
    with pytest.raises(InputError, match=message):
        load_rig(_write(tmp_path, _scaled(modes, sizes(modes)), MASS))


def test_supported_panel_with_a_maximum_of_1_passes_when_its_mass_is_4_kg(tmp_path: Path) -> None:
    """Shapes 2/sqrt(M) sin sin of 4 kg have a maximum of 1 and are of unit modal mass."""
    modes = simply_supported(_grid(21, 13))
    rig = load_rig(_write(tmp_path, _scaled(modes, 2 / math.sqrt(MASS)), 4.0))
    assert rig.surface_notes == ()


def test_suspicious_modes_warn_in_every_entry(
    free: Modes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One mode that was identified twice, at two frequencies, is a warning with both numbers."""
    again = _only(free, np.array([10]))
    again["frequencies"] = 1.004 * again["frequencies"]
    rig = _write(tmp_path, _joined(free, again))
    expected = "surface: modes.npz: modes 11 and 25 (at "
    table = tmp_path / "table.npz"
    for command in (
        f"config check {rig}",
        f"plate show {rig}",
        f"table build {rig} -o {table} --frequencies 150",
    ):
        assert run_era(command.split()) == 0
        shown = capsys.readouterr()
        assert expected in shown.out + shown.err
    with pytest.warns(UserWarning, match="modes 11 and 25 .* nearly the same shape"):
        era.SolvedPlate(load_rig(rig))


@pytest.mark.parametrize(
    ("mass", "is_suspicious"), [(MASS, False), (2 * MASS, False), (4 * MASS, True)]
)
def test_stated_mass_is_compared_with_the_modes(
    mass: float, is_suspicious: bool, tmp_path: Path
) -> None:
    """A heavy frame doubles the mass, four times as much is suspicious."""
    rig = load_rig(_write(tmp_path, simply_supported(_grid(12, 9)), mass))
    notes = " ".join(rig.surface_notes)
    assert ("over 3.6 kg is 3.9 in most elastic modes instead of 1" in notes) == is_suspicious
    assert bool(notes) == is_suspicious


def _complex_universal(modes: Modes, *, kind: int, analysis: int, is_doubled: bool) -> str:
    """A universal file of complex modes of a maximum of 1, with poles, modal A or modal masses.

    A is psi' (2 pole M + C) psi, with mass and viscous damper of each mode.
    """
    rows = ["    -1", "  2411"]
    for number, (x, y, _) in enumerate(modes["nodes"], start=1):
        rows += [f"{number:10d}{0:10d}{0:10d}{1:10d}", f"{x:25.16E}{y:25.16E}{0:25.16E}"]
    rows.append("    -1")
    for frequency, shape in zip(modes["frequencies"], modes["shapes"], strict=True):
        largest = np.abs(shape).max()
        turned = shape / largest * np.exp(0.7j)  # as measured at a lagging reference
        mass = np.exp(1.4j) / largest**2
        omega, damping_ratio = 2 * math.pi * frequency, 0.01
        pole = omega * complex(-damping_ratio, math.sqrt(1 - damping_ratio**2))
        modal_a = (2 * pole + 2 * damping_ratio * omega) * mass
        scale = mass if analysis == 7 else modal_a
        for is_conjugate in (False, True)[: 1 + is_doubled]:
            numbers = [pole, scale, -pole * scale]
            values = turned
            if is_conjugate:
                numbers = [complex(number).conjugate() for number in numbers]
                values = turned.conj()
            reals = "".join(f"{n.real:13.5E}{n.imag:13.5E}" for n in numbers)
            types = "".join(f"{code:10d}" for code in (1, analysis, 2, 8, 5, 3))
            head = ["NONE"] * 5 + [types]
            if kind == 55:
                head += [f"{2:10d}{6:10d}{0:10d}{1:10d}", reals]
            else:
                head = [f"{1:10d}", "modes", f"{1:10d}", *head, f"{0:10d}" * 8, f"{0:10d}" * 2]
                head += [f"{0.0:13.5E}" * 6, reals]
            rows += ["    -1", f"{kind:6d}", *head]
            zeros = f"{0.0:13.5E}" * 4
            for number, value in enumerate(values, start=1):
                rows += [f"{number:10d}", f"{zeros}{value.real:13.5E}{value.imag:13.5E}"]
            rows.append("    -1")
    return "\n".join([*rows, ""])


@pytest.mark.parametrize(
    ("kind", "analysis", "is_doubled"),
    [(55, 3, False), (55, 3, True), (2414, 3, False), (2414, 7, False)],
)
def test_complex_modes_are_scaled_by_their_modal_a_or_mass(
    kind: int, analysis: int, is_doubled: bool, tmp_path: Path
) -> None:
    """Complex modes of any size and phase become those of unit modal mass; conjugates are left out.

    Modal A is that of the state space, psi' (2 pole M + C) psi.
    """
    modes = simply_supported(_grid(6, 5))
    text = _complex_universal(modes, kind=kind, analysis=analysis, is_doubled=is_doubled)
    read = read_modes(tmp_path / "modes.uff", text.encode())
    np.testing.assert_allclose(read.frequencies, modes["frequencies"], rtol=1e-4)
    np.testing.assert_allclose(read.damping_ratios, 0.01, rtol=1e-3)
    signs = np.sign((read.shapes[:, :, 2] * modes["shapes"]).sum(axis=1))
    largest = np.abs(modes["shapes"]).max()
    read_shapes = signs[:, None] * read.shapes[:, :, 2]
    np.testing.assert_allclose(read_shapes, modes["shapes"], atol=1e-4 * largest)


@pytest.mark.parametrize(
    ("analysis", "old", "new", "message"),
    [
        (7, "", "", r"analysis type of a mode must be 2 or 3, got 7"),
        (3, None, "  0.00000E+00  0.00000E+00", r"modal A and the imaginary part .* got 0\+0j"),
    ],
    ids=["second-order", "no-modal-a"],
)
def test_complex_modes_without_a_scale_are_rejected(
    analysis: int, old: str | None, new: str, message: str, tmp_path: Path
) -> None:
    """Without modal A, and of a type that dataset 55 gives no scale, the line is named."""
    modes = simply_supported(_grid(6, 5))
    text = _complex_universal(modes, kind=55, analysis=analysis, is_doubled=False)
    if old is None:
        head = text.index(f"{2:10d}{6:10d}{0:10d}{1:10d}\n") + 41
        old = text[head + 26 : head + 52]
    with pytest.raises(InputError, match=rf"modes\.uff:\d+: {message}"):
        read_modes(tmp_path / "modes.uff", text.replace(old, new, 1).encode())
