"""Files of measured frequency responses, and the loss factor that they show of a viscous plate."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyuff

from model.arrays import ComplexArray
from model.errors import InputError
from model.estimate.measurement import Measurement, sensors_at
from model.response_files import (
    measurement_of,
    read_measured,
    write_responses_csv,
    write_responses_uff,
)
from model.rig.rig import Rig
from model.structure.exciter import Exciter

# Files that are read

WRITERS = {"csv": write_responses_csv, "uff": write_responses_uff}
only_csv = pytest.mark.parametrize("ending", ["csv"])
only_uff = pytest.mark.parametrize("ending", ["uff"])


@pytest.fixture
def responses() -> Measurement:
    """Three sensors, three frequencies, two of four ERAs; one value was not measured."""
    rng = np.random.default_rng(4)
    values = np.full((3, 3, 4), np.nan, dtype=complex)
    values[..., :2] = 1e5 * (rng.standard_normal((3, 3, 2, 2)) @ [1, 1j])
    values[1, 2, 0] = np.nan
    points = np.array([[0.1, 0.05], [0.2, 0.15], [0.3048, 0.2286]])
    sensors = sensors_at(points, ("P1", "P2", "rim"))
    return Measurement(sensors, np.array([50.0, 110.25, 320.0]), values)


@pytest.fixture(params=WRITERS)
def ending(request: pytest.FixtureRequest) -> str:
    """Each kind of file."""
    return str(request.param)


@pytest.fixture
def path(ending: str, responses: Measurement, coarse_rig: Rig, tmp_path: Path) -> Path:
    """A file of these responses."""
    file = tmp_path / f"measured.{ending}"
    WRITERS[ending](file, responses, coarse_rig)
    return file


def values_read(path: Path, rig: Rig, names: Sequence[str]) -> ComplexArray:
    """The values of a file in the order of these sensors."""
    measurement = measurement_of(read_measured(path), rig)
    order = [measurement.names.index(name) for name in names]
    return measurement.values[:, order]


def with_masses(measurement: Measurement, masses: Sequence[float]) -> Measurement:
    """The same at sensors that have a mass [kg]."""
    sensors = [
        replace(sensor, mass=mass) for sensor, mass in zip(measurement.sensors, masses, strict=True)
    ]
    return replace(measurement, sensors=sensors)


def test_responses_are_read_as_they_were_written(responses, coarse_rig, path):
    """Sensors, positions, frequencies and complex values, gaps among them."""
    measurement = measurement_of(read_measured(path), coarse_rig)

    order = [measurement.names.index(name) for name in responses.names]
    np.testing.assert_allclose(measurement.points[order], responses.points, rtol=1e-12)
    np.testing.assert_array_equal(measurement.frequencies, responses.frequencies)
    np.testing.assert_allclose(measurement.values[:, order], responses.values, rtol=1e-11)
    assert measurement.count == 17


def test_uff_of_another_program_is_read(coarse_rig: Rig, tmp_path: Path) -> None:
    """Written by pyuff alone: single precision, nodes as dataset 15, no names, sensor upside down.

    ERAs are identified by the positions of their nodes.
    """
    nodes = pyuff.prepare_15(
        node_nums=[7, 40],
        def_cs=[0, 0],
        disp_cs=[0, 0],
        color=[0, 0],
        x=[0.1, 0.3048],
        y=[0.05, 0.0],
        z=[0.0, 0.0],
    )
    record = pyuff.prepare_58(
        func_type=4,
        rsp_node=7,
        rsp_dir=-3,
        ref_node=40,
        ref_dir=3,
        ord_data_type=5,
        num_pts=3,
        abscissa_spacing=1,
        abscissa_min=50.0,
        abscissa_inc=10.0,
        abscissa_spec_data_type=18,
        ordinate_spec_data_type=12,
        ordinate_axis_units_lab="m/s**2",
        orddenom_spec_data_type=8,
        x=np.array([50.0, 60.0, 70.0]),
        data=np.array([1 + 2j, 3 - 1j, -250 + 0.5j]),
    )
    path = tmp_path / "other.unv"
    pyuff.UFF(str(path)).write_sets([nodes, record], "overwrite", force_double=False)

    measurement = measurement_of(read_measured(path), coarse_rig)

    assert measurement.names == ("node:7",)
    np.testing.assert_allclose(measurement.frequencies, [50, 60, 70])
    expected = np.full((3, 4), np.nan, dtype=complex)
    expected[:, 1] = [-1 - 2j, -3 + 1j, 250 - 0.5j]
    np.testing.assert_allclose(measurement.values[:, 0], expected, rtol=1e-5)


# pyuff does not close a file that it has written bytes to.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@only_uff
def test_binary_uff_is_read_and_damage_is_rejected(
    responses: Measurement, coarse_rig: Rig, path: Path, tmp_path: Path
) -> None:
    """Binary records (58b) are read to the last bit; other formats are rejected."""
    sets = pyuff.UFF(str(path)).read_sets()
    for record in sets[2:]:
        record.update(binary=1, n_bytes=0)
    binary = tmp_path / "binary.uff"
    pyuff.UFF(str(binary)).write_sets(sets, "overwrite")

    values = values_read(binary, coarse_rig, responses.names)

    np.testing.assert_allclose(values, responses.values, rtol=1e-11)
    content = binary.read_bytes()
    end = content.rindex(b"    -1")
    size = re.findall(rb"58b.*?(\d+)     0", content)[0]
    beyond_record = b"%d" % (int(size) + 8)
    damaged_files = {
        "too short": content[: end - 24] + b"\n" + content[end:],
        "too large": content.replace(size, beyond_record, 1),
        "garbage": content[:end] + b"7\r\n" + content[end:],
        "floating point of DEC VMS": re.sub(rb"(58b +\d +)2", rb"\g<1>1", content, count=1),
    }
    for damage, damaged in damaged_files.items():
        binary.write_bytes(damaged)
        with pytest.raises(InputError, match=r"binary\.uff:?\d*: "):
            pytest.fail(f"{damage}: read {read_measured(binary)}")


@only_csv
@pytest.mark.parametrize(
    ("replacements", "encoding"),
    [
        ({",": ";"}, "utf-8"),
        ({",": ";", ".": ","}, "utf-8"),
        ({",": "\t"}, "utf-16"),
        ({"\n": "\r"}, "utf-8"),
        ({",-": ",\N{MINUS SIGN}"}, "utf-8"),
    ],
    ids=["semicolons", "decimal commas", "tabs", "old line ends", "minus signs"],
)
def test_csv_of_a_spreadsheet_is_read(
    responses, coarse_rig, path, replacements: dict[str, str], encoding: str
):
    """Separators, decimal commas, line ends and UTF-16."""
    text = path.read_text("utf-8")
    for old, new in replacements.items():
        text = text.replace(old, new)
    path.write_bytes(text.encode(encoding))

    values = values_read(path, coarse_rig, responses.names)

    np.testing.assert_array_equal(values, responses.values)


@only_csv
@pytest.mark.parametrize(
    ("first_rows", "last_row"),
    [("sep=;\r\n", ""), (" \r\n", ";;;;;;;;;\n"), ("\r\n;;\r\n", "")],
    ids=["separator stated", "empty rows", "empty first rows"],
)
def test_empty_rows_of_a_spreadsheet_are_skipped(
    responses, coarse_rig, path, first_rows: str, last_row: str
):
    """Rows without values can be at the beginning and at the end."""
    rows = path.read_text("utf-8").replace(",", ";")
    path.write_bytes(f"{first_rows}{rows}{last_row}".encode())

    values = values_read(path, coarse_rig, responses.names)

    np.testing.assert_array_equal(values, responses.values)


@only_uff
@pytest.mark.parametrize(
    ("label", "denominator", "factor"),
    [
        ("m/s²", "m", 1.0),
        ("(m/s^2)", "m", 1.0),
        ("m s-2", "m", 1.0),
        ("g", "m", 9.80665),
        ("mm/s2", "m", 1e-3),
        ("in/s2", "m", 0.0254),
        ("mm/s/s", "mm", 1.0),
        ("gn", "um", 9.80665e6),
        ("g", "µm", 9.80665e6),
        ("in/s/s", "in", 1.0),
    ],
)
def test_uff_values_are_in_the_units_of_their_labels(
    responses, coarse_rig, path, label: str, denominator: str, factor: float
):
    """Acceleration over displacement, as the labels of dataset 58 state."""
    text = path.read_text("ascii").replace("m/s^2".ljust(20), label.ljust(20))
    text = text.replace(" m".ljust(21), f" {denominator}".ljust(21))
    path.write_bytes(text.encode("utf-8" if denominator == "µm" else "latin-1"))

    values = values_read(path, coarse_rig, responses.names)

    np.testing.assert_allclose(values, factor * responses.values, rtol=1e-11)


@only_uff
@pytest.mark.parametrize(
    ("line_end", "encoding"),
    [("\r\n", "latin-1"), ("\r", "latin-1"), ("\n", "utf-8-sig"), ("\r\n", "utf-16")],
)
def test_uff_of_fortran_and_editors_is_read(
    responses, coarse_rig, path, line_end: str, encoding: str
):
    """Exponents E and D, values beyond the stated number, line ends and encodings of editors."""
    lines = path.read_text("ascii").splitlines()
    value_lines = [
        number
        for number, line in enumerate(lines)
        if re.fullmatch(r"( +-?\d\.\d+e[+-]\d+){3}", line)
    ]
    for number in value_lines:
        lines[number] = lines[number].replace("e", "D" if number % 2 else "E")
    lines[value_lines[-1]] += "  0.00000e+00  0.00000e+00"  # fills the last line
    record_start = [line.strip() for line in lines].index("58")
    lines[record_start + 1] = "an offset of    -1"
    path.write_bytes(line_end.join(lines).encode(encoding))

    values = values_read(path, coarse_rig, responses.names)

    np.testing.assert_allclose(values, responses.values, rtol=1e-11)


@only_uff
@pytest.mark.parametrize(
    ("label", "factor"), [("NONE", 1.0), ("kHz", 1000.0), ("rad/s", 0.15915494309)]
)
def test_uff_frequencies_are_in_the_unit_of_their_label(responses, path, label, factor):
    """One radian a second is 1/(2 pi) Hz."""
    path.write_text(path.read_text("ascii").replace("Hz   ", label.ljust(5)), "ascii")

    frequencies = sorted({value.frequency for value in read_measured(path)})

    np.testing.assert_allclose(frequencies, factor * responses.frequencies, rtol=1e-9)


@only_csv
def test_values_beyond_the_limits_are_left_out(coarse_rig, path, caplog):
    """0 Hz and frequencies above the rig's highest one are skipped and counted."""
    path.write_text(path.read_text("utf-8").replace(",50.0,", ",0.0,"), "utf-8")

    measurement = measurement_of(read_measured(path), coarse_rig)

    assert measurement.frequencies.tolist() == [110.25, 320.0]
    assert (measurement.skipped, measurement.count) == (6, 11)
    assert "6 of 17" in caplog.text


