"""The Python API as its users meet it.

All public names are there, typed, documented and loaded one by one; the entries of the reference
and the notebooks run; arguments of another type are refused and never end in an AttributeError;
rigs are made, changed, written and read back; answers of several contents are mapped and played;
and whatever hides a package of ours is named, in a process of its own.
"""

import ast
import inspect
import math
import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import era_haptics as era
import era_haptics.plugins
from cases import shortly
from kit.clock import in_virtual_time
from kit.plates import small_table
from kit.wires import SHARED_WIRES, on_two_amplifiers, rig_on_wire
from model.reduction.free_plate import solve_free_plate
from model.rig.rig_writing import change_rig
from model.table.table_file import build_table
from packages import PACKAGES
from python_page import named
from registry import threads

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "python-api.md").read_text("utf-8")


@pytest.mark.parametrize(
    "fact",
    [
        "Raises ConfigError with all problems of the file; InputError for",  # errors of a function
        "`slew: float`: Maximum rise of a channel's level [1/s].",  # units of a class's fields
        "Frequencies (f,) [Hz] and peak acceleration at points (p, 2) [m]",  # shapes
        "- `disarm() -> None`: Fall silent, then switch the high voltage off.",  # a method
        "- `is_reached: bool`: Whether all vibrations have their nominal levels",  # a property
        "- `async events() -> AsyncIterator[Notification]`: Yield notifications",  # a coroutine
        "`stop(*, client: str | None=None) -> StopResult`",  # a method of the stub
        "`SolvedPlate(rig: Rig, *, seed: int | None=None)`: A rig's plate on",  # a constructor
    ],
)
def test_page_has_what_docstrings_say(fact: str) -> None:
    """As it is read in a checkout: shapes, units and errors, not first sentences alone."""
    assert fact.casefold() in " ".join(PAGE.casefold().split())


STUB = Path(era.__file__).with_suffix(".pyi")


