"""Figures of the paper, pictures of tables, and full-scale templates."""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.text import Annotation
from paper_figures import PaperFigure, paper_figures
from tables import tables

from era_haptics.command import run_era
from kit.plates import make_paper_rig, small_table, write_rig
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import FloatArray
from model.fem import Mesh
from model.figures.answers import answer_figure
from model.figures.contents import contents_figure
from model.figures.table_pictures import levels_figure
from model.finger import Grid
from model.rig.rig import Rig
from model.table.table_file import TableProblem, solve_table

# Templates

POINT = 25.4 / 72  # mm
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture
def rig_path(tmp_path: Path) -> str:
    """The paper's plate with a foot of 6 mm radius under SW, 30 mm and 20 mm from its corner."""
    change = ("at: [0, 0]", "at: [30 mm, 20 mm], foot: 6 mm")
    return str(write_rig(tmp_path / "rig.yaml", change))


def box_of(drawing: ElementTree.Element, name: str) -> FloatArray:
    """Return the lowest and highest x and y [mm] on paper of a group, from the top left."""
    (group,) = [group for group in drawing.iter(f"{SVG}g") if group.get("id") == name]
    numbers = re.findall(r"[-\d.]+", group.find(f"{SVG}path").get("d"))
    ends = np.array(numbers, dtype=float).reshape(-1, 2) * POINT
    return np.array([ends.min(axis=0), ends.max(axis=0)])


@pytest.mark.parametrize("side", ["below", "above"])
def test_template_has_the_lengths_of_the_board(rig_path: str, tmp_path: Path, side: str) -> None:
    """Board 304.8 x 228.6 mm, ruler 100 mm, a circle of 12 mm at its place; x runs left below."""
    path = tmp_path / "template.svg"

    assert run_era(["plate", "template", rig_path, "--side", side, "-o", str(path)]) == 0

    drawing = ElementTree.parse(path).getroot()
    size = [drawing.get("width"), drawing.get("height")]
    *_, width, height = drawing.get("viewBox").split()
    assert size == [f"{width}pt", f"{height}pt"]
    board = box_of(drawing, "board")
    assert np.ptp(board, axis=0) == pytest.approx([304.8, 228.6], abs=0.01)
    assert np.ptp(box_of(drawing, "ruler"), axis=0) == pytest.approx([100, 0], abs=0.01)
    circle = box_of(drawing, "SW")
    assert np.ptp(circle, axis=0) == pytest.approx([12, 12], abs=0.1)
    (west, _), (east, bottom) = board
    x = east - 30 if side == "below" else west + 30
    assert circle.mean(axis=0) == pytest.approx([x, bottom - 20], abs=0.1)


def test_pages_of_a_pdf_are_a4_and_cover_the_board(rig_path: str, tmp_path: Path) -> None:
    """By hand, a board of 305 x 229 mm takes two upright pages."""
    path = tmp_path / "template.pdf"

    assert run_era(["plate", "template", rig_path, "-o", str(path)]) == 0

    pages = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", path.read_bytes())
    sizes = np.array(pages, dtype=float) * POINT
    np.testing.assert_allclose(sizes, [[210, 297], [210, 297]], atol=0.04)


