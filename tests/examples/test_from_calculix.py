"""Modes from CalculiX: numbers and sets as its files have them, and a plate that it solves."""

import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from examples.calculix.from_calculix import convert, read_set
from model.rig.rig_file import load_rig

PROGRAM = Path(__file__).parents[2] / "examples" / "calculix" / "from_calculix.py"
NODES = {n: [0.1 * (n % 3), 0.1 * (n // 3), 0.0] for n in range(9)}


def _c(value: float) -> str:
    """12 characters of C: the exponent has two digits, or three where it needs them."""
    return f"{value:12.5E}"


def _windows(value: float) -> str:
    """12 or 13 characters of C on older Windows: the exponent always has three digits."""
    mantissa, exponent = f"{value:.5E}".split("E")
    return f"{mantissa}E{int(exponent):+04d}"


def _fortran(value: float) -> str:
    """12 characters of Fortran: three digits of the exponent leave no place for its letter."""
    mantissa, exponent = f"{value:.5E}".split("E")
    letter = "E" if abs(int(exponent)) < 100 else ""
    width = 2 if letter else 3
    return f"{mantissa}{letter}{int(exponent):+0{width + 1}d}".rjust(12)


def _results(
    shapes: np.ndarray, written: Callable[[float], str] = _c, *, analysis: int = 2, step: int = 1
) -> list[str]:
    """Modes at 100, 200, ... Hz as blocks of results."""
    rows = []
    for number, shape in enumerate(shapes, start=1):
        head = f"  100CL{100 + number:5d}{100.0 * number:12.5E}{len(shape):12d}{'':20}"
        rows += [
            f"    1PSTEP{number:26d}{1:12d}{step:12d}",
            f"{head}{analysis:2d}{number:5d}{'MODAL':10}{1:2d}",
            " -4  DISP        4    1",
        ]
        for node, values in zip(NODES, shape, strict=True):
            rows.append(f" -1{node:10d}" + "".join(written(float(value)) for value in values))
        rows.append(" -3")
    return rows


def _write(folder: Path, rows: list[str], touch: str = "*NSET, NSET=TOUCH\n0, 1, 2\n") -> Path:
    """Write a model of nine nodes and one quadrilateral with results; return its name."""
    head = ["    1C", f"    2C{len(NODES):30d}{1:38d}"]
    head += [f" -1{n:10d}" + "".join(map(_c, at)) for n, at in NODES.items()]
    head += [" -3", f"    3C{1:30d}{1:38d}", f" -1{1:10d}{9:5d}{0:5d}{1:5d}"]
    head += [f" -2{0:10d}{1:10d}{4:10d}{3:10d}", " -3"]
    (folder / "model.frd").write_text("\n".join([*head, *rows, " 9999", ""]))
    (folder / "model.inp").write_text(touch)
    return folder / "model"


@pytest.mark.parametrize("written", [_c, _windows, _fortran])
def test_convert_reads_every_exponent_exactly(
    written: Callable[[float], str], tmp_path: Path
) -> None:
    """Values from 1e-300 to 1e300 of both signs, which touch each other, are read to the digit."""
    rng = np.random.default_rng(3)
    exponents = rng.integers(-300, 300, (4, 9, 3))
    values = rng.choice([-1, 1], exponents.shape) * rng.uniform(1, 10, exponents.shape)
    shapes = values * 10.0**exponents
    model = _write(tmp_path, _results(shapes, written), "*NSET, NSET=TOUCH, GENERATE\n0, 8\n")
    read = np.load(convert(model))
    expected = [float(f"{value:.5E}") for value in shapes.ravel()]
    np.testing.assert_array_equal(read["shapes"].ravel(), expected)
    assert read["frequencies"].tolist() == [100.0, 200.0, 300.0, 400.0]
    assert read["faces"].tolist() == [[0, 1, 4, 3]]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("*NSET, NSET=TOUCH\n1, 2,\n** a comment\n5\n", [1, 2, 5]),
        ("*nset,nset=touch,generate\n2, 8, 3\n", [2, 5, 8]),
        ("*NSET, NSET=EDGE\n4, 5\n*NSET, NSET=TOUCH\nEDGE, 1, 4\n", [4, 5, 1]),
        ("*NSET, NSET=TOUCH, INSTANCE=PANEL-1, GENERATE\n1, 3, 1\n", [1, 2, 3]),
        ("*NODE, NSET=TOUCH\n7, 0.1, 0.2, 0\n8, 0.1, 0.3, 0\n", [7, 8]),
        ("*INCLUDE, INPUT=touch.nam\n*NSET, NSET=TOUCH\n9\n", [1, 2, 9]),
    ],
    ids=["comment", "generate", "set-of-a-set", "instance", "node", "include"],
)
def test_read_set_follows_the_rules_of_calculix(
    text: str, expected: list[int], tmp_path: Path
) -> None:
    """Ranges, names of other sets, instances, sets of *NODE and included files have their nodes."""
    (tmp_path / "model.inp").write_text(text)
    (tmp_path / "touch.nam").write_text("*NSET, NSET=TOUCH\n1, 2\n")
    assert read_set(tmp_path / "model.inp", "TOUCH") == expected


SHAPES = np.ones((2, 9, 3))
TOUCH = "*NSET, NSET=TOUCH\n0, 1, 2\n"


@pytest.mark.parametrize(
    ("rows", "touch", "message"),
    [
        (
            [row.replace(".0", ",0") for row in _results(SHAPES)],
            TOUCH,
            "model.frd:18: numbers must have decimal points, got commas in '1,00000E+02'",
        ),
        (
            _results(SHAPES) + _results(SHAPES, step=2),
            TOUCH,
            "modes must come from one *FREQUENCY step, got steps 1, 2",
        ),
        (_results(SHAPES, analysis=0), TOUCH, "model.frd: must contain modes, got none"),
        (
            [row.replace("DISP ", "DISPI") for row in _results(SHAPES)],
            TOUCH,
            "modes must be real, got complex or cyclic modes",
        ),
        (
            [row.replace(" 1.00000E+00", "         NaN") for row in _results(SHAPES)],
            TOUCH,
            "model.frd:20: line must have 3 numbers such as -1.23456E-01",
        ),
        (_results(SHAPES)[:-3], TOUCH, "block must end with -3, got the end of the file"),
        (
            _results(SHAPES)[:4] + _results(SHAPES)[5:],
            TOUCH,
            "mode must have all 3 nodes of TOUCH, got 2 without node 1",
        ),
        (
            [row[:-1] + "2" if "100C" in row else row for row in _results(SHAPES)],
            TOUCH,
            "model.frd:18: .frd file must be ASCII, got binary data",
        ),
        (_results(SHAPES), "*NSET, NSET=FACE\n1\n", "must have the node set TOUCH, got FACE"),
        (
            _results(SHAPES),
            "*NSET, NSET=TOUCH\n1, EDGE\n",
            "model.inp:2: node set must have whole numbers or names of earlier sets, got EDGE",
        ),
        (
            _results(SHAPES),
            "*NSET, NSET=TOUCH, GENERATE\n1\n",
            "model.inp:2: GENERATE line must have a first number, a last number",
        ),
        (
            _results(SHAPES),
            "*NSET, NSET=TOUCH, INSTANCE=A\n1\n*NSET, NSET=TOUCH, INSTANCE=B\n1\n",
            "node set TOUCH must belong to one instance, got A, B",
        ),
        (_results(SHAPES), "*INCLUDE, INPUT=gone.inp\n", "gone.inp: No such file or directory"),
    ],
    ids=[
        "decimal-commas",
        "two-steps",
        "static-step",
        "complex",
        "not-a-number",
        "cut-off",
        "missing-node",
        "binary",
        "no-set",
        "unknown-set",
        "short-range",
        "two-instances",
        "no-included-file",
    ],
)
def test_unreadable_files_are_one_sentence(
    rows: list[str], touch: str, message: str, tmp_path: Path
) -> None:
    """The program ends with status 1, and with the place and the reason in place of a traceback."""
    model = _write(tmp_path, rows, touch)
    ended = subprocess.run(
        [sys.executable, PROGRAM, model], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1
    assert message in ended.stderr
    assert ended.stderr.startswith("from_calculix: ")
    assert ended.stderr.count("\n") == 1


LENGTH, WIDTH, THICKNESS = 0.4, 0.3, 3e-3
MODULUS, POISSON, DENSITY = 70e9, 0.22, 2500.0
RIG = """
surface: {modes: plate.npz, mass: 0.9 kg}
eras:
  SW: {at: [0.04, 0.04], stiffness: 30000, amplifier: main, channel: 0}
  SE: {at: [0.36, 0.04], stiffness: 30000, amplifier: main, channel: 1}
  NE: {at: [0.36, 0.26], stiffness: 30000, amplifier: main, channel: 2}
amplifiers: {main: {url: "sim://"}}
limits: {frequency: [40, 200]}
"""


def _plate_of_shells(held: str, columns: int = 16, rows: int = 12) -> str:
    """A plate of elements S8R; held: lines that hold its edges."""
    numbers: dict[tuple[int, int], int] = {}
    lines = ["*NODE, NSET=ALL"]
    for j in range(2 * rows + 1):
        for i in range(2 * columns + 1):
            if i % 2 and j % 2:
                continue
            numbers[i, j] = len(numbers) + 1
            x, y = LENGTH * i / (2 * columns), WIDTH * j / (2 * rows)
            lines.append(f"{numbers[i, j]}, {x:.9g}, {y:.9g}, 0")
    lines.append("*ELEMENT, TYPE=S8R, ELSET=PLATE")
    around = [(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1)]
    for element in range(columns * rows):
        i, j = 2 * (element % columns), 2 * (element // columns)
        corners = [str(numbers[i + a, j + b]) for a, b in around]
        lines.append(", ".join([str(element + 1), *corners]))
    edge = [
        str(number)
        for (i, j), number in numbers.items()
        if i in (0, 2 * columns) or j in (0, 2 * rows)
    ]
    lines += ["*NSET, NSET=EDGE", *(f"{number}," for number in edge)]
    lines += [f"*NSET, NSET=TOUCH, INSTANCE=PLATE-1, GENERATE\n1, {len(numbers)}, 1"]
    lines += ["*MATERIAL, NAME=GLASS", f"*ELASTIC\n{MODULUS}, {POISSON}", f"*DENSITY\n{DENSITY}"]
    lines += [f"*SHELL SECTION, ELSET=PLATE, MATERIAL=GLASS\n{THICKNESS}", held]
    lines += ["*STEP", "*FREQUENCY", "24", "*NODE FILE, OUTPUT=2D", "U", "*END STEP"]
    return "\n".join([*filter(None, lines), ""])


@pytest.mark.long
@pytest.mark.needs("ccx")
@pytest.mark.parametrize("held", ["", "*BOUNDARY\nEDGE, 1, 3"])
def test_plate_of_calculix_passes_without_notes(held: str, tmp_path: Path) -> None:
    """Free it has its mass, on simple supports Navier's frequencies; neither is suspicious."""
    (tmp_path / "plate.inp").write_text(_plate_of_shells(held))
    subprocess.run(["ccx", "plate"], cwd=tmp_path, check=True, stdout=subprocess.DEVNULL)
    convert(tmp_path / "plate")
    text = RIG if held else RIG.replace(", mass: 0.9 kg", "")
    (tmp_path / "rig.yaml").write_text(text)
    rig = load_rig(tmp_path / "rig.yaml")
    assert rig.surface_notes == ()
    assert rig.plate.mass == pytest.approx(DENSITY * LENGTH * WIDTH * THICKNESS, rel=2e-3)
    if held:
        rigidity = MODULUS * THICKNESS**3 / 12 / (1 - POISSON**2)
        speed = math.sqrt(rigidity / (DENSITY * THICKNESS))
        lowest = math.pi / 2 * (1 / LENGTH**2 + 1 / WIDTH**2) * speed
        frequencies = np.load(tmp_path / "plate.npz")["frequencies"]
        assert frequencies[0] == pytest.approx(lowest, rel=0.01)
