"""Losses between hysteretic and viscous: the loss factor is right, and known as stated, in both.

Files of measured frequency responses, and what is refused in them.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyuff

from kit.desk_plate import DeskModel, draw_truth
from model.arrays import FloatArray
from model.errors import InputError
from model.estimate.calibrate import calibrate
from model.estimate.measurement import Measurement, sensors_at
from model.response_files import (
    measurement_of,
    read_measured,
    write_responses_csv,
    write_responses_uff,
)
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.structure.exciter import Exciter
from model.structure.plate import Plate

ROOT = Path(__file__).parents[3]
TONES = np.arange(41.0, 500.0, 20.0)


def rig_and_points() -> tuple[Rig, FloatArray]:
    """The desk's plate and twelve sensors on it."""
    rig = load_rig(ROOT / "examples" / "desk" / "rig.yaml")
    shares = np.array([(x, y) for x in (0.12, 0.38, 0.63, 0.87) for y in (0.15, 0.5, 0.85)])
    return rig, shares * [rig.plate.length, rig.plate.width]


@pytest.mark.long
def test_loss_factor_of_a_plate_in_time_is_within_its_standard_error() -> None:
    """A plate whose losses are viscous has its loss factor at its resonances alone.

    Fitted as hysteretic, it is 0.7 % too large, with 0.4 % stated: never within a standard error.
    """
    rig, points = rig_and_points()
    truth = draw_truth(rig, seed=2)
    strokes = np.array([era.stroke for era in rig.eras])
    exact = DeskModel(truth, points).under().response(TONES).swapaxes(1, 2) / strokes[:, None]
    rng = np.random.default_rng(5)
    size = np.sqrt((np.abs(exact) ** 2).mean(axis=2, keepdims=True))
    noise = rng.standard_normal((2, *exact.shape))
    values = exact + 1e-3 * size * (noise[0] + 1j * noise[1])
    responses = Measurement(sensors_at(points), TONES, values.swapaxes(1, 2))
    found = calibrate(rig, responses)
    loss = next(one for one in found.parameters if one.kind == "loss_factor")
    off = abs(loss.value - truth.rig.plate.loss_factor)
    assert off < loss.standard_error < 0.01 * loss.value


WRITERS = {"csv": write_responses_csv, "uff": write_responses_uff}


@pytest.fixture
def responses() -> Measurement:
    """Three sensors, three frequencies, two of four ERAs; one value was not measured."""
    rng = np.random.default_rng(4)
    values = np.full((3, 4, 3), np.nan, dtype=complex)
    values[:, :2] = 1e5 * (rng.standard_normal((3, 2, 3)) + 1j * rng.standard_normal((3, 2, 3)))
    values[1, 0, 2] = np.nan
    points = np.array([[0.1, 0.05], [0.2, 0.15], [0.3048, 0.2286]])
    sensors = sensors_at(points, ("P1", "P2", "rim"))
    return Measurement(sensors, np.array([50.0, 110.25, 320.0]), values.swapaxes(1, 2))


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


def with_masses(measurement: Measurement, masses: Sequence[float]) -> Measurement:
    """The same by sensors that weigh something [kg]."""
    each = zip(measurement.sensors, masses, strict=True)
    return replace(measurement, sensors=[replace(one, mass=mass) for one, mass in each])


def test_responses_files_read_back_what_was_written(responses, coarse_rig, path):
    """Sensors, places, frequencies and complex values, gaps among them."""
    back = measurement_of(read_measured(path), coarse_rig)
    order = [back.names.index(name) for name in responses.names]
    np.testing.assert_allclose(back.points[order], responses.points, rtol=1e-12)
    np.testing.assert_array_equal(back.frequencies, responses.frequencies)
    np.testing.assert_allclose(back.values[:, order], responses.values, rtol=1e-11)
    assert back.count == 17


