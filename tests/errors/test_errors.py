"""Errors as a user meets them: commands, files that are no such file, interruptions, a full disk.

Each reader refuses what is wrong in words; hostile files are in test_hostile_files.py.
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
from era_haptics.lab.design.problem import (
    area_of,
)
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
"""A message of the page says what is right, or what to do next, in one of these ways."""


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
    """A command that fails says where, in one paragraph, and writes nothing."""
    outcome = provoke(case, tmp_path, shelf)
    assert outcome.status == case.status
    assert outcome.text.startswith("era: error: ")
    for place in case.at:
        # As a whole: line 1 is not in line 11, nor a key in one below it.
        assert re.search(
            rf"{re.escape(place)}((?<!\w)|(?!\w|\.\w))", outcome.text.replace(", line ", ":")
        ), outcome.text
    assert not INTERNALS.search(outcome.text)
    assert len(outcome.text) < 1500
    assert outcome.out == "" if not case.said else outcome.out.startswith(case.said)
    assert not outcome.changed


SHOWN = {tuple(case.typed): case for case in cases() if case.shown}
QUOTED = quotations(PAGE.read_text("utf-8"))


@pytest.mark.parametrize("quoted", QUOTED, ids=lambda quoted: quoted.typed[-1])
def test_page_quotes_status_and_remedy(quoted: Quotation) -> None:
    """A section has the errors of its exit status, and each message says what to do."""
    assert SHOWN[tuple(quoted.typed)].status == quoted.status
    assert REMEDY.search(quoted.text)


def test_page_quotes_every_case_that_is_shown() -> None:
    """Each shown case has a box of its own."""
    assert sorted(tuple(quoted.typed) for quoted in QUOTED) == sorted(SHOWN)


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
    "report rig.yaml -o reported": "era_haptics.lab.report.collect",
}
"""Commands that write a file, or several into a folder, each with its slow function."""

QUICK = [
    *(command for command in WRITING if command.startswith(("table build", "report"))),
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
    head, *rows = (shelf / "measured.csv").read_text("utf-8").splitlines(keepends=True)
    frequencies = list(dict.fromkeys(row.split(",")[6] for row in rows))[::4]
    measured = head + "".join(row for row in rows if row.split(",")[6] in frequencies)
    (tmp_path / "measured.csv").write_text(measured, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / ".cache"))
    return tmp_path


def files(folder: Path) -> dict[str, bytes]:
    """Files of a folder, without the cache."""
    found = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {
        name: path.read_bytes() for name, path in found.items() if not name.startswith(".cache/")
    }


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
        target = home / [*command.split("-o "), "-"][1].split()[0]
        if target.suffix:
            target.write_bytes(b"")
    before = files(home)
    for status, said in interrupted(commands, home).values():
        assert status == 130, said
        assert "Traceback" not in said
        assert "error" not in said
    assert files(home) == before


@pytest.mark.parametrize("command", shortly([*WRITING, "config init out.yaml"], QUICK))
def test_command_keeps_previous_output_when_the_disk_is_full(
    command: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It prints one line of error, and the files are unchanged."""
    fit, fitted = calibrate.calibrate, []

    def fit_once(*arguments: Any, **keywords: Any) -> Any:
        if not fitted:
            fitted.append(fit(*arguments, **keywords))
        return fitted[0]

    monkeypatch.setattr(calibrate, "calibrate", fit_once)
    if not command.startswith(("report", "config")):  # these replace nothing
        status, said = outcome_of(command)
        assert status == 0, said
    before = files(home)
    with full_disk():
        status, said = outcome_of(command)
    assert status == 2
    progress = re.compile(r"era: \d+ of \d+ ")
    (line,) = (line for line in said.splitlines() if not progress.match(line))
    assert line.startswith("era: error: "), said
    assert files(home) == before


TEN_METERS, URL = Plate(10.0, 10.0, 0.002, material("float-glass")), "sim://"


def simulated(url: str, *wires: str) -> dict[str, SimulatedWire]:
    """The wire of the amplifier main at a URL, by options of `era sim`."""
    usual = SimulatedWire("serial")
    return assign_wires({"main": url}, common=None, options=wires, defaults=usual)


PARSERS: dict[str, Callable[[str], object]] = {
    "amplifier URL": address_of,
    "touch URL": open_source,
    "frequencies": parse_frequencies,
    "scheduler": lambda text: [*on_cluster(text, divmod, 1, {0: 1})],
    "material": material,
    "mesh": lambda text: mesh_of(text, RIG.plate, frequency_max=500.0),
    "mesh of ten metres": lambda text: mesh_of(text, TEN_METERS, frequency_max=500.0),
    "wire": lambda text: simulated(URL, *text.split()),
    "URL to simulate": simulated,
    "line": lambda text: choose_lines(simulated("serial:///dev/ttyUSB0"), [text]),
    "area": lambda text: area_of(text, RIG.plate),
}
"""By what a text is, what reads it."""


@pytest.mark.parametrize(
    ("read", "named", "text", "pattern"),
    [
        (each["read"], each.get("named", each["read"]), text, pattern)
        for each in read_yaml(Path(__file__).with_name("refused.yaml"))
        for text, pattern in each["refused"].items()
    ],
)
def test_what_is_wrong_is_said(
    tmp_path: Path, read: str, named: str, text: str, pattern: str
) -> None:
    """Of a file with its name, line and key; nothing that a text asks for is opened."""
    text = re.sub(r"<(\d+) (.+?)>", lambda found: int(found[1]) * found[2], text)
    (tmp_path / named).write_text(text, "utf-8")
    files = {**READERS, "document.yaml": read_document}  # which may hold any plain data
    with pytest.raises((InputError, CommandError), match=pattern):
        files[read](tmp_path / named) if read in files else PARSERS[read](text)


@pytest.mark.parametrize(
    "shape", shortly([b"(True, 4)", b"(-1, -4)", b"(%s,)" % (b"9" * 5000), b"4"], [b"(-1, -4)"])
)
def test_array_without_a_shape_is_refused(tmp_path: Path, shape: bytes) -> None:
    """Of .npy, whose header Python parses: True counts as 1, and two negative counts as a size."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': %s}" % shape
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(32)
    path = tmp_path / "arrays.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", member)
    with pytest.raises(UNREADABLE):
        read_arrays(path, {"x": "<f8"}, max_bytes=1 << 20)
