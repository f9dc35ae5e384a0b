"""Maps of contrast, the summary of a table, the cost of tolerances, and export."""

import csv
import json
import math
from collections import defaultdict
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat
from typer.testing import CliRunner

import era_haptics as era
from controller.cli.config_cli import app as config_commands
from drivers.urls import CLOCK_ERRORS
from kit.plates import (
    FREQUENCIES,
    make_paper_rig,
    small_table,
    smooth_rig,
    smooth_table,
)
from kit.set_table import only
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import Point
from model.cli import app
from model.errors import InputError
from model.finger import Grid
from model.rig.rig import Channel, Rig, Uncertainty
from model.rig.rig_file import parse_rig
from model.structure.fingertips import Fingertip
from model.structure.plate import AirGap, Laminate, LaminateLayer
from model.study.contact_sets import random_contacts
from model.study.overview import find_overview, summarize
from model.study.promise_cost import (
    PromiseCost,
    ToleranceCosts,
    clock_cost,
    cost_rows,
    costs_of_tolerances,
    force_rows,
    uncertainty_costs,
)
from model.study.table_export import export_csv, export_mat
from model.study.weak_cells import (
    WeakCells,
    contrasts_of,
    find_weak_cells,
    pair_questions,
    text_map,
)
from model.table.table import LocalizationTable
from model.table.table_file import build_table

# Costs of tolerances

IDENTIFIED = Uncertainty(0.015, 1.5, 0.002, 0.01, 1.1, 0.5, modulus=0.0, place=0.0, harmonic=0.0)


def rig_on_amplifiers(names: str) -> Rig:
    """Return the paper's rig after an identification, with an amplifier for each ERA."""
    rig = replace(smooth_rig(), uncertainty=IDENTIFIED)
    wiring = {}
    for number, corner in enumerate(rig.eras):
        wiring[corner.name] = Channel(names[number], number)
    return replace(rig, wiring=wiring)


def test_contrast_falls_with_the_clock_error() -> None:
    """Of two amplifiers with two ERAs each; an amplifier with all of them loses nothing."""
    rig = rig_on_amplifiers("abab")

    costs = [clock_cost(rig, {"a": error, "b": error}) for error in (0.0, 2e-5, 2e-4, math.inf)]
    single = clock_cost(rig_on_amplifiers("aaaa"), {"a": math.inf})

    contrasts = [cost.kept_db for cost in costs]
    exact = costs[0].exact_db
    assert contrasts[0] == exact
    assert contrasts == sorted(contrasts, reverse=True)
    assert contrasts[1] > exact - 2
    assert contrasts[3] < exact - 2
    assert single == PromiseCost(exact, exact)


def test_only_uncertain_keys_cost_contrast() -> None:
    """Twice the tolerance costs more."""
    costs = []
    for stiffness in (0.0, 0.1, 0.2):
        uncertainty = replace(Uncertainty.none(), stiffness=stiffness)
        table = replace(smooth_table(), uncertainty=uncertainty)
        costs.append(costs_of_tolerances(table))

    exact, less, more = costs
    assert exact == {}
    assert list(less) == ["stiffness"]
    assert 0 < less["stiffness"] < more["stiffness"]


def test_contrast_of_two_fingers_is_one_figure() -> None:
    """In the overview of a table and in the check of its rig: the median of single queries."""
    rig = smooth_rig()
    table = build_table(rig, grid=Grid(6, 4))
    contrasts = []
    for questions in pair_questions(table, Grid(8, 6)):
        for placed in questions:
            contrast = query(table, placed, 20.0).fingers[0].promised_contrast_db
            assert contrast is not None
            contrasts.append(contrast)

    overview = summarize(table, find_overview(table))
    costs = uncertainty_costs(rig)

    assert costs is not None
    assert costs.promised_db == pytest.approx(np.median(contrasts), abs=0.1)
    assert overview["promised_contrast_1_quiet_median_db"] == costs.promised_db


def test_check_lists_costs_of_tolerances_and_what_to_measure() -> None:
    """Damping counts as a factor, of 1 if exact."""
    rig = replace(smooth_rig(), uncertainty=replace(Uncertainty.none(), damping=1.5, gain=0.1))
    costs = uncertainty_costs(rig)
    assert costs is not None

    first, *rows, last = cost_rows(rig.uncertainty, costs)

    assert f"{costs.promised_db:.1f} dB" in first
    assert set(costs.costs_db) == {"damping", "gain"}
    assert all(cost > 0 for cost in costs.costs_db.values())
    assert [row.split()[0] for row in rows] == list(costs.costs_db)
    assert last.startswith(f"{next(iter(costs.costs_db))} costs most, ")
    assert last.endswith("(era rig identify)")


