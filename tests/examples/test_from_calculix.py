"""Modes from CalculiX: numbers and sets as its files have them, and a plate that it solves."""

import math
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from examples.calculix.from_calculix import convert, read_set
from model.arrays import FloatArray
from model.rig.rig_file import load_rig

COUNT = 9
"""Nodes in three rows of three, numbered from 0."""
SHAPES = np.ones((2, 9, 3))
"""Two modes of the nine nodes."""
TOUCH = "*NSET, NSET=TOUCH\n0, 1, 2\n"
HEAD = """\
    1C
    2C                             9                                     1"""
QUADRILATERAL = """\
 -3
    3C                             1                                     1
 -1         1    9    0    1
 -2         0         1         4         3
 -3"""


def in_c(value: float) -> str:
    """12 characters of C: the exponent has two digits, or three where it needs them."""
    return f"{value:12.5E}"


def in_c_of_windows(value: float) -> str:
    """12 or 13 characters of C on older Windows: the exponent always has three digits."""
    mantissa, exponent = f"{value:.5E}".split("E")
    return f"{mantissa}E{int(exponent):+04d}"


def in_fortran(value: float) -> str:
    """12 characters of Fortran: three digits of the exponent leave no place for its letter."""
    text = f"{value:.5E}"
    has_three_digits = len(text.partition("E")[2]) == 4
    if has_three_digits:
        text = text.replace("E", "")
    return text.rjust(12)


NumberFormat = Callable[[float], str]


def result_lines(
    shapes: FloatArray, write: NumberFormat = in_c, *, analysis: int = 2, step: int = 1
) -> list[str]:
    """Modes at 100, 200, ... Hz as blocks of results."""
    lines = list[str]()
    for number, shape in enumerate(shapes, start=1):
        frequency = f"{100.0 * number:12.5E}"
        columns = f"           9{'':20}{analysis:2d}{number:5d}MODAL      1"
        lines.append(f"    1PSTEP{number:26d}           1{step:12d}")
        lines.append(f"  100CL{100 + number:5d}{frequency}{columns}")
        lines.append(" -4  DISP        4    1")
        for node, displacement in enumerate(shape):
            values = [write(float(value)) for value in displacement]
            lines.append(f" -1{node:10d}" + "".join(values))
        lines.append(" -3")
    return lines


RESULTS = result_lines(SHAPES)


def write_model(folder: Path, results: Sequence[str], touch: str = TOUCH) -> Path:
    """Write a model of nine nodes and one quadrilateral with results; return its name."""
    nodes = list[str]()
    for node in range(COUNT):
        row, column = divmod(node, 3)
        place = in_c(0.1 * column) + in_c(0.1 * row) + in_c(0.0)
        nodes.append(f" -1{node:10d}{place}")
    lines = [HEAD, *nodes, QUADRILATERAL, *results, " 9999", ""]
    (folder / "model.frd").write_text("\n".join(lines))
    (folder / "model.inp").write_text(touch)
    return folder / "model"


def check_refusal(model: Path, message: str) -> None:
    """Require that a model is refused with this part of a message."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        convert(model)
    assert message in str(caught.value)


@pytest.mark.parametrize("write", [in_c, in_c_of_windows, in_fortran])
def test_convert_reads_every_exponent_exactly(write: NumberFormat, tmp_path: Path) -> None:
    """Values from 1e-300 to 1e300 of both signs, which touch each other, are read to the digit."""
    rng = np.random.default_rng(3)
    exponents = rng.integers(-300, 300, (4, 9, 3))
    mantissas = rng.uniform(1, 10, exponents.shape)
    signs = rng.choice([-1, 1], exponents.shape)
    shapes = signs * mantissas * 10.0**exponents
    all_nodes = "*NSET, NSET=TOUCH, GENERATE\n0, 8\n"
    model = write_model(tmp_path, result_lines(shapes, write), all_nodes)

    modes = np.load(convert(model))

    expected = [float(f"{value:.5E}") for value in shapes.ravel()]
    np.testing.assert_array_equal(modes["shapes"].ravel(), expected)
    assert modes["frequencies"].tolist() == [100.0, 200.0, 300.0, 400.0]
    assert modes["faces"].tolist() == [[0, 1, 4, 3]]


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


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (".0", ",0", "model.frd:18: numbers must have decimal points, got commas in '1,00000E+02'"),
        ("DISP ", "DISPI", "modes must be real, got complex or cyclic modes"),
        (" 1.00000E+00", "         NaN", "model.frd:20: line must have 3 numbers such as -1.23"),
        ("MODAL      1", "MODAL      2", "model.frd:18: .frd file must be ASCII, got binary data"),
    ],
    ids=["decimal commas", "complex", "not a number", "binary"],
)
def test_convert_refuses_numbers_of_another_kind(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    """With the file, the line and the reason."""
    results = [line.replace(old, new) for line in RESULTS]
    model = write_model(tmp_path, results)

    check_refusal(model, message)


def test_convert_refuses_a_file_that_ends_early(tmp_path: Path) -> None:
    """As after a run that was interrupted."""
    model = write_model(tmp_path, RESULTS[:-3])
    check_refusal(model, "block must end with -3, got the end of the file")


@pytest.mark.parametrize(
    ("touch", "message"),
    [
        ("*NSET, NSET=FACE\n1\n", "must have the node set TOUCH, got FACE"),
        (
            "*NSET, NSET=TOUCH\n1, EDGE\n",
            "model.inp:2: node set must have whole numbers or names of earlier sets, got EDGE",
        ),
        (
            "*NSET, NSET=TOUCH, GENERATE\n1\n",
            "model.inp:2: GENERATE line must have a first number, a last number",
        ),
        (
            "*NSET, NSET=TOUCH, INSTANCE=A\n1\n*NSET, NSET=TOUCH, INSTANCE=B\n1\n",
            "node set TOUCH must belong to one instance, got A, B",
        ),
    ],
    ids=["no set", "unknown set", "short range", "two instances"],
)
def test_convert_refuses_an_unclear_node_set(touch: str, message: str, tmp_path: Path) -> None:
    """With the line and the reason."""
    model = write_model(tmp_path, RESULTS, touch)

    check_refusal(model, message)


LENGTH = 0.4
WIDTH = 0.3
THICKNESS = 3e-3
MODULUS = 70e9
POISSON = 0.22
DENSITY = 2500.0
RIG = """
surface: {modes: plate.npz, mass: 0.9 kg}
eras:
  SW: {at: [0.04, 0.04], stiffness: 30000, amplifier: main, channel: 0}
  SE: {at: [0.36, 0.04], stiffness: 30000, amplifier: main, channel: 1}
  NE: {at: [0.36, 0.26], stiffness: 30000, amplifier: main, channel: 2}