def test_sensor_off_the_board_is_refused_by_its_line(
    rig_path: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With meters for the millimeters that were meant."""
    sensors, path = tmp_path / "sensors.csv", tmp_path / "template.pdf"
    sensors.write_text("sensor,x_m,y_m\nP1,47,41\n", "utf-8")
    options = ["--sensors", str(sensors), "-o", str(path)]

    assert run_era(["plate", "template", rig_path, *options]) == 2

    assert re.search(r"sensors\.csv:2: sensor P1 .* 0\.047,0\.041", capsys.readouterr().err)
    assert not path.exists()
    sensors.write_text("sensor,x_m,y_m,input,mv_per_m_s2\nP1,0.1,0.1,1,10\n", "utf-8")
    assert run_era(["plate", "template", rig_path, *options]) == 0


# The paper


@pytest.fixture(scope="module")
def paper_rig() -> Rig:
    """The paper's rig, on a mesh that is near converged."""
    return make_paper_rig(48, 36)


@pytest.fixture(scope="module")
def figures(paper_rig: Rig) -> dict[str, PaperFigure]:
    """All figures of the paper's rig."""
    return {figure.name: figure for figure in paper_figures(paper_rig, "all")}


def peaks_of(figure: PaperFigure) -> dict[str, FloatArray]:
    """Return the maps of a figure as its CSV file has them, by column."""
    columns = figure.tables[""].items()
    return {name: np.asarray(column) for name, column in columns if name.startswith("peak_")}


@pytest.fixture(scope="module")
def paper_tables(paper_rig: Rig) -> dict[str, Mapping[str, FloatArray]]:
    """The tables of the paper's rig, by column."""
    return dict(tables(paper_rig))


@pytest.mark.parametrize(
    ("name", "frequencies"),
    [
        ("Table 1", [110.95, 234.16, 337.90, 454.29, 459.69]),
        ("Table 2", [31.98, 68.50, 76.62, 107.84, 160.77]),
    ],
)
def test_tables_are_those_of_the_paper(
    paper_tables: dict[str, Mapping[str, FloatArray]], name: str, frequencies: list[float]
) -> None:
    """Every digit on its mesh, rounded half up as 110.945; polynomials within 0.5 % of COMSOL."""
    columns = paper_tables[name]

    assert columns["paper"].tolist() == frequencies
    rounded = np.floor(100 * columns["12x9"] + 0.5) / 100
    assert rounded.tolist() == frequencies
    np.testing.assert_allclose(columns["model"], columns["COMSOL"], rtol=0.005)


def test_patterns_of_figure_12_leave_few_nulls(figures: dict[str, PaperFigure]) -> None:
    """Section 3.3: together the six leave under 5 % of the plate below 30 % of their maxima.

    Alone each leaves several times as much.
    """
    maps = peaks_of(figures["figure_12"])

    is_still = {name: peak < 0.3 * peak.max() for name, peak in maps.items()}
    assert len(maps) == 6
    assert 0 < np.all([*is_still.values()], axis=0).mean() < 0.05
    for name, cells in is_still.items():
        assert cells.mean() > 0.2, name
    # 300 and 100 Hz exchanged between opposite corners: the same map, rotated
    peak = maps["peak_300_100_hz_m_s2"]
    rotated = maps["peak_100_300_hz_m_s2"][::-1]
    np.testing.assert_allclose(peak, rotated, rtol=1e-5, atol=1e-5 * peak.max())


# Pictures of tables


def test_figure_of_levels_has_each_cell() -> None:
    """The first row of colors is the lowest y, and no cell of this plate is crossed out."""
    table = small_table()

    axes = levels_figure(table).axes[0]

    (mesh,) = axes.collections
    levels = mesh.get_array().reshape(3, 4)
    np.testing.assert_array_equal(levels, table.available_level_db_sl.reshape(3, 4))
    (crosses,) = [line for line in axes.lines if line.get_marker() == "x"]
    assert len(crosses.get_xdata()) == 0


def test_figure_of_no_answer_has_only_words() -> None:
    """For ERAs that move a nanometer."""
    table = small_table()
    eras = tuple(replace(era, stroke=1e-9) for era in table.eras)

    figure = answer_figure(replace(table, eras=eras))

    assert figure.axes == []


def test_labels_of_fingers_on_a_long_plate_do_not_overlap() -> None:
    """Three fingers on a plate of 4:1, where labels toward the middle overlap."""
    rig = make_paper_rig(12, 4)
    plate = replace(rig.plate, width=rig.plate.length / 4)
    eras = tuple(replace(era, y=min(era.y, plate.width)) for era in rig.eras)
    frequencies = np.arange(40.0, 500, 20)
    mesh = Mesh(12, 4, plate.length, plate.width)
    long_rig = replace(rig, plate=plate, eras=eras, mesh=mesh)
    problem = TableProblem(long_rig, frequencies, Grid(8, 2))
    table = solve_table(problem, drive_mode="phased", is_estimated=False)
    shares = [(0.3, 0.3), (0.8, 0.6), (0.4, 0.8)]
    fingers = [Finger((u * plate.length, v * plate.width), Stimulus()) for u, v in shares]
    answered = answer(table, fingers, min_contrast_db=-math.inf)

    figure = contents_figure(table, answered.layers, answered.promised_fingers)

    figure.draw_without_rendering()
    labels = [text for text in figure.axes[0].get_children() if isinstance(text, Annotation)]
    extents = [label.get_bbox_patch().get_window_extent() for label in labels]
    assert len(extents) == 3
    for number, extent in enumerate(extents):
        assert not extent.count_overlaps(extents[number + 1 :])
