"""Templates in real size: lengths on paper, mirrored for the underside, no fonts, pages of A4."""

import re
from itertools import product
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from controller.cli.main import run
from model.figures import Template, _pages
from model.rig.rig_file import load_rig
from plates import write_rig

POINT = 25.4 / 72  # mm
SVG = "{http://www.w3.org/2000/svg}"
A4_POINTS = (210 / POINT, 297 / POINT)


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """The paper's plate with a foot of 6 mm radius under SW, 30 mm and 20 mm from its corner."""
    return write_rig(tmp_path / "rig.yaml", ("at: [0, 0]", "at: [30 mm, 20 mm], foot: 6 mm"))


def box(drawing: ElementTree.Element, name: str) -> np.ndarray:
    """Least and greatest x and y [mm] on paper of what has a name, from the top left."""
    (group,) = [each for each in drawing.iter(f"{SVG}g") if each.get("id") == name]
    numbers = re.findall(r"[-\d.]+", group.find(f"{SVG}path").get("d"))
    ends = np.array(numbers, dtype=float).reshape(-1, 2) * POINT
    return np.array([ends.min(axis=0), ends.max(axis=0)])


@pytest.mark.parametrize("side", ["below", "above"])
def test_a_sheet_has_the_lengths_of_the_board(rig: Path, tmp_path: Path, side: str) -> None:
    """Board 304.8 x 228.6 mm, ruler 100 mm, a circle of 12 mm at its place; x runs left below."""
    path = tmp_path / "template.svg"
    assert run(["plate", "template", str(rig), "--side", side, "-o", str(path)]) == 0
    drawing = ElementTree.parse(path).getroot()
    assert drawing.get("width").endswith("pt")
    shown = [float(drawing.get(key).removesuffix("pt")) for key in ("width", "height")]
    assert shown == pytest.approx([float(each) for each in drawing.get("viewBox").split()[2:]])
    board = box(drawing, "board")
    assert np.ptp(board, axis=0) == pytest.approx([304.8, 228.6], abs=0.01)
    assert np.ptp(box(drawing, "ruler"), axis=0) == pytest.approx([100, 0], abs=0.01)
    circle = box(drawing, "SW")
    assert np.ptp(circle, axis=0) == pytest.approx([12, 12], abs=0.1)
    x = board[1, 0] - 30 if side == "below" else board[0, 0] + 30
    assert circle.mean(axis=0) == pytest.approx([x, board[1, 1] - 20], abs=0.1)


def test_a_sheet_needs_no_font_and_is_the_same_bytes_again(rig: Path, tmp_path: Path) -> None:
    """Letters are outlines; neither a date nor random names; another circle is another file."""
    paths = [tmp_path / f"{name}.svg" for name in ("one", "two")]
    for path in paths:
        assert run(["plate", "template", str(rig), "-o", str(path)]) == 0
    one, two = (path.read_bytes() for path in paths)
    assert one == two
    assert b"<text" not in one
    assert b"font" not in one


def test_pages_of_a_pdf_are_a4_and_cover_the_board(rig: Path, tmp_path: Path) -> None:
    """A board of 305 x 229 mm takes two pages upright, by hand; sensors are counted as places."""
    sensors, path = tmp_path / "sensors.csv", tmp_path / "template.pdf"
    sensors.write_text("sensor,x_m,y_m,input,mv_per_m_s2\nP1,0.1,0.1,1,10\n", "utf-8")
    arguments = ["plate", "template", str(rig), "--sensors", str(sensors), "-o", str(path)]
    assert run(arguments) == 0
    pages = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", path.read_bytes())
    assert [tuple(map(float, each)) for each in pages] == [pytest.approx(A4_POINTS, abs=0.1)] * 2
    assert len(load_rig(rig).eras) == 4


def test_labels_keep_off_the_frames_of_pages(rig: Path) -> None:
    """Of places 11 mm apart all over the board; SW, on channel 0, is labelled with output 1."""
    places = product(np.arange(0.003, 0.3, 0.011), np.arange(0.003, 0.22, 0.011))
    sensors = {f"P{n}": (float(x), float(y)) for n, (x, y) in enumerate(places)}
    found = set()
    for page in _pages(Template(load_rig(rig), sensors)):
        page.canvas.draw()
        axes = page.axes[0]
        frame = axes.get_window_extent()
        for label in axes.texts:
            name, _, place = label.get_text().partition("\n")
            if place and frame.contains(*axes.transData.transform(label.xy)):
                letters = label.get_window_extent()
                assert frame.contains(*letters.min), name
                assert frame.contains(*letters.max), name
                found.add(name)
    assert found >= {*sensors, "SW, output 1"}


def test_sensor_off_the_board_is_refused(rig: Path, tmp_path: Path, capsys) -> None:
    """By its line, and with metres for the millimetres that were meant."""
    sensors = tmp_path / "sensors.csv"
    sensors.write_text("sensor,x_m,y_m\nP1,47,41\n", "utf-8")
    output = tmp_path / "template.svg"
    arguments = ["plate", "template", str(rig), "--sensors", str(sensors), "-o", str(output)]
    assert run(arguments) == 2
    assert re.search(r"sensors\.csv:2: sensor P1 .* 0\.047,0\.041", capsys.readouterr().err)
    assert not output.exists()


def test_grain_is_drawn_along_its_side(tmp_path: Path) -> None:
    """Plywood with its grain along the width has an arrow along y; a board without grain none."""
    shown = []
    for material in ("aluminium", "plywood\n  grain: length", "plywood\n  grain: width"):
        change = ("material: aluminium", f"material: {material}")
        made = write_rig(tmp_path / "rig.yaml", change, mesh="auto")
        shown.append(Template(load_rig(made), {}).grain)
    assert shown == [None, (1.0, 0.0), (0.0, 1.0)]