amplifiers: {main: {url: "sim://"}}
limits: {frequency: [40, 200]}
"""
COLUMNS, ROWS = 16, 12
"""Shell elements along the length and the width."""
NODES_OF_S8R = ((0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1))
"""Corners and midsides of an element in steps of half an element."""


def shell_nodes() -> dict[tuple[int, int], int]:
    """Numbers of the nodes by column and row, in steps of half an element; none amid an element."""
    numbers = dict[tuple[int, int], int]()
    for row in range(2 * ROWS + 1):
        for column in range(2 * COLUMNS + 1):
            if column % 2 == 0 or row % 2 == 0:
                numbers[column, row] = len(numbers) + 1
    return numbers


def plate_of_shells(support: str) -> str:
    """A plate of elements S8R; support: lines that hold its edges."""
    numbers = shell_nodes()
    lines = ["*NODE, NSET=ALL"]
    edge = ["*NSET, NSET=EDGE"]
    for (column, row), number in numbers.items():
        x = LENGTH * column / (2 * COLUMNS)
        y = WIDTH * row / (2 * ROWS)
        lines.append(f"{number}, {x:.9g}, {y:.9g}, 0")
        is_at_end = column in (0, 2 * COLUMNS)
        is_at_side = row in (0, 2 * ROWS)
        if is_at_end or is_at_side:
            edge.append(f"{number},")
    lines.append("*ELEMENT, TYPE=S8R, ELSET=PLATE")
    for element in range(COLUMNS * ROWS):
        row, column = divmod(element, COLUMNS)
        nodes = [element + 1]
        for across, up in NODES_OF_S8R:
            nodes.append(numbers[2 * column + across, 2 * row + up])
        lines.append(", ".join(map(str, nodes)))
    lines += edge
    lines += [f"*NSET, NSET=TOUCH, INSTANCE=PLATE-1, GENERATE\n1, {len(numbers)}, 1"]
    lines += ["*MATERIAL, NAME=GLASS", f"*ELASTIC\n{MODULUS}, {POISSON}", f"*DENSITY\n{DENSITY}"]
    lines += [f"*SHELL SECTION, ELSET=PLATE, MATERIAL=GLASS\n{THICKNESS}"]
    lines += [support] if support else []
    lines += ["*STEP", "*FREQUENCY", "24", "*NODE FILE, OUTPUT=2D", "U", "*END STEP", ""]
    return "\n".join(lines)


@pytest.mark.long
@pytest.mark.needs("ccx")
@pytest.mark.parametrize("support", ["", "*BOUNDARY\nEDGE, 1, 3"])
def test_plate_of_calculix_passes_without_notes(support: str, tmp_path: Path) -> None:
    """Free it has its mass, on simple supports Navier's frequencies; neither is suspicious."""
    (tmp_path / "plate.inp").write_text(plate_of_shells(support))
    subprocess.run(["ccx", "plate"], cwd=tmp_path, check=True, stdout=subprocess.DEVNULL)
    convert(tmp_path / "plate")
    text = RIG if support else RIG.replace(", mass: 0.9 kg", "")
    (tmp_path / "rig.yaml").write_text(text)

    rig = load_rig(tmp_path / "rig.yaml")

    assert rig.surface_notes == ()
    mass = DENSITY * LENGTH * WIDTH * THICKNESS
    assert rig.plate.mass == pytest.approx(mass, rel=2e-3)
    if support:
        rigidity = MODULUS * THICKNESS**3 / 12 / (1 - POISSON**2)
        speed = math.sqrt(rigidity / (DENSITY * THICKNESS))
        curvature = 1 / LENGTH**2 + 1 / WIDTH**2
        lowest = math.pi / 2 * curvature * speed
        frequencies = np.load(tmp_path / "plate.npz")["frequencies"]
        assert frequencies[0] == pytest.approx(lowest, rel=0.01)