# Files that are rejected


def damage(path: Path, old: str, new: str) -> None:
    """Replace the first occurrence of a part of a file."""
    text = path.read_bytes().decode()
    assert old in text
    path.write_bytes(text.replace(old, new, 1).encode("latin-1"))


@only_csv
@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("x_m,y_m,freq", "x_mm,y_mm,freq", r":1: .*x_m, y_m missing.*'x_mm'"),
        ("real_1_s2", "real_g_m", r":1: .*real_1_s2 missing; 'real_g_m' unknown"),
        ("era_x_m", "sensor", r":1: "),
        (",50.0,", ",fifty,", r":2: frequency_hz .*'fifty'"),
        (",50.0,", ",nan,", r":2: frequency_hz .*'nan'"),
        (",50.0,", ",-50.0,", r":2: frequency_hz .*-50"),
        (",50.0,", ",50.0,1.0,", r":2: .*10"),
        ("\nSW,", "\n,", r":2: era"),
        (",0.1,0.05,", ",0.11,0.05,", r":\d+: sensor P1"),
        ("\nSW,", "\n\xff,", "UTF-8"),
        ("\nSW,", '\n"SW,', r":\d+: "),
        ("\nSW,", "\n\0SW,", "zero bytes"),
    ],
)
def test_damaged_csv_is_rejected_with_its_line(coarse_rig, path, old, new, error):
    """Unknown columns, invalid values and broken rows."""
    damage(path, old, new)

    with pytest.raises(InputError, match=rf"measured\.csv.*{error}"):
        measurement_of(read_measured(path), coarse_rig)