def test_check_says_what_to_set_for_harder_touches() -> None:
    """The keys that it prints, if loads of fingers matter; a rig with these keys gets none."""
    identified = replace(smooth_rig(), uncertainty=IDENTIFIED)
    rows = force_rows(identified, ToleranceCosts(20.0, {"fingertip": 1.0}))
    assert force_rows(identified, ToleranceCosts(20.0, {"fingertip": 0.2})) == []

    _, tip, tolerance = [row.strip() for row in rows]

    text = RIG % "" + tip + "\n"
    rig = parse_rig("rig.yaml", text.replace("damping: 1.02}", "damping: 1.02, fingertip: 0.8}"))
    assert tolerance == "uncertainty: {fingertip: 0.8}"
    assert rig.fingertip == Fingertip(stiffness=1800.0, damping=3.6, contact_mass=0.00036)
    assert force_rows(rig, ToleranceCosts(20.0, {"fingertip": 1.0})) == []


RIG = """
plate: {length: 305 mm, width: 229 mm, thickness: 1.5 mm, material: aluminium}
mesh: 6x5 Q4
eras:
  SW: {at: [0, 0], stiffness: 17e3, amplifier: a, channel: 0}
  SE: {at: [305 mm, 0], stiffness: 17e3, amplifier: a, channel: 1}
  NW: {at: [0, 229 mm], stiffness: 17e3, amplifier: b, channel: 0}
  NE: {at: [305 mm, 229 mm], stiffness: 17e3, amplifier: b, channel: 1}
amplifiers:
  a: {url: "serial:///dev/ttyUSB0"}
  b: {url: "serial:///dev/ttyUSB1"%s}
limits: {frequency: [40 Hz, 250 Hz]}
uncertainty: {gain: 0.5 %%, phase_deg: 0.5, thickness: 0.1 %%, stiffness: 0.5 %%, damping: 1.02}
"""
USB_US = round(1e6 * math.hypot(CLOCK_ERRORS["ftdi-low-latency"], 5e-6 / math.sqrt(3)), 1)
"""Error over USB: that of the line, and 5 us / sqrt(3) of the amplifier."""


@pytest.mark.parametrize(
    ("keys", "error_us", "warning_count"), [("", USB_US, 1), (", clock_error: unknown", None, 2)]
)
@pytest.mark.usefixtures("assumed_costs")
def test_config_check_reports_the_cost_of_clock_errors(
    tmp_path: Path, keys: str, error_us: float | None, warning_count: int
) -> None:
    """And warns of an amplifier whose ERAs play alone."""
    path = tmp_path / "rig.yaml"
    path.write_text(RIG % keys)

    output = CliRunner().invoke(config_commands, ["config", "check", str(path), "--json"]).output

    report = json.loads(output)
    assert report["ok"]
    clocks = report["clocks"]
    assert clocks["error_us"] == {"a": USB_US, "b": error_us}
    assert clocks["kept_contrast_db"] < clocks["exact_contrast_db"]
    warnings = [warning for warning in report["warnings"] if "vibrations" in warning]
    assert len(warnings) == warning_count


# Export


@pytest.fixture(scope="module")
def table() -> LocalizationTable:
    """A small table."""
    return small_table()


def exported(table: LocalizationTable, folder: Path) -> Any:
    """Return a table's .mat file as MATLAB would read it."""
    path = folder / "t.mat"
    export_mat(table, path)
    return loadmat(path, squeeze_me=True, struct_as_record=False)["table"]


def test_export_mat_has_the_table_to_the_bit(table: LocalizationTable, tmp_path: Path) -> None:
    """Fields, modes and provenance, to the bit and in their shapes."""
    struct = exported(table, tmp_path)

    fields = table.unit_fields(table.raster.points)
    np.testing.assert_array_equal(struct.acceleration_m_s2.transpose(1, 2, 0), fields)
    np.testing.assert_array_equal(struct.frequency_hz, FREQUENCIES)
    np.testing.assert_array_equal(struct.mode_shape, table.shapes)
    np.testing.assert_array_equal(struct.cell_centre_m, table.cell_centers)
    assert len(struct.raster_x_m) * len(struct.raster_y_m) == len(struct.acceleration_m_s2)
    assert struct.fingerprint == table.fingerprint
    assert struct.mode == "switched"
    assert struct.plate.length_m == 0.3048
    assert struct.plate.material.E_pa == 70e9
    assert struct.plate.air_gap.size == struct.masses.size == 0
    assert struct.fingertip.phalanx_mass_kg == 0.005
    assert struct.uncertainty.thickness == 0.02
    assert [corner.name for corner in struct.eras] == ["SW", "SE", "NE", "NW"]
    assert [corner.stiffness_n_m for corner in struct.eras] == [17000.0] * 4
    assert struct.eras[2].x_m == 0.3048


