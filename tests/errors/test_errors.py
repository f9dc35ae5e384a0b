"""Errors as a user meets them: commands, invalid files, interruptions, a full disk.

Hostile files are in test_hostile_files.py.
"""

import contextlib
import io
import re
import shlex
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from cases import read_yaml, shortly
from controller.sources.touch import open_source
from drivers.errors import CommandError
from drivers.wires.wire import address_of
from era_haptics.command import run_era
from era_haptics.lab.design.era_area import area_of
from kit.outside_files import READERS, RIG
from model.commands.options import parse_frequencies
from model.config.document import read_document
from model.errors import InputError
from model.estimate import calibrate
from model.files.array_file import UNREADABLE, read_arrays
from model.processes import on_cluster
from model.rig.rig_mesh import mesh_of
from model.structure.material import material
from model.structure.plate import Plate
from processes.error_cases import (
    INTERNALS,
    PAGE,
    Case,
    Quotation,
    cases,
    filled,
    provoke,
    quotations,
)
from processes.error_cases import RIG as CASE_RIG
from processes.interrupted import full_disk, interrupted
from sim.far_ends.wire_assignment import SimulatedWire, assign_wires, choose_lines

REMEDY = re.compile(
    r";|must|expected|did you mean|see |try|give|use|write|check|known|add|first|make|install", re.I
)
"""A message of the page states the rule, or the remedy, in one of these ways."""


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Files that are slow to make, and a daemon that runs."""
    folder = tmp_path_factory.mktemp("shelf")
    with filled(folder):
        yield folder


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=case.name, marks=pytest.mark.long if case.long else [])
        for case in cases()
    ],
)
def test_error_has_its_status_and_place(case: Case, shelf: Path, tmp_path: Path) -> None:
    """A command that fails states the location in one paragraph, and writes nothing."""
    outcome = provoke(case, tmp_path, shelf)
    message = outcome.text.replace(", line ", ":")
    assert outcome.status == case.status
    assert message.startswith("era: error: ")
    for location in case.at:
        # As a whole: line 1 is not in line 11, nor a key in one below it.
        whole = rf"{re.escape(location)}((?<!\w)|(?!\w|\.\w))"
        assert re.search(whole, message), message
    assert not INTERNALS.search(message)
    assert len(message) < 1500
    if case.said:
        assert outcome.out.startswith(case.said)
    else:
        assert outcome.out == ""
    assert outcome.changed == frozenset()


SHOWN = {tuple(case.typed): case for case in cases() if case.shown}
QUOTED = quotations(PAGE.read_text("utf-8"))


@pytest.mark.parametrize("quoted", QUOTED, ids=lambda quoted: quoted.typed[-1])
def test_page_quotes_status_and_remedy(quoted: Quotation) -> None:
    """A section has the errors of its exit status, and each message has a remedy."""
    assert SHOWN[tuple(quoted.typed)].status == quoted.status
    assert REMEDY.search(quoted.text)


WRITING = {
    "table build rig.yaml -o out.npz --frequencies 60:90:30 --grid 4x3": (
        "model.table.table_file.solve_table"
    ),
    "table export table.npz --format csv -o out.csv": "model.study.table_export.export_csv",
    "table export table.npz --format mat -o out.mat": "model.study.table_export.export_mat",
    "plate map rig.yaml --drive SW=110 -o out.png": "model.vibration.plate_map",
    "calibrate rig.yaml measured.csv -o out.yaml": "model.estimate.calibrate.calibrate",
    "design rig.yaml -o design --layouts random:2": (
        "era_haptics.lab.design.design_run.rank_layouts"
    ),
}
"""Commands that write a file, or several into a folder, each with its slow function."""

QUICK = [
    *(command for command in WRITING if command.startswith("table build")),
    "config init out.yaml",
]
"""Those that `make test` lets write to a full disk: all replace files in the same way."""

LONG = {
    "table plot table.npz -o plots": "model.figures.table_pictures.table_figures",
    "table show table.npz": "model.study.overview.find_overview",
    "table verify table.npz rig.yaml": "model.study.verification.verify_table",
    "plate convergence rig.yaml": "model.vibration.study_convergence",
    "rig check rig.yaml --measured measured.csv": "model.estimate.rig_check.diagnose",
    "demo --wire sim": "model.table.table_file.cached_table",
}
"""Other slow commands, with their slow function."""


@pytest.fixture
def home(shelf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a rig, a table and every fourth frequency of a measurement."""
    rig = CASE_RIG.replace("[40, 300]", "[40, 500]").replace("mesh: 12x9", "mesh: auto")
    (tmp_path / "rig.yaml").write_text(rig, encoding="utf-8")
    (tmp_path / "table.npz").write_bytes((shelf / "table.npz").read_bytes())
    measured = (shelf / "measured.csv").read_text("utf-8")
    head, *rows = measured.splitlines(keepends=True)
    frequencies = dict.fromkeys(row.split(",")[6] for row in rows)
    few_frequencies = [*frequencies][::4]
    few_rows = [row for row in rows if row.split(",")[6] in few_frequencies]
    (tmp_path / "measured.csv").write_text(head + "".join(few_rows), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / ".cache"))
    return tmp_path


def files_of(folder: Path) -> dict[str, bytes]:
    """Files of a folder, without the cache."""
    files = {}
    for path in folder.rglob("*"):
        name = str(path.relative_to(folder))
        if path.is_file() and not name.startswith(".cache/"):
            files[name] = path.read_bytes()
    return files


