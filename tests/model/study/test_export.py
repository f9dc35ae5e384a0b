"""Export of tables to .mat and .csv files."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from model.answer.stimulus import Placement
from model.errors import InputError
from model.finger import Grid
from model.structure.attachments import PointLoad
from model.structure.plate import AirGap, Laminate, LaminateLayer
from model.study import overview
from model.study.overview import export_csv, export_mat
from model.table.table_file import save_table
from plates import FREQUENCIES, small_table, with_strokes
from set_table import only


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
    np.testing.assert_array_equal(struct.cell_centre_m, table.cell_centres)
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


def test_export_mat_holds_names_of_sets_as_a_cell_array(table, tmp_path):
    """A column of strings, of one set too, beside the set of levels."""
    for names in (("pressing-fingertip", "vibrotactile-probe"), ("pressing-fingertip",)):
        export_mat(replace(table, promised_thresholds=names), tmp_path / "t.mat")
        struct = loadmat(tmp_path / "t.mat", struct_as_record=False)["table"][0, 0]
        assert struct.threshold.tolist() == ["vibrotactile-probe"]
        assert struct.promised_thresholds.shape == (len(names), 1)
        assert [each.item() for each in struct.promised_thresholds.flat] == list(names)


def test_export_mat_holds_layers_and_air(table, tmp_path):
    """A laminate is a struct with its layers, each with its material and rows by frequency."""
    metal, rows = table.plate.material, ((1.0, 1.0, 0.1), (900.0, 2.0, 0.1))
    layers = (LaminateLayer(metal, 0.001), LaminateLayer(metal, 0.0005, by_frequency=rows))
    plate = replace(table.plate, laminate=Laminate(layers), air_gap=AirGap(0.002, closed=True))
    export_mat(replace(table, plate=plate), tmp_path / "t.mat")
    struct = loadmat(tmp_path / "t.mat", squeeze_me=True, struct_as_record=False)["table"].plate
    assert (struct.air_gap.depth_m, struct.air_gap.closed) == (0.002, 1)
    first, second = struct.laminate.layers
    assert (first.thickness_m, first.material.rho_kg_m3) == (0.001, metal.rho)
    np.testing.assert_array_equal(second.by_frequency, rows)


def test_export_mat_holds_masses(table, tmp_path):
    """One mass is a struct of one, none is empty."""
    attachment_shapes = np.vstack([table.attachment_shapes, table.attachment_shapes[:1]])
    laden = replace(
        table, masses=(PointLoad(0.1, 0.15, mass=0.06),), attachment_shapes=attachment_shapes
    )
    export_mat(laden, tmp_path / "t.mat")
    struct = loadmat(tmp_path / "t.mat", squeeze_me=True, struct_as_record=False)["table"]
    assert struct.masses.mass_kg == 0.06
    assert struct.masses.y_m == 0.15
    export_mat(table, tmp_path / "t.mat")
    struct = loadmat(tmp_path / "t.mat", squeeze_me=True, struct_as_record=False)["table"]
    assert struct.masses.size == 0


def test_export_mat_refuses_a_table_too_large(table, tmp_path, monkeypatch):
    """Before anything is written; the error names a remedy."""
    monkeypatch.setattr(overview, "MAX_MAT_BYTES", 1000)
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


def test_format_page_names_everything_exported(struct, tmp_path, table):
    """Every field of the struct, every array and every key of the header."""
    page = (Path(__file__).parents[3] / "docs/reference/table-file.md").read_text("utf-8")
    names = [*struct._fieldnames]
    save_table(table, tmp_path / "t.npz")
    with np.load(tmp_path / "t.npz") as content:
        names += [*content, *json.loads(content["header"].tobytes())]
    assert [name for name in names if f"`{name}`" not in page] == []