def test_read_measured_reads_uff_of_another_program(coarse_rig: Rig, tmp_path: Path) -> None:
    """Written by pyuff alone: single precision, nodes as dataset 15, no names, sensor upside down.

    ERAs are known by their nodes' places.
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
    file = pyuff.UFF(str(path))
    file.write_sets([nodes, record], "overwrite", force_double=False)
    back = measurement_of(read_measured(path), coarse_rig)
    assert back.names == ("node:7",)
    np.testing.assert_allclose(back.frequencies, [50, 60, 70])
    np.testing.assert_allclose(back.values[:, 0, 1], [-1 - 2j, -3 + 1j, 250 - 0.5j], rtol=1e-5)
    assert np.isnan(back.values[..., [0, 2, 3]]).all()


# pyuff does not close a file that it has written bytes to.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("ending", ["uff"])
def test_read_measured_reads_binary_uff(
    responses: Measurement, coarse_rig: Rig, path: Path, tmp_path: Path
) -> None:
    """Binary records (58b) are read to the last bit; damage and other formats are refused."""
    sets = pyuff.UFF(str(path)).read_sets()
    for each in sets[2:]:
        each.update(binary=1, n_bytes=0)
    binary = tmp_path / "binary.uff"
    pyuff.UFF(str(binary)).write_sets(sets, "overwrite")
    back = measurement_of(read_measured(binary), coarse_rig)
    np.testing.assert_allclose(back.values, responses.values, rtol=1e-11)
    content = binary.read_bytes()
    cut = content.rindex(b"    -1")
    (size, *_) = re.findall(rb"58b.*?(\d+)     0", content)
    for wrong in (
        content[: cut - 24] + b"\n" + content[cut:],
        content.replace(size, b"%d" % (int(size) + 8), 1),  # would run into the next record
        content[:cut] + b"7\r\n" + content[cut:],
        re.sub(rb"(58b +\d +)2", rb"\g<1>1", content, count=1),  # floating point of DEC VMS
    ):
        binary.write_bytes(wrong)
        with pytest.raises(InputError, match=r"binary\.uff:?\d*: "):
            read_measured(binary)


DAMAGED = {
    "csv": [
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
    "uff": [
        ("m/s^2", "cm/s2", r":\d+: .*'cm/s2'"),
        ("        12    0", "        11    0", r":\d+: .*11 over 8"),
        ("         8    0", "        13    0", r":\d+: .*12 over 13"),
        ("         6         3", "         6         4", r":\d+: .*12"),
        ("  5.00000e+01", "  x.00000e+01", r":\d+: .*'x.00000e"),
        ("         1   3 ", "         1   1 ", r":\d+: .*1 and 3"),
        ("    4         0", "    9         0", ""),
        ("         1         0         0", "         1         0         7", r":\d+: .* node 1"),
        ("\n    -1\n", "\n    -3\n", r":\d+: "),
        ("NONE", "\n    -1\n    -1\n    58\nNONE", r":\d+: "),  # a record without its header
    ],
}
"""What is replaced in a file, and the place and the cause that are named; none if it is read."""


@pytest.mark.parametrize(
    ("ending", "before", "after", "named"),
    [(ending, *row) for ending, rows in DAMAGED.items() for row in rows],
)
def test_read_measured_refuses_damaged_files(coarse_rig, path, before, after, named):
    """Wrong units, unknown columns, bad values, broken records; other functions are skipped."""
    text = path.read_bytes().decode()
    assert before in text
    path.write_bytes(text.replace(before, after, 1).encode("latin-1"))
    if not named:
        assert len(read_measured(path)) == 17 - 3
        return
    with pytest.raises(InputError, match=rf"measured\.\w+.*{named}"):
        measurement_of(read_measured(path), coarse_rig)


@pytest.mark.parametrize("ending", ["csv"])
def test_comma_may_separate_thousands(path):
    """Where other numbers have a decimal point, 1,234 is not read as one and a bit."""
    text = path.read_text("utf-8").replace(",", ";").replace("320.0", "1,234")
    path.write_text(text, "utf-8")
    with pytest.raises(InputError, match=r"csv:\d+: frequency_hz .*'1,234'"):
        read_measured(path)


SPREADSHEETS = {
    "semicolons": lambda text: text.replace(",", ";").encode(),
    "decimal commas": lambda text: text.replace(",", ";").replace(".", ",").encode(),
    "tabs": lambda text: text.replace(",", "\t").encode("utf-16"),
    "sep": lambda text: f"sep=;\r\n{text.replace(',', ';')}".encode(),
    "empty rows": lambda text: f" \r\n{text}{9 * ','}\n".encode(),
    "empty first rows": lambda text: f"\r\n;;\r\n{text.replace(',', ';')}".encode(),
    "line ends of old": lambda text: text.replace("\n", "\r").encode(),
    "minus signs": lambda text: text.replace(",-", ",\N{MINUS SIGN}").encode(),
    "coherence": lambda text: "\n".join(
        f"{line},{'0.99' if row else 'coherence'}" for row, line in enumerate(text.split())
    ).encode(),
}


@pytest.mark.parametrize("ending", ["csv"])
@pytest.mark.parametrize("write", SPREADSHEETS.values(), ids=SPREADSHEETS)
def test_read_measured_reads_csv_of_spreadsheets(responses, coarse_rig, path, write, caplog):
    """Separators, decimal commas, UTF-16, a coherence, and what lies beyond the last value."""
    path.write_bytes(write(path.read_text("utf-8")))
    back = measurement_of(read_measured(path), coarse_rig)
    np.testing.assert_array_equal(back.values, responses.values)
    assert ("coherence" in caplog.text) == ("coherence" in path.read_text("utf-8", "replace"))


@pytest.mark.parametrize("ending", ["uff"])
@pytest.mark.parametrize(
    ("label", "factor", "end", "encoding"),
    [
        ("m/s²", 1.0, "\r\n", "latin-1"),
        ("(m/s^2)", 1.0, "\r", "latin-1"),
        ("m s-2", 1.0, "\n", "utf-8-sig"),
        ("g", 9.80665, "\r\n", "utf-16"),
        ("mm/s2", 1e-3, "\r\n", "latin-1"),
        pytest.param("in/s2", 0.0254, "\n", "latin-1", id="inches"),
        pytest.param("mm/s/s over mm", 1.0, "\n", "latin-1", id="mm"),
        pytest.param("gn over um", 9.80665e6, "\n", "latin-1", id="um"),
        pytest.param("g over µm", 9.80665e6, "\n", "utf-8", id="micro"),
        pytest.param("in/s/s over in", 1.0, "\n", "latin-1", id="over inches"),
    ],
)
def test_read_measured_reads_uff_of_analysers(
    responses, coarse_rig, path, label, factor, end, encoding
):
    """By dataset 58's definition: any label of a unit, numbers of Fortran, the counted values.

    As editors save it, too.
    """
    above, _, below = label.partition(" over ")
    text = path.read_text("ascii").replace("m/s^2".ljust(20), above.ljust(20))
    text = text.replace(" m".ljust(21), f" {below or 'm'}".ljust(21))
    lines = text.splitlines()
    for number, line in enumerate(lines):
        if re.fullmatch(r"( +-?\d\.\d+e[+-]\d+){3}", line):
            lines[number] = line.replace("e", "D" if number % 2 else "E")
            last = number
    lines[last] += "  0.00000e+00  0.00000e+00"  # fills the last line
    first = next(number for number, line in enumerate(lines) if line.strip() == "58")
    lines[first + 1] = "an offset of    -1"
    path.write_bytes(end.join(lines).encode(encoding))
    back = measurement_of(read_measured(path), coarse_rig)
    order = [back.names.index(name) for name in responses.names]
    np.testing.assert_allclose(back.values[:, order], factor * responses.values, rtol=1e-11)


@pytest.mark.parametrize("ending", ["uff"])
@pytest.mark.parametrize(
    ("label", "factor"), [("NONE", 1.0), ("kHz", 1000.0), ("rad/s", 0.15915494309), ("RPM", None)]
)
def test_frequencies_of_uff_are_in_the_unit_of_their_label(responses, path, label, factor):
    """One radian a second is 1/(2 pi) Hz; a unit that is not known is refused."""
    path.write_text(path.read_text("ascii").replace("Hz   ", label.ljust(5)), "ascii")
    if factor is None:
        with pytest.raises(InputError, match=r"uff:\d+: unit must be .*'RPM'"):
            read_measured(path)
        return
    found = sorted({value.frequency for value in read_measured(path)})
    np.testing.assert_allclose(found, factor * responses.frequencies, rtol=1e-9)


@pytest.mark.parametrize("ending", ["csv"])
def test_values_beyond_the_limits_are_left_out(coarse_rig, path, caplog):
    """An analyser's line of 0 Hz, and all beyond its rig's highest frequency, are counted."""
    path.write_text(path.read_text("utf-8").replace(",50.0,", ",0.0,"), "utf-8")
    back = measurement_of(read_measured(path), coarse_rig)
    assert (back.skipped, back.count, back.frequencies.tolist()) == (6, 11, [110.25, 320.0])
    assert "6 of 17" in caplog.text


def test_read_measured_refuses_files_without_measurements(path, monkeypatch):
    """An empty one, text, one cut off or too large, no file, and an unknown ending."""
    good = path.read_bytes()
    monkeypatch.setattr("model.files.uff.MAX_UFF_BYTES", len(good) - 1)
    for content, said in (
        (b" \n", path.name),
        (b"Dear all, the measurement was a success.\n", path.name),
        (good[:-30], path.name),
        (good, "MiB"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=said):
            read_measured(path)
    path.unlink()
    for missing, said in ((path, path.name), (path.with_suffix(".mat"), r"\.csv, \.uff")):
        with pytest.raises(InputError, match=said):
            read_measured(missing)


def test_responses_of_refuses_another_plate(coarse_rig, path):
    """Points off the plate, ERAs elsewhere or unknown, frequencies beyond limits, repetitions."""
    measured = read_measured(path)
    plate, eras = coarse_rig.plate, coarse_rig.eras
    small = Plate(0.25, 0.2, plate.thickness, plate.material)
    inside = tuple(replace(era, x=min(era.x, 0.25), y=min(era.y, 0.2)) for era in eras)
    moved = tuple(replace(era, x=0.9 * era.x) for era in eras)
    others = tuple(replace(era, name=f"X{era.name}", x=0.1 + era.x / 3) for era in eras)
    limits = replace(coarse_rig.limits, frequency_max=45.0)
    elsewhere = replace(measured[0], point=(0.2, 0.2), era="NE", era_point=None)
    for rig, given, named in (
        (replace(coarse_rig, plate=small, eras=inside), measured, "sensor rim"),
        (replace(coarse_rig, eras=moved), measured, "ERA SE"),
        (replace(coarse_rig, eras=others), measured, "ERA.* SW"),
        (replace(coarse_rig, limits=limits), measured, "50 Hz"),
        (coarse_rig, [*measured, measured[0]], "50 Hz"),
        (coarse_rig, [*measured, elsewhere], "sensor P1"),
    ):
        with pytest.raises(InputError, match=rf"{path.name}:\d+: .*{named}"):
            measurement_of(given, rig)


def test_responses_per_volt_are_of_exciters(responses, coarse_rig, tmp_path, ending):
    """Of a rig with exciters they read back, masses of the sensor too; one of ERAs refuses them."""
    exciters = tuple(
        Exciter(era.name, era.x, era.y, 3000.0, 0.8, 0.1, 1e-3, 3.6, 4.3, 3.0)
        for era in coarse_rig.eras
    )
    rig = replace(coarse_rig, eras=exciters)
    path = tmp_path / f"measured.{ending}"
    weighed = with_masses(responses, (2e-3, 2e-3, 1.5e-3))
    WRITERS[ending](path, weighed, rig, setting="level 0.1, rig 1a2b3c4d")
    measured = read_measured(path)
    assert {each.setting for each in measured} == {"level 0.1, rig 1a2b3c4d"}
    back = measurement_of(measured, rig)
    order = [back.names.index(name) for name in responses.names]
    np.testing.assert_allclose(back.values[:, order], responses.values, rtol=1e-11)
    assert [back.sensors[n].mass for n in order] == pytest.approx([2e-3, 2e-3, 1.5e-3])
    with pytest.raises(InputError, match=f"measured.{ending}.*per displacement of the base"):
        measurement_of(measured, coarse_rig)


@pytest.mark.parametrize("ending", ["csv"])
def test_sensor_that_cannot_be_moved_is_refused(responses, coarse_rig, path):
    """Two masses at one place, one below zero, and one that is a paperweight's."""
    write_responses_csv(path, with_masses(responses, (2e-3,) * 3), coarse_rig)
    right = path.read_text()
    for grams in ("-1", "900"):
        path.write_text(right.replace(",2.0\n", f",{grams}\n", 1))
        with pytest.raises(InputError, match=r"measured\.csv:2: sensor_mass_g must be"):
            read_measured(path)
    path.write_text(right.replace(",2.0\n", ",3.0\n", 1))
    with pytest.raises(InputError, match="must have one mass, got"):
        measurement_of(read_measured(path), coarse_rig)
