"""Maps of contrast, the summary of a table, the cost of clock errors, and export."""

import csv
import json
import math
from dataclasses import replace
from itertools import product
from pathlib import Path

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
    with_strokes,
)
from kit.set_table import only
from model.answer.stimulus import Placement
from model.cli import app
from model.errors import InputError
from model.finger import Grid
from model.rig.rig import Channel, Uncertainty
from model.structure.attachments import PointLoad
from model.structure.plate import AirGap, Laminate, LaminateLayer
from model.study import table_export
from model.study.overview import find_overview, summarize
from model.study.promise_cost import PromiseCost, clock_cost, tolerance_costs
from model.study.table_export import export_csv, export_mat
from model.study.weak_cells import (
    WeakCells,
    contrasts_of,
    find_weak_cells,
    map_grid,
    pair_questions,
    text_map,
)
from model.table.table_file import build_table

IDENTIFIED = Uncertainty(0.015, 1.5, 0.002, 0.01, 1.1, 0.5, modulus=0.0, place=0.0, harmonic=0.0)
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


def test_contrast_falls_with_the_error_and_stays_with_one_amplifier() -> None:
    """Two amplifiers of two ERAs each; one with all of them loses nothing whatever its clock."""
    rig = replace(smooth_rig(), uncertainty=IDENTIFIED)
    halves = {era.name: Channel("ab"[n % 2], n // 2) for n, era in enumerate(rig.eras)}
    both = replace(rig, wiring=halves)
    costs = [clock_cost(both, {"a": each, "b": each}) for each in (0.0, 2e-5, 2e-4, math.inf)]
    kept = [each.kept_db for each in costs]
    assert kept[0] == costs[0].exact_db
    assert kept == sorted(kept, reverse=True)
    assert kept[0] - kept[1] < 2 < kept[0] - kept[3]
    one = replace(rig, wiring={era.name: Channel("a", n) for n, era in enumerate(rig.eras)})
    assert clock_cost(one, {"a": math.inf}) == PromiseCost(costs[0].exact_db, costs[0].exact_db)


@pytest.mark.parametrize(
    ("more", "error_us", "warnings"), [("", USB_US, 1), (", clock_error: unknown", None, 2)]
)
def test_config_check_tells_what_clocks_cost(
    tmp_path: Path, more: str, error_us: float | None, warnings: int
) -> None:
    """Over USB: that of the line, and 5 us / sqrt(3) of the amplifier; and which plays alone."""
    (tmp_path / "rig.yaml").write_text(RIG % more)
    ran = CliRunner().invoke(
        config_commands, ["config", "check", str(tmp_path / "rig.yaml"), "--json"]
    )
    found = json.loads(ran.output)
    assert found["ok"]
    clocks = found["clocks"]
    assert clocks["error_us"] == {"a": USB_US, "b": error_us}
    assert clocks["kept_contrast_db"] < clocks["exact_contrast_db"]
    assert len([each for each in found["warnings"] if "vibrations" in each]) == warnings


def test_tolerance_costs_name_the_uncertain_keys_and_grow_with_them() -> None:
    """Only keys that are uncertain cost contrast, and twice the tolerance costs more."""
    table = smooth_table()
    costs = []
    for stiffness in (0.1, 0.2):
        uncertainty = replace(Uncertainty.none(), stiffness=stiffness)
        costs.append(tolerance_costs(replace(table, uncertainty=uncertainty)))
    assert [*costs[0]] == ["stiffness"]
    assert 0 < costs[0]["stiffness"] < costs[1]["stiffness"]
    assert tolerance_costs(replace(table, uncertainty=Uncertainty.none())) == {}


@pytest.fixture(scope="module")
def table():
    """A small one."""
    return small_table()


@pytest.fixture
def struct(table, tmp_path):
    """Its .mat file as MATLAB would see it."""
    export_mat(table, tmp_path / "t.mat")
    return loadmat(tmp_path / "t.mat", squeeze_me=True, struct_as_record=False)["table"]


def read_csv(path):
    """Rows as dictionaries of text."""
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_export_mat_holds_the_table_to_the_bit(table, struct):
    """Fields, modes and provenance, to the bit and in their shapes."""
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
    assert struct.plate.air_gap.size == 0
    assert (struct.fingertip.phalanx_mass_kg, struct.uncertainty.thickness) == (0.005, 0.02)
    assert [era.name for era in struct.eras] == ["SW", "SE", "NE", "NW"]
    assert [era.stiffness_n_m for era in struct.eras] == [17000.0] * 4
    assert struct.eras[2].x_m == 0.3048


ROWS = ((1.0, 1.0, 0.1), (900.0, 2.0, 0.1))


def of_layers(table):
    """The plate of the table of two layers, over air."""
    metal = table.plate.material
    layers = LaminateLayer(metal, 0.001), LaminateLayer(metal, 0.0005, by_frequency=ROWS)
    return replace(table.plate, laminate=Laminate(layers), air_gap=AirGap(0.002, closed=True))


@pytest.mark.parametrize(
    ("changes", "read", "expected"),
    [
        (
            lambda table: {"plate": of_layers(table)},
            lambda found: [
                (each.thickness_m, each.material.rho_kg_m3, np.ravel(each.by_frequency).tolist())
                for each in found.plate.laminate.layers
            ],
            [(0.001, 2700.0, []), (0.0005, 2700.0, np.ravel(ROWS).tolist())],
        ),
        (
            lambda table: {"plate": of_layers(table)},
            lambda found: (found.plate.air_gap.depth_m, found.plate.air_gap.closed),
            (0.002, 1),
        ),
        (
            lambda table: {
                "masses": (PointLoad(0.1, 0.15, mass=0.06),),
                "attachment_shapes": np.vstack(
                    [table.attachment_shapes, table.attachment_shapes[:1]]
                ),
            },
            lambda found: (found.masses.mass_kg, found.masses.y_m),
            (0.06, 0.15),
        ),
        (lambda _: {}, lambda found: found.masses.size, 0),
    ],
    ids=["layers", "air", "a mass", "no mass"],
)
def test_export_mat_holds_what_some_tables_have(table, tmp_path, changes, read, expected):
    """A laminate with the rows of its layers, air, masses: of one a struct, of none nothing."""
    export_mat(replace(table, **changes(table)), tmp_path / "t.mat")
    found = loadmat(tmp_path / "t.mat", squeeze_me=True, struct_as_record=False)["table"]
    assert read(found) == expected


def test_export_mat_refuses_a_table_too_large(table, tmp_path, monkeypatch):
    """Before anything is written; the error names a remedy."""
    monkeypatch.setattr(table_export, "MAX_MAT_BYTES", 1000)
    with pytest.raises(InputError, match="numpy"):
        export_mat(table, tmp_path / "t.mat")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("drive_mode", ["switched", "phased"])
def test_export_csv_of_patterns_holds_answers_in_the_drive_mode_of_the_table(drive_mode, tmp_path):
    """In each row the levels of the ERAs, asked anew, give the promised level and contrast.

    In mode `switched` ERAs play at one level, and at one frequency or two; in `phased` at one
    frequency with levels and phases of their own.
    """
    table = replace(small_table(drive_mode=drive_mode), grid=Grid(2, 2))
    export_csv(table, tmp_path / "t.csv", content="patterns")
    rows = read_csv(tmp_path / "t.csv")
    assert len({(row["target_x_m"], row["target_y_m"]) for row in rows}) == 4
    assert len(rows) > 4 * 4
    names = [era.name for era in table.eras]
    for row in rows[::9]:
        levels = {float(row[f"{name}_level"]) for name in names if row[f"{name}_level"]}
        driven = [name for name in names if row[f"{name}_hz"]]
        frequencies = {row[f"{name}_hz"] for name in driven}
        if drive_mode == "switched":
            assert max(levels) == pytest.approx(min(levels))
            assert len(frequencies) <= 2
        else:
            assert (len(driven), len(frequencies)) == (4, 1)
        target, quiet = (
            (float(row[f"{finger}_x_m"]), float(row[f"{finger}_y_m"]))
            for finger in ("target", "quiet")
        )
        _, felt = only(table, Placement((target,), (quiet,)))
        assert float(row["promised_contrast_db"]) == felt.promised_contrast_db
        assert float(row["promised_level_db_sl"]) >= 20 - 1e-3
    weak = replace(with_strokes(table, 1e-6), grid=Grid(1, 2))
    export_csv(weak, tmp_path / "weak.csv", content="patterns")
    assert all(not row["SW_level"] for row in read_csv(tmp_path / "weak.csv"))


def test_export_csv_of_fields(table, tmp_path):
    """A row for each raster point and frequency, both parts of each ERA's field, to the bit."""
    export_csv(table, tmp_path / "t.csv", content="fields")
    rows = read_csv(tmp_path / "t.csv")
    assert len(rows) == table.raster.point_count * 3
    row = rows[3 * 7 + 2]
    assert float(row["x_m"]) == table.raster.points[7, 0]
    assert float(row["y_m"]) == table.raster.points[7, 1]
    assert row["frequency_hz"] == "250.0"
    found = np.complex64(complex(float(row["NE_real_m_s2"]), float(row["NE_imag_m_s2"])))
    assert found == table.unit_fields(table.raster.points)[2, 2, 7]


QUIET = (0.2286, 0.0381)  # m; center of the fourth cell of the lowest row
MODES = ("switched", "phased")


def test_map_has_the_answer_of_every_place(tmp_path: Path) -> None:
    """Promised and nominal contrast of a query there; none where the quiet finger itself is.

    Of both drive modes side by side, in cells of 61 x 76 mm. As a frame, as pandas has it, places
    along x come first, with a column for each mode and number. The command prints it as JSON, with
    null for no answer.
    """
    table = build_table(
        make_paper_rig(12, 9), frequencies=FREQUENCIES, grid=era.Grid(5, 3), drive_mode="phased"
    )
    found = era.contrast_map(table, QUIET, drive_modes=MODES)
    for (row, y), (column, x) in product(enumerate(found.y), enumerate(found.x)):
        far = math.dist((x, y), QUIET) >= 0.013
        for mode in MODES:
            promised = found.promised_db[mode][row, column]
            assert np.isfinite(promised) == far
            if far:
                felt = era.query(table, (x, y), quiet=[QUIET], drive_mode=mode).fingers[0]
                assert promised == pytest.approx(felt.promised_contrast_db, abs=1e-3)
                nominal = found.nominal_db[mode][row, column]
                assert nominal == pytest.approx(felt.contrast_db, abs=1e-3)

    frame = found.to_frame()
    assert frame.shape == (15, 6)
    best = frame.loc[frame["phased_promised_db"].idxmax()]
    row, column = np.unravel_index(np.nanargmax(found.promised_db["phased"]), (3, 5))
    assert (best["x_m"], best["y_m"]) == (found.x[column], found.y[row])

    era.save_table(table, tmp_path / "t.npz")
    words = ["map", str(tmp_path / "t.npz"), "--quiet", "{},{}".format(*QUIET), "--json"]
    result = CliRunner().invoke(app, ["table", *words, "--modes", ",".join(MODES)])
    for mode, rows in json.loads(result.stdout)["promised_contrast_db"].items():
        expected = pytest.approx(found.promised_db[mode], abs=0.1, nan_ok=True)
        assert np.array(rows, dtype=float) == expected


def test_weak_cells_take_percentiles_over_fingers_all_over_the_plate(table):
    """Half of a cell's contrasts are below its median, a tenth below the other.

    Its other fingers are in different ones of 4 by 4 fields, at least 5 cm from the cell.
    """
    rng = np.random.default_rng(0)
    drawn: dict[tuple[float, float], list[float]] = {}
    tried: dict[tuple[float, float], list[tuple[float, float]]] = {}

    def at_random(question):
        (target,), (other,) = question.targets, question.quiet
        assert math.dist(target, other) >= 0.05
        tried.setdefault(target, []).append(other)
        drawn.setdefault(target, []).append(float(rng.uniform(0, 30)))
        return drawn[target][-1], 0.0

    weak = find_weak_cells(table, [[*map(at_random, each)] for each in pair_questions(table)])
    assert len(drawn) == len(weak.centers) == 12
    for values, share in ((weak.median_db, 0.5), (weak.tenth_db, 0.1)):
        for value, contrasts in zip(values, drawn.values(), strict=True):
            below = (np.array(contrasts) < value).mean()
            assert below == pytest.approx(share, abs=1.5 / len(contrasts))
    size = (table.plate.length, table.plate.width)
    for target, others in tried.items():
        counts, *_ = np.histogram2d(
            *np.array(others).T, bins=(4, 4), range=[(0, side) for side in size]
        )
        assert counts.max() == 1
        assert counts.sum() >= 16 - 4  # a place within 5 cm is in the target's field or beside it
        (x, y) = target
        mirrored = np.array(tried[min(tried, key=lambda at: math.dist(at, (size[0] - x, y)))])
        np.testing.assert_allclose(
            sorted(size[0] - mirrored[:, 0]), sorted(x for x, _ in others), atol=1e-12
        )


def test_wrong_questions_are_errors_and_not_silent_cells(table):
    """A mistyped drive mode, and a finger off the plate."""
    for target, mode in (((0.1, 0.1), "swiched"), ((0.9, 0.1), None)):
        with pytest.raises(InputError):
            contrasts_of(table, Placement((target,), ((0.2, 0.2),)), drive_mode=mode)


def test_weak_and_feasible_follow_from_twelve_decibels(table):
    """Feasible by the median other finger, weak by one in ten; a text map shows both.

    A cell of the map is no smaller than an eighth by a sixth of the plate.
    """
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
    assert map_grid(replace(table, grid=Grid(24, 5))) == Grid(8, 5)
    assert map_grid(replace(table, grid=Grid(4, 20))) == Grid(4, 6)


def test_summary_of_a_plate_too_small_for_two_fingers():
    """Where no two fingers fit 5 cm apart the distribution is empty, not an endless loop."""
    rig = make_paper_rig(6, 6)
    small = replace(
        rig,
        plate=replace(rig.plate, length=0.03, width=0.03),
        mesh=replace(rig.mesh, length=0.03, width=0.03),
        eras=tuple(replace(era, x=0.03 * (era.x > 0), y=0.03 * (era.y > 0)) for era in rig.eras),
    )
    built = build_table(small, frequencies=np.array([110.0]), grid=Grid(2, 2))
    summary = summarize(built, find_overview(built))
    assert summary["promised_contrast_1_quiet_median_db"] is None
    assert summary["feasible_share"] is None