@only_uff
@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("m/s^2", "cm/s2", ".*'cm/s2'"),
        ("Hz   ", "RPM  ", "unit must be .*'RPM'"),
        ("        12    0", "        11    0", ".*11 over 8"),
        ("         8    0", "        13    0", ".*12 over 13"),
        ("         6         3", "         6         4", ".*12"),
        ("  5.00000e+01", "  x.00000e+01", ".*'x.00000e"),
        ("         1   3 ", "         1   1 ", ".*1 and 3"),
        ("         1         0         0", "         1         0         7", ".* node 1"),
        ("\n    -1\n", "\n    -3\n", ""),
        ("NONE", "\n    -1\n    -1\n    58\nNONE", ""),  # a record without its header
    ],
)
def test_damaged_uff_is_rejected_with_its_line(coarse_rig, path, old, new, error):
    """Wrong units, invalid values and broken records."""
    damage(path, old, new)

    with pytest.raises(InputError, match=rf"measured\.uff:\d+: {error}"):
        measurement_of(read_measured(path), coarse_rig)


def test_files_without_measurements_are_rejected(path, monkeypatch):
    """An empty file, text, a file cut off or too large, no file, and an unknown ending."""
    content = path.read_bytes()
    monkeypatch.setattr("model.files.uff.MAX_UFF_BYTES", len(content) - 1)
    text = b"Dear all, the measurement was a success.\n"

    for damaged in (b" \n", text, content[:-30]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=path.name):
            read_measured(path)
    path.write_bytes(content)
    with pytest.raises(InputError, match="MiB"):
        read_measured(path)
    path.unlink()
    with pytest.raises(InputError, match=path.name):
        read_measured(path)
    with pytest.raises(InputError, match=r"\.csv, \.uff"):
        read_measured(path.with_suffix(".mat"))


