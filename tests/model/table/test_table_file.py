"""Table files: read back to the bit, or refused."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from model.errors import InputError
from model.files.array_file import digest_of
from model.table.file import load_table, save_table
from paper_plate import make_paper_rig
from small_table import FREQUENCIES, small_table


@pytest.fixture(scope="module")
def table():
    """A small one."""
    return small_table()


@pytest.fixture
def path(table, tmp_path):
    """Its file."""
    save_table(table, tmp_path / "t.npz")
    return tmp_path / "t.npz"


def test_load_table_reads_back_what_was_written(table, path):
    """Arrays to the bit and all else equal; no other file is left."""
    back = load_table(path, fingerprint=table.fingerprint)
    for name in ("frequencies", "acceleration", "omega", "held", "shapes", "cell_sources"):
        np.testing.assert_array_equal(getattr(back, name), getattr(table, name))
    for name in ("plate", "eras", "masses", "mesh", "raster", "grid", "drive_mode"):
        assert getattr(back, name) == getattr(table, name)
    assert list(path.parent.iterdir()) == [path]


def test_header_names_every_input(table, path):
    """Plain numpy opens the file without pickles; the header is JSON."""
    with np.load(path, allow_pickle=False) as content:
        assert content["acceleration"].shape == (table.raster.point_count, 3, 4)
        header = json.loads(content["header"].tobytes())
    assert header["format_version"] == 3
    assert header["frequencies_hz"] == FREQUENCIES.tolist()
    assert header["plate"]["thickness"] == 0.0015
    assert [era["stroke"] for era in header["eras"]] == [100e-6] * 4
    assert (header["mesh"]["nx"], header["mesh"]["element"]) == (12, "MITC4")
    assert (header["grid"]["nx"], header["grid"]["ny"], header["mode"]) == (4, 3, "switched")
    assert header["raster"]["nx"] * header["raster"]["ny"] == len(table.acceleration)
    assert header["discretisation_error"] == table.discretisation_error.tolist()
    assert header["reference_mesh"]["nx"] > 0
    assert header["code_version"].startswith("0.")


def test_save_table_leaves_the_old_file_when_writing_fails(table, path, monkeypatch):
    """A full disk half-way: the file is the old one, and nothing else is left."""
    before = path.read_bytes()

    def full_disk(stream, **arrays):
        stream.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full_disk)
    with pytest.raises(OSError, match="No space"):
        save_table(table, path)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_load_table_refuses_another_plate(path):
    """A plate a tenth of a millimetre thicker; the remedy is named."""
    rig = make_paper_rig(12, 9)
    thicker = replace(rig, plate=replace(rig.plate, thickness=0.0016))
    with pytest.raises(InputError, match=r"fingerprint.*era table build"):
        load_table(path, fingerprint=thicker.fingerprint)


def test_load_table_names_the_command_when_there_is_none(tmp_path):
    """The remedy for a missing table."""
    with pytest.raises(InputError, match="era table build"):
        load_table(tmp_path / "none.npz")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_load_table_refuses_a_flipped_bit(path, share):
    """Anywhere in the file."""
    data = bytearray(path.read_bytes())
    data[int(share * len(data))] ^= 0x01
    path.write_bytes(data)
    with pytest.raises(InputError, match=str(path)):
        load_table(path)


@pytest.mark.parametrize(
    ("mark", "offset", "byte"),
    [(b"PK\x01\x02", 8, 0x01), (b"), }", 3, ord(" "))],
    ids=["encrypted member", "header that does not parse"],
)
def test_load_table_refuses_wrong_framing(path, mark, offset, byte):
    """A flag that says encrypted, a bracket left open in an array's header."""
    data = bytearray(path.read_bytes())
    data[data.rindex(mark) + offset] = byte
    path.write_bytes(data)
    with pytest.raises(InputError, match="readable"):
        load_table(path)