def test_export_mat_has_layers_and_air(table: LocalizationTable, tmp_path: Path) -> None:
    """With the rows of a layer by frequency."""
    rows = ((1.0, 1.0, 0.1), (900.0, 2.0, 0.1))
    metal = table.plate.material
    layers = (LaminateLayer(metal, 0.001), LaminateLayer(metal, 0.0005, by_frequency=rows))
    gap = AirGap(0.002, closed=True)
    plate = replace(table.plate, laminate=Laminate(layers), air_gap=gap)

    struct = exported(replace(table, plate=plate), tmp_path).plate

    first, second = struct.laminate.layers
    assert first.thickness_m == 0.001
    assert first.by_frequency.size == 0
    assert second.thickness_m == 0.0005
    assert second.material.rho_kg_m3 == 2700.0
    np.testing.assert_array_equal(second.by_frequency, rows)
    assert struct.air_gap.depth_m == 0.002
    assert struct.air_gap.closed == 1


def csv_rows(table: LocalizationTable, folder: Path, content: str) -> list[dict[str, str]]:
    """Return the rows of a table's .csv file."""
    path = folder / "t.csv"
    export_csv(table, path, content=content)
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def place_of(row: dict[str, str], finger: str) -> Point:
    """Return the position of a finger in a row."""
    return float(row[f"{finger}_x_m"]), float(row[f"{finger}_y_m"])


@pytest.mark.parametrize(("mode", "is_switched"), [("switched", True), ("phased", False)])
def test_export_csv_has_answers_in_the_drive_mode_of_the_table(
    mode: str, is_switched: bool, tmp_path: Path
) -> None:
    """Each row has the promise of a query.

    Switched ERAs play at the same level, and at one or two frequencies; phased ERAs at the same
    frequency with levels and phases of their own.
    """
    table = replace(small_table(drive_mode=mode), grid=Grid(2, 2))

    rows = csv_rows(table, tmp_path, "patterns")

    assert len({place_of(row, "target") for row in rows}) == 4
    assert len(rows) > 4 * 4
    for row in rows[::9]:
        names = [corner.name for corner in table.eras if row[f"{corner.name}_hz"]]
        levels = {float(row[f"{name}_level"]) for name in names}
        frequencies = {row[f"{name}_hz"] for name in names}
        if is_switched:
            assert max(levels) == pytest.approx(min(levels))
            assert len(frequencies) <= 2
        else:
            assert len(names) == 4
            assert len(frequencies) == 1
        placed = Placement((place_of(row, "target"),), (place_of(row, "quiet"),))
        _, sensation = only(table, placed)
        assert float(row["promised_contrast_db"]) == sensation.promised_contrast_db
        assert float(row["promised_level_db_sl"]) >= 20 - 1e-3


def test_export_csv_has_fields(table: LocalizationTable, tmp_path: Path) -> None:
    """A row for each raster point and frequency, both parts of each ERA's field, to the bit."""
    rows = csv_rows(table, tmp_path, "fields")

    assert len(rows) == table.raster.point_count * 3
    row = rows[3 * 7 + 2]
    assert (float(row["x_m"]), float(row["y_m"])) == tuple(table.raster.points[7])
    assert row["frequency_hz"] == "250.0"
    field = complex(float(row["NE_real_m_s2"]), float(row["NE_imag_m_s2"]))
    assert np.complex64(field) == table.unit_fields(table.raster.points)[2, 2, 7]


# Contrast maps

QUIET = (0.2286, 0.0381)  # m; center of the fourth cell of the lowest row
MODES = ("switched", "phased")


@pytest.fixture(scope="module")
def phased_table() -> LocalizationTable:
    """A table of cells of 61 x 76 mm."""
    rig = make_paper_rig(12, 9)
    return build_table(rig, frequencies=FREQUENCIES, grid=era.Grid(5, 3), drive_mode="phased")


@pytest.fixture(scope="module")
def contrasts(phased_table: LocalizationTable) -> era.ContrastMap:
    """Its map for a quiet finger in both drive modes."""
    return era.contrast_map(phased_table, QUIET, drive_modes=MODES)


@pytest.mark.parametrize("mode", MODES)
def test_map_has_the_answer_of_every_place(
    phased_table: LocalizationTable, contrasts: era.ContrastMap, mode: str
) -> None:
    """Promised and nominal contrast of a query there; none at the quiet finger itself."""
    for row, column in product(range(3), range(5)):
        place = (contrasts.x[column], contrasts.y[row])
        promised = contrasts.promised_db[mode][row, column]
        if math.dist(place, QUIET) < 0.013:
            assert math.isnan(promised)
            continue
        answer = era.query(phased_table, place, quiet=[QUIET], drive_mode=mode)
        sensation = answer.fingers[0]
        assert promised == pytest.approx(sensation.promised_contrast_db, abs=1e-3), place
        nominal = contrasts.nominal_db[mode][row, column]
        assert nominal == pytest.approx(sensation.contrast_db, abs=1e-3), place