def on_a_smaller_plate(rig: Rig) -> Rig:
    """A plate that does not reach to the sensor at the rim."""
    plate = replace(rig.plate, length=0.25, width=0.2)
    eras = [replace(era, x=min(era.x, 0.25), y=min(era.y, 0.2)) for era in rig.eras]
    return replace(rig, plate=plate, eras=tuple(eras))


def with_moved_eras(rig: Rig) -> Rig:
    """ERAs elsewhere."""
    return replace(rig, eras=tuple(replace(era, x=0.9 * era.x) for era in rig.eras))


def with_other_eras(rig: Rig) -> Rig:
    """ERAs of other names, elsewhere."""
    eras = [replace(era, name=f"X{era.name}", x=0.1 + era.x / 3) for era in rig.eras]
    return replace(rig, eras=tuple(eras))


def with_low_limits(rig: Rig) -> Rig:
    """A rig for frequencies below those of the file."""
    return replace(rig, limits=replace(rig.limits, frequency_max=45.0))


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (on_a_smaller_plate, "sensor rim"),
        (with_moved_eras, "ERA SE"),
        (with_other_eras, "ERA.* SW"),
        (with_low_limits, "50 Hz"),
    ],
)
def test_responses_of_another_plate_are_rejected(
    coarse_rig: Rig, path: Path, change: Callable[[Rig], Rig], error: str
) -> None:
    """Sensors and ERAs must be where the file says, within the limits."""
    with pytest.raises(InputError, match=rf"{path.name}:\d+: .*{error}"):
        measurement_of(read_measured(path), change(coarse_rig))


def test_repeated_and_contradictory_responses_are_rejected(coarse_rig: Rig, path: Path) -> None:
    """One value per frequency, ERA and sensor, and one position per sensor."""
    values = read_measured(path)
    elsewhere = replace(values[0], point=(0.2, 0.2), era="NE", era_point=None)

    with pytest.raises(InputError, match=rf"{path.name}:\d+: .*50 Hz"):
        measurement_of([*values, values[0]], coarse_rig)
    with pytest.raises(InputError, match=rf"{path.name}:\d+: .*sensor P1"):
        measurement_of([*values, elsewhere], coarse_rig)


# Exciters, and sensors that are moved


def test_responses_per_volt_are_read_for_exciters_alone(responses, coarse_rig, tmp_path, ending):
    """With the masses of the sensor and the setting; a rig of ERAs rejects them."""
    exciters = tuple(
        Exciter(era.name, era.x, era.y, 3000.0, 0.8, 0.1, 1e-3, 3.6, 4.3, 3.0)
        for era in coarse_rig.eras
    )
    rig = replace(coarse_rig, eras=exciters)
    path, masses = tmp_path / f"measured.{ending}", (2e-3, 2e-3, 1.5e-3)
    setting = "level 0.1, rig 1a2b3c4d"
    WRITERS[ending](path, with_masses(responses, masses), rig, setting=setting)

    rows = read_measured(path)
    measurement = measurement_of(rows, rig)

    assert {row.setting for row in rows} == {setting}
    sensor_masses = {sensor.name: sensor.mass for sensor in measurement.sensors}
    expected = dict(zip(responses.names, masses, strict=True))
    assert sensor_masses == pytest.approx(expected)
    values = values_read(path, rig, responses.names)
    np.testing.assert_allclose(values, responses.values, rtol=1e-11)
    with pytest.raises(InputError, match=f"measured.{ending}.*per displacement of the base"):
        measurement_of(rows, coarse_rig)


@only_csv
def test_sensor_of_two_masses_is_rejected(responses, coarse_rig, path):
    """A sensor has one mass in all rows."""
    write_responses_csv(path, with_masses(responses, (2e-3,) * 3), coarse_rig)
    damage(path, ",2.0\n", ",3.0\n")

    with pytest.raises(InputError, match="must have one mass, got"):
        measurement_of(read_measured(path), coarse_rig)