def test_load_table_refuses_a_truncated_file(path):
    """The first half of the bytes."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="readable"):
        load_table(path)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda t: {"frequencies": np.array([{"a": 1}], dtype=object)}, "readable"),
        (lambda t: {"acceleration": t.acceleration.astype(np.complex128)}, "readable"),
        (lambda t: {"acceleration": t.acceleration * np.complex64(np.nan)}, "checksum"),
        (lambda t: {"cell_sources": t.cell_sources[:10]}, "checksum"),
        (lambda t: {"extra": np.zeros(3)}, "readable"),
        (lambda t: {"header": np.frombuffer(b"{}", dtype=np.uint8)}, "header"),
        (lambda t: {"header": np.frombuffer(b"\xff\x00", dtype=np.uint8)}, "header"),
    ],
    ids=["pickle", "type", "nan", "fewer", "more members", "empty header", "binary header"],
)
def test_load_table_refuses_a_forged_file(table, path, change, named):
    """Pickles, other types, missing or extra members."""
    with np.load(path, allow_pickle=False) as content:
        arrays = {**content, **change(table)}
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=named):
        load_table(path)


def test_load_table_refuses_compressed_and_vast_members_unread(path, tmp_path):
    """A compressed member, and members that declare a terabyte in a file of kilobytes."""
    packed, vast = tmp_path / "packed.npz", tmp_path / "vast.npz"
    with (
        zipfile.ZipFile(path) as good,
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as compressed,
        zipfile.ZipFile(vast, "w") as declared,
    ):
        for info in good.infolist():
            compressed.writestr(info.filename, good.read(info))
            declared.writestr(info.filename, good.read(info))
        declared.filelist[0].file_size = 1 << 40
    with pytest.raises(InputError, match="compressed"):
        load_table(packed)
    with pytest.raises(InputError, match=r"1\d{12} bytes"):
        load_table(vast)


def other_frequencies(header, arrays):
    """In the header alone."""
    header["frequencies_hz"][0] = 61.0


def descending_frequencies(header, arrays):
    """In the header and in the array."""
    header["frequencies_hz"].reverse()
    arrays["frequencies"] = arrays["frequencies"][::-1].copy()


def no_frequencies(header, arrays):
    """And nothing at them."""
    header["frequencies_hz"], header["discretisation_error"] = [], []
    arrays["frequencies"] = arrays["frequencies"][:0]
    arrays["acceleration"] = arrays["acceleration"][:, :0].copy()
    arrays["cell_sources"] = arrays["cell_sources"][:1]


def cells_that_are_no_count(header, arrays):
    """A count with a decimal point."""
    header["grid"]["nx"] = 12.5


def raster_that_is_no_count(header, arrays):
    """A side of so many and a half points."""
    header["raster"]["nx"] += 0.5


def nothing_moves(header, arrays):
    """At any frequency."""
    arrays["acceleration"] *= 0


def more_than_any_plate(header, arrays):
    """What overflows when it is squared."""
    arrays["acceleration"][3, 2, 1] = 1e30


def not_a_number(header, arrays):
    """One of all fields."""
    arrays["acceleration"][0, 0, 0] = np.nan


def another_plates_fingerprint(header, arrays):
    """So that it would serve a rig that it was not built for."""
    header["fingerprint"] = "0" * 64


def raster_of_another_size(header, arrays):
    """Fingers would be looked for elsewhere."""
    header["raster"]["length"] *= 1.1


def unknown_mode(header, arrays):
    """What no question could be answered in."""
    header["mode"] = "loud"


def old_format(header, arrays):
    """Of a version before the first."""
    header["format_version"] = 0


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (another_plates_fingerprint, "fingerprint"),
        (raster_of_another_size, "raster"),
        (unknown_mode, "'loud'"),
        (raster_that_is_no_count, "raster.nx"),
        (nothing_moves, "acceleration"),
        (more_than_any_plate, r"acceleration.*1e\+30"),
        (not_a_number, "acceleration must be finite"),
        (other_frequencies, "frequencies"),
        (descending_frequencies, "frequencies"),
        (no_frequencies, "frequencies"),
        (cells_that_are_no_count, "grid.nx"),
        (old_format, "version 0"),
    ],
)
def test_load_table_refuses_a_header_that_contradicts_the_arrays(path, change, named):
    """Impossible frequencies, counts and fields under a right checksum; the remedy is named."""
    with np.load(path) as content:
        arrays = dict(content)
    header = json.loads(arrays.pop("header").tobytes())
    change(header, arrays)
    del header["sha256"]
    header["sha256"] = digest_of(json.dumps(header, sort_keys=True), arrays)
    encoded = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    np.savez(path, header=encoded, **arrays)
    with pytest.raises(InputError, match=rf"{named}.*era table build"):
        load_table(path)