def test_map_is_a_frame(contrasts: era.ContrastMap) -> None:
    """Places along x come first, with a column for each mode and figure."""
    frame = contrasts.to_frame()

    assert frame.shape == (15, 6)
    promised = contrasts.promised_db["phased"]
    best = frame.loc[frame["phased_promised_db"].idxmax()]
    row, column = np.unravel_index(np.nanargmax(promised), promised.shape)
    assert best["x_m"] == contrasts.x[column]
    assert best["y_m"] == contrasts.y[row]


def test_command_prints_the_map(
    phased_table: LocalizationTable, contrasts: era.ContrastMap, tmp_path: Path
) -> None:
    """As JSON, with null for no answer."""
    path = tmp_path / "t.npz"
    era.save_table(phased_table, path)
    quiet = f"{QUIET[0]},{QUIET[1]}"
    arguments = ["table", "map", str(path), "--quiet", quiet, "--modes", ",".join(MODES)]

    output = CliRunner().invoke(app, [*arguments, "--json"]).stdout

    for mode, rows in json.loads(output)["promised_contrast_db"].items():
        printed = np.array(rows, dtype=float)
        np.testing.assert_allclose(printed, contrasts.promised_db[mode], rtol=0, atol=0.1)


# Weak cells


def test_weak_cells_have_percentiles_over_random_contrasts(table: LocalizationTable) -> None:
    """Half of a cell's contrasts are below its median, a tenth below the tenth percentile."""
    rng = np.random.default_rng(0)
    contrasts_of_cell = defaultdict(list)
    answers = []
    for questions in pair_questions(table):
        pairs = []
        for question in questions:
            contrast = float(rng.uniform(0, 30))
            contrasts_of_cell[question.targets[0]].append(contrast)
            pairs.append((contrast, 0.0))
        answers.append(pairs)

    weak = find_weak_cells(table, answers)

    assert len(contrasts_of_cell) == len(weak.centers) == 12
    for number, contrasts in enumerate(contrasts_of_cell.values()):
        values = np.array(contrasts)
        tolerance = 1.5 / len(values)
        assert np.mean(values < weak.median_db[number]) == pytest.approx(0.5, abs=tolerance)
        assert np.mean(values < weak.tenth_db[number]) == pytest.approx(0.1, abs=tolerance)


def test_quiet_fingers_of_a_cell_are_all_over_the_plate(table: LocalizationTable) -> None:
    """In different ones of 4 by 4 fields, at least 5 cm away.

    A place within 5 cm is in the target's field or a neighboring one.
    """
    length, width = table.plate.length, table.plate.width
    quiet_places = defaultdict(list)
    for questions in pair_questions(table):
        for question in questions:
            quiet_places[question.targets[0]].append(question.quiet[0])

    for target, places in quiet_places.items():
        points = np.array(places)
        assert np.linalg.norm(points - target, axis=1).min() >= 0.05
        counts, *_ = np.histogram2d(*points.T, bins=(4, 4), range=[(0, length), (0, width)])
        assert counts.max() == 1
        assert counts.sum() >= 16 - 4


@pytest.mark.parametrize(
    ("target", "mode"), [((0.1, 0.1), "swiched"), ((0.9, 0.1), None)], ids=["mode", "place"]
)
def test_wrong_questions_are_errors(
    table: LocalizationTable, target: Point, mode: str | None
) -> None:
    """A mistyped drive mode and a finger off the plate are not cells without an answer."""
    with pytest.raises(InputError):
        contrasts_of(table, Placement((target,), ((0.2, 0.2),)), drive_mode=mode)


def test_weak_and_feasible_follow_from_12_db() -> None:
    """Feasible by the median of other fingers, weak by a tenth; a text map shows both."""
    weak = WeakCells(
        Grid(2, 2),
        np.zeros((4, 2)),
        median_db=np.array([20.4, 12.0, -np.inf, 9.0]),
        tenth_db=np.array([12.0, 11.9, -np.inf, 5.0]),
        errors_db=np.zeros((2, 4)),
        pairs_db=np.empty((2, 0)),
    )

    assert weak.feasible.tolist() == [True, True, False, False]
    assert weak.weak.tolist() == [False, True, True, True]
    assert list(text_map(weak)) == ["   -*   9*", "  20   12*"]  # the largest y first


def test_fingers_do_not_fit_on_a_plate_narrower_than_a_fingertip() -> None:
    """25 mm between the edges leave no position that is 13 mm from both."""
    narrow = replace(smooth_rig().plate, width=0.025)

    with pytest.raises(InputError, match="larger plate"):
        random_contacts(np.random.default_rng(0), 1, narrow, margin=0.013)