def ran(program: str, *flags: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    """A program of Python in a process of its own, with these variables beside those of others."""
    return subprocess.run(
        [sys.executable, *flags, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | environment,
    )


def test_every_name_is_loaded_from_where_type_checkers_find_it() -> None:
    """The table of homes against the imports of the stub."""
    body = ast.parse(STUB.read_text("utf-8")).body
    imported = {
        alias.name: (node.module, alias.name, alias.asname)
        for node in body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    homes = {name: (module, own) for module, own, name in imported.values() if name}
    homes |= {
        ast.unparse(node.targets[0]): imported[ast.unparse(node.value)][:2]
        for node in body
        if isinstance(node, ast.Assign)
    }
    assert sorted(homes) == sorted(era.__all__) == sorted(dir(era))
    for name, (module, own) in homes.items():
        assert getattr(era, name) is getattr(import_module(module), own)


def test_unknown_name_lists_the_known_ones() -> None:
    """As an AttributeError."""
    with pytest.raises(AttributeError, match=r"laod_rig; .*load_rig"):
        _ = era.laod_rig


@pytest.mark.parametrize(
    ("module", "not_loaded"),
    [
        ("Client", "scipy matplotlib sim serial"),
        ("load_rig", "matplotlib sim controller"),
        ("plugins.wires", "model controller sim numpy scipy"),
        *(
            pytest.param(*row, marks=pytest.mark.long)
            for row in (
                ("SolvedPlate", "matplotlib controller"),
                ("draw_map", "matplotlib.pyplot"),
                ("plugins.touch_sources", "sim numpy scipy matplotlib pythonosc"),
                ("plugins.content_formats", "sim scipy matplotlib drivers"),
                ("plugins.effects", "sim matplotlib drivers.backend"),
                ("plugins.materials", "sim controller drivers numpy"),
            )
        ),
    ],
)
def test_name_loads_only_what_it_needs(module: str, not_loaded: str) -> None:
    """A client of the daemon is loaded without linear algebra, a plate without pyplot."""
    names = module.partition(".")
    load = f"import era_haptics.{module}" if names[1] else f"import era_haptics as e; e.{module}"
    done = ran(f"import sys; {load}; print(*sys.modules)")
    assert (done.returncode, done.stderr) == (0, "")
    assert set(done.stdout.split()) & set(not_loaded.split()) == set()


PLUGINS_PAGE = (ROOT / "docs" / "reference" / "plugins.md").read_text("utf-8")
PACKAGE = Path(era_haptics.plugins.__file__).parent
KINDS = sorted(path.stem for path in PACKAGE.glob("[!_]*.py"))


def test_module_names_are_entry_point_groups() -> None:
    """The examples register plug-ins in the groups that the modules are named for."""
    groups = {
        group.removeprefix("era_haptics.")
        for path in (ROOT / "examples" / "plugins").glob("*/pyproject.toml")
        for group in tomllib.loads(path.read_text("utf-8"))["project"]["entry-points"]
    }
    assert groups == set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_module_exports_its_imports_and_page_documents_them(kind: str) -> None:
    """Exactly the imported names are exported and documented."""
    tree = ast.parse((PACKAGE / f"{kind}.py").read_text("utf-8"))
    imported = {
        alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    module = import_module(f"era_haptics.plugins.{kind}")
    assert imported == set(module.__all__)
    documented = re.findall(
        rf"^\.\. (?:auto|py:)\w+:: era_haptics\.plugins\.{kind}\.(\w+)", PLUGINS_PAGE, re.M
    )
    assert sorted(documented) == sorted(module.__all__)
    # Where the directive is not filled in, a link leads to the docstrings.
    assert f"](../../era_haptics/plugins/{kind}.py)" in PLUGINS_PAGE


RIG = on_two_amplifiers(era.load_rig(era.example_rig_path()))
PLATE = era.SolvedPlate(RIG)
ONE, OTHER, QUIET = (0.08, 0.06), (0.22, 0.16), (0.15, 0.11)


@pytest.fixture(scope="module", params=[False, True], ids=["quiet", "modulated"])
def answer(request: pytest.FixtureRequest) -> era.Answer:
    """Of two fingers, beside a quiet one that comes first, or one of them modulated."""
    frequencies = np.array([60.0, 120.0, 230.0, 250.0, 270.0])
    table = build_table(RIG, frequencies=frequencies, grid=era.Grid(4, 3), drive_mode="phased")
    # At 250 Hz, the only frequency of the table with side bands 20 Hz beside it.
    beating = era.Stimulus(modulation_hz=20, band_hz=(250.0, 250.0))
    first = era.Finger(ONE, beating), era.Finger(OTHER, era.Stimulus())
    other = era.Finger(QUIET, load=1.5), era.Finger(ONE, era.Stimulus(16.0)), first[1]
    found = era.answer(table, first if request.param else other)
    assert [len(layer.excitations) for layer in found.layers] == [3 if request.param else 1, 1]
    return found


def test_each_finger_feels_what_the_answer_says(answer: era.Answer) -> None:
    """Levels, and contrasts by the set that says least, in the end of what is played in time."""
    played = PLATE.play(answer, duration=1.5)
    by_set = [replace(played, threshold=each).fingers for each in RIG.promised_thresholds]
    assert len(by_set) == 2
    for felt, said, *by_each in zip(played.fingers, answer.fingers, *by_set, strict=True):
        assert felt.level_db_sl == pytest.approx(said.level_db_sl, abs=0.1)
        least = min(each.contrast_db for each in by_each)
        assert least == pytest.approx(said.contrast_db, abs=0.3)
    first, last = played.fingers[-2:]
    # A whole modulation, (1 + cos)² of 20 Hz, under a Hann window of 30 ms: 10 log10(3.25 / 0.10).
    swing = 15.1 if answer.layers[0].side_bands else 0.0
    assert np.ptp(first.levels_db_sl[-40:]) == pytest.approx(swing, abs=1.5 if swing else 0.2)
    assert last.to_frame()["level_db_sl"].iloc[-1] == pytest.approx(last.level_db_sl, abs=0.1)


@in_virtual_time
async def test_amplifiers_play_an_answer_as_the_plate_does(answer: era.Answer) -> None:
    """Two amplifiers on a wire, by their commands: at each finger each frequency within 0.1 dB."""
    played = PLATE.play(answer, duration=1.5)
    async with rig_on_wire(RIG, SHARED_WIRES["serial"]) as hosted:
        fingers = {str(number): each.finger for number, each in enumerate(answer.fingers)}
        hosted.bench.place_fingers(
            {name: each.at for name, each in fingers.items()},
            loads={name: each.load for name, each in fingers.items()},
            now=threads.now(),
        )
        await hosted.group.arm()
        await hosted.group.apply(era.commands_for(RIG, answer))
        await hosted.beat_until(threads.now() + 4)
        hosted.bench.advance(threads.now())
        records = hosted.bench.sample_fingers().felt(threads.now() - 0.5, threads.now())
    for number, record in enumerate(played.records):
        here, there = (
            np.sqrt((each.accelerations[-5000:] ** 2).mean(axis=0))
            for each in (record, records[str(number)])
        )
        assert 20 * np.log10(here.max() / there.max()) == pytest.approx(0, abs=0.1)


EXAMPLES = ROOT / "examples"

# Founding paper, in-house column of Table 2 [Hz].
TABLE_2 = ["31.98", "68.50", "76.62", "107.84", "160.77"]


@pytest.fixture(scope="module")
def cache(table_cache: Path) -> Iterator[None]:
    """A cache of tables of the tests' own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(table_cache))
        yield


@pytest.fixture
def beside_examples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder beside the examples' own plate."""
    (tmp_path / "examples").mkdir()
    shutil.copy(EXAMPLES / "paper_plate.yaml", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)


@pytest.mark.long
@pytest.mark.usefixtures("cache")
def test_researcher_example_reproduces_the_paper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Table 2, two contents apart, predicted against played measures, and pictures."""
    monkeypatch.setenv("ERA_PICTURES", str(tmp_path))
    ran: dict[str, Any] = runpy.run_path(str(EXAMPLES / "researcher.py"))
    assert [f"{frequency:.2f}" for frequency in ran["paper_frequencies"]] == TABLE_2
    assert all(finger.promised_contrast_db > 12 for finger in ran["joint"].fingers)
    playbacks = ran["playbacks"]
    for name, answer in ran["answers"].items():
        predicted = answer.fingers[0]
        onset = era.measures(ran["table"], answer)
        felt = playbacks[name]
        assert felt.contrast_db == pytest.approx(predicted.contrast_db, abs=0.2)
        assert felt.transient_contrast_db == pytest.approx(onset.transient_contrast_db, abs=0.4)
        assert felt.level_db_sl == pytest.approx(predicted.level_db_sl, abs=0.05)
    ramp, shaped = (
        playbacks[name].contrast_db - playbacks[name].transient_contrast_db
        for name in ("ramp", "shaped")
    )
    assert shaped < 0.75 * ramp  # of the steady contrast is lost while it starts
    assert ran["kept"] == sum(felt >= ran["promised_db"] for felt in ran["contrasts_db"])
    assert ran["kept"] >= 7
    assert (ran["study"]["phased"] >= ran["study"]["switched"] - 0.5).all()
    assert np.diff(ran["study"]["phased"]).min() > 0  # the farther, the easier
    pictures = sorted(path.name for path in tmp_path.iterdir())
    assert pictures == ["answer.png", "contents.png", "map.png", "ramp.png", "shaped.png"]


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.usefixtures("cache")
def test_hmi_engineer_example_feels_what_was_predicted() -> None:
    """The contrast on the plate in time is the predicted one, and the daemon ends with status 0."""
    done = subprocess.run(
        [sys.executable, EXAMPLES / "hmi_engineer.py"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "MPLBACKEND": "Agg"},
    )
    # A busy machine may be warned.
    errors = [line for line in done.stderr.splitlines() if '"level": "warning"' not in line]
    assert (done.returncode, errors) == (0, [])
    (felt,) = re.findall(r"contrast (\S+) dB felt", done.stdout)
    (predicted,) = re.findall(r"(\S+) dB predicted", done.stdout)
    assert float(predicted) > 20
    # It has vibrated for a second.
    assert float(felt) == pytest.approx(float(predicted), abs=1.5)
    assert "daemon ended with status 0" in done.stdout


@pytest.mark.usefixtures("cache", "beside_examples")
def test_page_example_feels_what_was_predicted(tmp_path: Path) -> None:
    """Twelve lines, executed as printed; played contrast is the predicted one."""
    lines = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)[0]
    assert len(lines.split("\n\n")[1].splitlines()) == 12
    (tmp_path / "page.py").write_text(lines, "utf-8")
    ran = runpy.run_path("page.py")
    assert ran["felt"].contrast_db == pytest.approx(ran["only"].fingers[0].contrast_db, abs=0.2)
    assert (tmp_path / "contents.png").stat().st_size > 10_000


@pytest.mark.usefixtures("cache", "beside_examples")
def test_readme_program_prints_what_is_said_of_each_finger(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As the README shows it, a line a finger below the scale; a quiet one has no contrast."""
    readme = (EXAMPLES.parent / "README.md").read_text("utf-8")
    (lines,) = re.findall(r"^```python\n(.*?)^```$", readme, re.MULTILINE | re.DOTALL)
    (shown,) = re.findall(r"^```text\n(.*?)^```$", readme, re.MULTILINE | re.DOTALL)
    (tmp_path / "readme.py").write_text(lines, "utf-8")
    runpy.run_path("readme.py")
    printed = capsys.readouterr().out
    assert printed == shown
    _, *fingers = printed.splitlines()
    assert ["contrast" in line for line in fingers] == [True, True, True, False]


def test_page_rig_needs_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nine lines, executed as printed: of three plates the thickest has the most contrast."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    lines = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)[1]
    exec(lines, {"era": era})
    contrasts = [float(line.split()[1]) for line in capsys.readouterr().out.splitlines()]
    assert len(contrasts) == 3
    assert contrasts == sorted(contrasts)


def test_page_lists_every_exception_with_its_base() -> None:
    """A row `NAME` (a `BASE`) for each exception that the package exports."""
    rows = re.findall(r"^\| `(\w+)`(?: \(an? `(\w+)`\))? \|", PAGE, re.MULTILINE)
    exported = {}
    for name in era.__all__:
        kind = getattr(era, name)
        if isinstance(kind, type) and issubclass(kind, Exception):
            exported[name] = {base.__name__ for base in kind.__mro__}
    assert {name for name, _ in rows} == exported.keys()
    assert all(base in {"", *exported[name]} for name, base in rows)


def test_page_documents_every_name() -> None:
    """Exactly the exported names."""

    documented = named(PAGE)
    errors = set(re.findall(r"`(\w+)`", PAGE.partition("| exception")[2].partition("\n## ")[0]))
    assert documented | (errors & set(era.__all__)) == set(era.__all__)
    assert documented & errors == set()


COMMAND = "import sys; sys.argv[0] = '/x/bin/era'; import era_haptics.command"  # as its script does
PROGRAM = "import era_haptics"


def said(program: str, *path: Path) -> tuple[int, list[str]]:
    """The exit status and lines of a program, with folders before others of Python's path."""
    done = ran(program, "-P", PYTHONPATH=os.pathsep.join(map(str, path)))
    return done.returncode, done.stderr.splitlines()


def written(path: Path, *, distribution: str = "") -> Path:
    """A file of another program, or of an installed distribution."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('"""Another."""\n', encoding="utf-8")
    if distribution:
        site = path.parents[1]
        info = site / f"{distribution}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\n", "utf-8")
        (info / "RECORD").write_text(f"{path.relative_to(site)},,\n", "utf-8")
    return path


@pytest.mark.parametrize(
    ("hiding", "distribution"),
    [
        pytest.param("model.py", "", marks=pytest.mark.long),
        pytest.param("sim/__init__.py", "", marks=pytest.mark.long),
        ("drivers/__init__.py", "other-drivers"),
    ],
)
def test_what_hides_a_package_is_named(tmp_path: Path, hiding: str, distribution: str) -> None:
    """A file, a folder and a distribution, to a program as an exception, to `era` as one line."""
    path = written(tmp_path / hiding, distribution=distribution)
    package = Path(hiding).parts[0].removesuffix(".py")
    hidden = ROOT / package
    sentence = f"{tmp_path / Path(hiding).parts[0]} hides {hidden}, "
    status, lines = said(PROGRAM, tmp_path)
    assert (status, path.exists()) == (1, True)
    assert lines[-1].startswith(f"era_haptics.packages.HiddenPackage: {sentence}")
    assert f"the package {package} of era-haptics; " in lines[-1]
    assert (f"by the distribution {distribution}," in lines[-1]) == bool(distribution)
    status, lines = said(COMMAND, tmp_path)
    assert (status, len(lines)) == (2, 1)
    assert lines[0].startswith(f"era: error: {sentence}")


@pytest.mark.parametrize(
    ("replaced", "words"),
    [("model/__init__.py", "is another program's, by the distribution other,"), ("sim", "missing")],
)
def test_replaced_and_missing_packages_are_named(tmp_path: Path, replaced: str, words: str) -> None:
    """In the folder of an installation, into which another distribution was installed later."""
    shutil.copytree(ROOT / "era_haptics", tmp_path / "era_haptics")
    for package in set(PACKAGES) - {"era_haptics"}:
        (tmp_path / package).mkdir()
        shutil.copy(ROOT / package / "__init__.py", tmp_path / package)
    assert said(PROGRAM, tmp_path) == (0, [])
    if replaced == "sim":
        (tmp_path / "sim" / "__init__.py").unlink()
    else:
        written(tmp_path / replaced, distribution="other")
    status, lines = said(PROGRAM, tmp_path)
    assert status == 1
    assert f"{tmp_path / replaced} " in lines[-1]
    assert words in lines[-1]


NOTEBOOK = "module://ipykernel_of_elsewhere.backend_inline"
BACKEND = (
    "import era_haptics as era; era.draw_map; import matplotlib as m; print(m.rcParams['backend'])"
)


@pytest.mark.long
@pytest.mark.parametrize("is_installed", [True, False])
def test_backend_of_a_notebook_is_kept_where_it_is_installed(
    tmp_path: Path, is_installed: bool
) -> None:
    """In the notebook pictures stay inline; what it starts elsewhere loads matplotlib, too."""
    name = f"backend_{tmp_path.name.lower()}"
    if is_installed:
        (tmp_path / f"{name}.py").write_text('"""A backend."""\n', "utf-8")
    done = ran(BACKEND, MPLBACKEND=f"module://{name}", PYTHONPATH=str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")
    assert (done.stdout.strip() == f"module://{name}") == is_installed


@pytest.mark.parametrize("backend", shortly([NOTEBOOK, "module://", "Qt4Agg"], ["Qt4Agg"]))
def test_command_draws_into_files_whatever_backend_is_named(backend: str) -> None:
    """That of a notebook, none, or one that matplotlib has no more; children inherit `agg`."""
    program = (
        "import os, sys; sys.argv[1:] = ['--version']; from era_haptics.command import main; "
        "main(); import model.figures.style; print(os.environ['MPLBACKEND'])"
    )
    done = ran(program, MPLBACKEND=backend)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-1] == "agg"


COARSE_RIG = era.load_rig(era.example_rig_path(), mesh="12x9")
SOLVED, DRIVE, TARGET = era.SolvedPlate(COARSE_RIG), {"SW": 110}, (0.08, 0.06)
ANSWER = era.query(small_table(), TARGET)

SHEET = era.Plate(length=0.3, width=0.2, thickness="2 mm", material="aluminium")
SPRING = era.Era(at=(0, 0), stiffness="17 kN/m", amplifier="main", channel=0)

GOOD: dict[Callable[..., Any], dict[str, Any]] = {
    era.load_rig: {"path": era.example_rig_path(), "mesh": "12x9"},
    era.example_rig_path: {},
    era.rig: {
        "plate": SHEET, "eras": {"SW": SPRING}, "amplifiers": {"main": {"url": "sim://"}},
        "masses": {}, "supports": {}, "mesh": "auto", "limits": {},
        "uncertainty": era.Uncertainty(),
        "fingertip": era.Fingertip(), "threshold": "vibrotactile-probe",
        "promised_thresholds": ["pressing-fingertip"],
    },
    era.change_rig: {"rig": COARSE_RIG, "changes": {}},
    era.save_rig: {"rig": COARSE_RIG, "path": "rig.yaml"},
    era.load_table: {"path": "t.npz", "rig": COARSE_RIG},
    era.save_table: {"table": None, "path": "t.npz"},
    era.table: {
        "rig": COARSE_RIG, "drive_mode": "switched", "frequencies": [60], "grid": era.Grid(4, 3),
        "progress": print,
    },
    era.query: {
        "table": None, "target": TARGET, "quiet": (), "level_db_sl": 20.0, "drive_mode": "phased",
        "duration": 0.04,
    },
    era.measures: {"table": None, "answer": ANSWER},
    era.contrast_map: {
        "table": None, "quiet": TARGET, "drive_modes": ["phased"], "level_db_sl": 20.0,
        "grid": era.Grid(2, 2), "progress": print,
    },
    era.answer: {
        "table": None, "fingers": [era.Finger(TARGET, era.Stimulus())],
        "quiet": [era.Finger((0.2, 0.1))], "drive_mode": "phased", "apart_hz": 30.0,
    },
    era.calibrate: {"rig": COARSE_RIG, "measured": "measured.csv", "progress": print},
    era.design: {
        "rig": COARSE_RIG, "eras": [4], "layouts": "random:3", "keep": ["SW"], "where": "edge",
        "contacts": "contacts.yaml", "contents": 1, "apart": 0.03, "lowest": 20.0,
        "stiffness": [17e3], "finalists": 1, "starts": 1, "seed": 0, "workers": 1,
        "cluster": "tcp://127.0.0.1:1", "progress": print, "on_layout": print,
    },
    era.SolvedPlate: {"rig": COARSE_RIG, "seed": 1},
    SOLVED.map: {"drive": DRIVE, "raster": (3, 3)},
    SOLVED.play: {
        "drive": np.zeros((4, 300)), "target": TARGET, "quiet": (), "loads": (1.5,),
        "duration": 0.3, "sample_rate": 3000,
    },
    SOLVED.responses: {"points": [TARGET], "frequencies": [60.0], "fingers": (), "seed": 1},
    era.draw_map: {"plate": SOLVED, "drive": DRIVE},
    era.draw_contrast_map: {
        "table": None,
        "found": era.ContrastMap(*np.zeros((2, 1)), (TARGET,), {"phased": np.zeros((1, 1))}, {}),
    },
    era.draw_answer: {"table": None, "answer": ANSWER, "layer": 0},
    era.draw_contents: {"table": None, "answer": ANSWER},
    era.draw_playback: {"playback": None},
    era.open_amplifier: {"rig": COARSE_RIG, "name": "main", "url": "sim://"},
    era.commands_for: {"rig": COARSE_RIG, "drive": DRIVE},
    era.Drive: {"frequency": 110.0, "level": 1.0, "phase_deg": 0.0},
    era.Grid: {"nx": 4, "ny": 3},
    era.Stimulus: {
        "level_db_sl": 20.0, "band_hz": (40.0, 90.0), "duration": 0.04, "modulation_hz": None,
        "name": "click", "course": None,
    },
    era.Finger: {
        "at": TARGET, "stimulus": era.Stimulus(), "load": 1.0, "priority": 0, "sharing": "never",
        "min_contrast_db": 12.0, "max_foreign_db_sl": -10.0,
    },
}  # fmt: skip
"""Valid arguments by function; None: a small table."""

TAKES_ANYTHING = {
    "bands_may_swap",
    "is_limit",
    "is_protected",
    "title",
    "shaped",
    "all_scales",
}

STRAYS = (object(), "here", 3.5, [object()])


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Iterator[era.LocalizationTable]:
    """A small table, saved as t.npz."""
    folder = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("XDG_CACHE_HOME", str(folder))
        made = small_table()
        era.save_table(made, "t.npz")
        yield made


@pytest.mark.parametrize(
    ("function", "name"),
    [(function, name) for function, given in GOOD.items() for name in given],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_function_refuses_an_argument_of_another_type(
    table: era.LocalizationTable, function: Callable[..., Any], name: str
) -> None:
    """By an InputError or a DriverError with a message."""
    good = {key: table if value is None else value for key, value in GOOD[function].items()}
    for stray in STRAYS:
        if isinstance(stray, type(good[name])) or (name == "path" and isinstance(stray, str)):
            continue
        with pytest.raises((era.InputError, era.DriverError)) as caught:
            function(**{**good, name: stray})
        assert len(str(caught.value)) > 30


def test_every_function_and_argument_is_listed() -> None:
    """So that a new function or argument is tested, too."""
    public = {getattr(era, name) for name in era.__all__}
    assert {each for each in public if inspect.isfunction(each)} <= set(GOOD)
    for function, given in GOOD.items():
        assert set(inspect.signature(function).parameters) - TAKES_ANYTHING == set(given)


FILES = sorted(
    path
    for path in (*EXAMPLES.glob("*.yaml"), EXAMPLES / "desk" / "rig.yaml")
    if "plate" in yaml.safe_load(path.read_text("utf-8"))
)
CORNERS = {"SW": (0, 0), "SE": ("12 in", 0), "NE": ("12 in", "9 in"), "NW": (0, "9 in")}
SHEET_OF_KEYS = era.Plate(length="12 in", width="9 in", thickness="1.5 mm", material="aluminium")
SPRINGS = {
    name: era.Era(at=at, stiffness="17 kN/m", amplifier="main", channel=number)
    for number, (name, at) in enumerate(CORNERS.items())
}
MAIN = {"main": {"url": "sim://"}}
KEYED = era.rig(SHEET_OF_KEYS, SPRINGS, amplifiers=MAIN)
WITH_MODES = era.rig({**SHEET_OF_KEYS, "modes": [(1.02, 1.1)]}, SPRINGS, amplifiers=MAIN)
SILENT = replace(ANSWER, contents=replace(ANSWER.contents, streams=()))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_rig_by_its_keys_is_that_of_the_file_and_reads_back(path: Path, tmp_path: Path) -> None:
    """Every example by PyYAML's reading of it; written from Python, and the file's own text."""
    data = yaml.safe_load(path.read_text("utf-8"))
    eras = {name: era.Era(**each) for name, each in data.pop("eras").items()}
    made = era.rig(era.Plate(**data.pop("plate")), eras, **data)
    read = era.load_rig(path)
    assert made == read
    for rig in (made, read):
        era.save_rig(rig, tmp_path / "rig.yaml")
        assert era.load_rig(tmp_path / "rig.yaml") == made
    assert (tmp_path / "rig.yaml").read_text("utf-8") == path.read_text("utf-8")


def test_rig_with_defaults_is_the_papers_and_has_its_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without damping, loss factor and stroke, which the example states as they are by default."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    rig = era.rig(SHEET_OF_KEYS, SPRINGS, amplifiers=MAIN)
    assert rig == era.load_rig(EXAMPLES / "paper_plate.yaml")
    bare = {name: era.Era(at=each["at"], stiffness=17e3) for name, each in SPRINGS.items()}
    assert era.rig(SHEET_OF_KEYS, bare) == rig  # a simulated amplifier, channels in order
    steps: list[tuple[int, int]] = []
    table = era.table(rig, frequencies=[60], progress=lambda *done: steps.append(done))
    assert (table.fingerprint, steps) == (rig.fingerprint, [(1, 2), (2, 2)])


def test_thickness_takes_the_damping_the_mesh_and_the_frequencies_with_it() -> None:
    """c = 2 zeta sqrt(k m / n) by hand; a thin free plate's elastic frequencies go with h.

    Shear and rotary inertia lower those of 1 mm by 0.1 % more than those of 0.5 mm.
    """
    rig = era.rig(SHEET_OF_KEYS, SPRINGS, amplifiers=MAIN)
    thin, thick = (change_rig(rig, thickness=each) for each in ("0.5 mm", 0.001))
    assert thin.mesh != thick.mesh
    mass = 2700 * 0.001 * 0.3048 * 0.2286
    assert thick.eras[0].damping == pytest.approx(2 * 0.05 * math.sqrt(17e3 * mass / 4))
    low, high = (
        np.sort(solve_free_plate(each.plate, thin.mesh, frequency_max=500).modes.eigenvalues)[3:13]
        for each in (thin, thick)
    )
    assert np.sqrt(high / low) == pytest.approx(2, rel=2e-3)


def test_places_keep_their_share_of_the_plates_sides() -> None:
    """Corners stay corners, of ERAs and masses; those given beside sides are taken as given."""
    rig = era.rig(
        SHEET_OF_KEYS,
        SPRINGS,
        amplifiers=MAIN,
        masses={"camera": {"at": (0.1, 0.05), "mass": 0.01}},
    )
    wider = change_rig(rig, length=0.4, width=np.float32(0.3))
    assert np.allclose(
        [(each.x, each.y) for each in wider.eras], [(0, 0), (0.4, 0), (0.4, 0.3), (0, 0.3)]
    )
    camera = wider.masses[0]
    assert (camera.x, camera.y) == pytest.approx((0.1 * 0.4 / 0.3048, 0.05 * 0.3 / 0.2286))
    assert change_rig(wider, length="12 in", width="9 in").eras == rig.eras
    assert change_rig(rig, length=0.4, eras=SPRINGS).eras[1].x == 0.3048


def test_keys_of_the_plate_and_of_single_eras_are_changed_alone() -> None:
    """The damping goes with the stiffness; an ERA is added, another left out; others stay."""
    changed = change_rig(
        KEYED, plate={"thickness": "2 mm"}, length=0.4, eras={"SW": {"stiffness": 2e4}, "NW": None}
    )
    assert changed.plate.thickness == 0.002
    assert [(each.name, each.x, each.stiffness) for each in changed.eras] == [
        ("SW", 0, 2e4), ("SE", pytest.approx(0.4), 17e3), ("NE", pytest.approx(0.4), 17e3)
    ]  # fmt: skip
    mass = 2700 * 0.002 * 0.4 * 0.2286
    assert changed.eras[0].damping == pytest.approx(2 * 0.05 * math.sqrt(2e4 * mass / 3))
    assert change_rig(changed, eras={"NW": SPRINGS["NW"]}).eras[3].stiffness == 17e3
    assert change_rig(KEYED, fingertip=None) == KEYED
    assert change_rig(KEYED, fingertip="none").fingertip is None


def test_deviations_of_modes_stay_or_are_left_out() -> None:
    """With a change that leaves the modes as they were, or by None."""
    assert change_rig(WITH_MODES, thickness="2 mm", modes=None).plate.mode_deviations == ()
    assert change_rig(WITH_MODES, loss_factor=0.02).plate.mode_deviations != ()


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: era.Plate(length=-1, widht=2), ["length: must be above 0", "widht: unknown key"]),
        (lambda: era.Era(at=(0, 0)), ["era.Era: stiffness: missing"]),
        (lambda: era.rig(SHEET_OF_KEYS, SPRINGS, amplifiers={}), ["eras.SW.amplifier: unknown"]),
        (lambda: era.rig(3, 4, amplifiers=5), ["plate: must be a map", "eras: must be a map"]),
        (lambda: change_rig(KEYED, thicknes=1), ["plate.thicknes: unknown key; did you mean"]),
        (lambda: change_rig(KEYED, plate={"thicknes": 1}), ["plate.thicknes: unknown key"]),
        (lambda: change_rig(KEYED, plate=3, length=2), ["plate must be a Mapping, got 3"]),
        (lambda: change_rig(KEYED, eras={"SW": 3}, length=2), ["eras.SW: must be a map"]),
        (lambda: era.rig(SHEET_OF_KEYS, 4), ["eras must be a Mapping, got 4"]),
        (lambda: era.rig(SHEET_OF_KEYS, {"SW": 4}), ["eras.SW: must be a map"]),
        (lambda: change_rig(KEYED, length="2 kg"), ["plate.length: '2 kg' is not a length"]),
        (lambda: change_rig(KEYED, mesh="2x2"), ["change_rig: mesh: 2x2 is too coarse"]),
        (lambda: era.save_rig(KEYED, "rig.txt"), ["must end in .yaml"]),
        # Without the finger of its keys, or without them, a rig is another one.
        (lambda: era.save_rig(replace(KEYED, fingertip=None), "rig.yaml"), ["rig must"]),
        (lambda: era.save_rig(replace(KEYED, document=None), "rig.yaml"), ["rig must"]),
        # Deviations of modes were identified on the plate before.
        (lambda: change_rig(WITH_MODES, thickness="2 mm"), ["plate.modes must be given"]),
        # Drives have no fingers, and those of an answer have their loads; silence is not played.
        (lambda: SOLVED.play({"SW": 110}), ["target must be"]),
        (lambda: SOLVED.play(ANSWER, quiet=[QUIET]), ["target must be"]),
        (lambda: SOLVED.play(ANSWER, loads=[1]), ["target must be"]),
        (lambda: SOLVED.map(SILENT), ["must have a layer"]),
    ],
)  # fmt: skip
def test_errors_name_the_argument_as_a_file_its_key(make, named: list[str]) -> None:
    """All at once, without the line of a file that there is not."""
    with pytest.raises(era.InputError) as refused:
        make()
    assert all(each in str(refused.value) for each in named)


def test_fitted_rig_is_saved_and_changed(tmp_path: Path) -> None:
    """Of values that a calibration changes."""
    plate = replace(KEYED.plate, material=replace(KEYED.plate.material, E=72.5e9))
    fitted = replace(KEYED, plate=plate, uncertainty=era.Uncertainty(thickness=0.002))
    era.save_rig(fitted, tmp_path / "rig.yaml")
    back = era.load_rig(tmp_path / "rig.yaml")
    assert (back.plate, back.uncertainty) == (plate, fitted.uncertainty)
    assert back.eras[0].damping == pytest.approx(KEYED.eras[0].damping, rel=1e-5)
    assert change_rig(fitted, thickness=0.002).plate == replace(plate, thickness=0.002)