def outcome_of(command: str) -> tuple[int, str]:
    """Exit status of a command, and its standard error."""
    err = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        status = run_era(shlex.split(command))
    return status, err.getvalue()


@pytest.mark.parametrize(
    "commands",
    [
        {command: WRITING[command] for command in QUICK if command in WRITING},
        pytest.param(WRITING | LONG, marks=pytest.mark.long),
    ],
    ids=["some", "all"],
)
def test_interrupted_commands_keep_previous_output(home: Path, commands: dict[str, str]) -> None:
    """The exit status is 130, without a traceback, and the files are unchanged."""
    for command in commands:
        _, _, output = command.partition("-o ")
        target = home / (output.split() or ["-"])[0]
        if target.suffix:
            target.write_bytes(b"")
    former_files = files_of(home)
    for status, message in interrupted(commands, home).values():
        assert status == 130, message
        assert "Traceback" not in message
        assert "error" not in message
    assert files_of(home) == former_files


@pytest.mark.parametrize("command", shortly([*WRITING, "config init out.yaml"], QUICK))
def test_command_keeps_previous_output_when_the_disk_is_full(
    command: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It prints one line of error, and the files are unchanged."""
    results: list[object] = []
    calibrate_rig = calibrate.calibrate

    def calibrate_once(*arguments: Any, **options: Any) -> object:
        if not results:
            results.append(calibrate_rig(*arguments, **options))
        return results[0]

    monkeypatch.setattr(calibrate, "calibrate", calibrate_once)
    if not command.startswith("config"):  # it replaces nothing
        status, message = outcome_of(command)
        assert status == 0, message
    former_files = files_of(home)
    with full_disk():
        status, message = outcome_of(command)
    assert status == 2
    progress = re.compile(r"era: \d+ of \d+ ")
    lines = [line for line in message.splitlines() if not progress.match(line)]
    assert len(lines) == 1, message
    assert lines[0].startswith("era: error: ")
    assert files_of(home) == former_files


TEN_METERS = Plate(10.0, 10.0, 0.002, material("float-glass"))


def simulated(url: str, *wires: str) -> dict[str, SimulatedWire]:
    """The wire of the amplifier main at a URL, by options of `era sim`."""
    defaults = SimulatedWire("serial")
    return assign_wires({"main": url}, common=None, options=wires, defaults=defaults)


def read_scheduler(text: str) -> object:
    """Compute 0 divmod 1 on a cluster."""
    return [*on_cluster(text, divmod, 1, {0: 1})]


def read_mesh(text: str) -> object:
    """The mesh of the rig."""
    return mesh_of(text, RIG.plate, frequency_max=500.0)


def read_large_mesh(text: str) -> object:
    """The mesh of a plate of ten meters."""
    return mesh_of(text, TEN_METERS, frequency_max=500.0)


def read_wires(text: str) -> object:
    """The wires of options of `era sim`."""
    return simulated("sim://", *text.split())


def read_line(text: str) -> object:
    """The line of an option of `era sim`."""
    return choose_lines(simulated("serial:///dev/ttyUSB0"), [text])


def read_area(text: str) -> object:
    """The area of a design."""
    return area_of(text, RIG.plate)


PARSERS: dict[str, Callable[[str], object]] = {
    "amplifier URL": address_of,
    "touch URL": open_source,
    "frequencies": parse_frequencies,
    "scheduler": read_scheduler,
    "material": material,
    "mesh": read_mesh,
    "mesh of ten metres": read_large_mesh,
    "wire": read_wires,
    "URL to simulate": simulated,
    "line": read_line,
    "area": read_area,
}
"""What reads a text, by what it is."""
FILE_READERS = {**READERS, "document.yaml": read_document}
"""What reads a file, by its name; a document can hold any plain data."""


def read_as(kind: str, path: Path, text: str) -> None:
    """Read a file, or its text."""
    if kind in FILE_READERS:
        FILE_READERS[kind](path)
    else:
        PARSERS[kind](text)


def repeated(text: str) -> str:
    """A text in which `<5000 9>` stands for as many nines."""
    return re.sub(r"<(\d+) (.+?)>", lambda match: int(match[1]) * match[2], text)


REFUSED = read_yaml(Path(__file__).with_name("refused.yaml"))


@pytest.mark.parametrize(
    ("read", "name", "text", "pattern"),
    [
        (entry["read"], entry.get("named", entry["read"]), repeated(text), pattern)
        for entry in REFUSED
        for text, pattern in entry["refused"].items()
    ],
)
def test_invalid_text_is_refused(
    tmp_path: Path, read: str, name: str, text: str, pattern: str
) -> None:
    """The message has the file name, line and key; nothing that a text asks for is opened."""
    path = tmp_path / name
    path.write_text(text, "utf-8")
    with pytest.raises((InputError, CommandError), match=pattern):
        read_as(read, path, text)


@pytest.mark.parametrize(
    "shape", shortly([b"(True, 4)", b"(-1, -4)", b"(%s,)" % (b"9" * 5000), b"4"], [b"(-1, -4)"])
)
def test_array_without_a_shape_is_refused(tmp_path: Path, shape: bytes) -> None:
    """Python parses the header of .npy: True counts as 1, and two negative counts as a size."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': %s}" % shape
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(32)
    path = tmp_path / "arrays.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", member)
    with pytest.raises(UNREADABLE):
        read_arrays(path, {"x": "<f8"}, max_bytes=1 << 20)
