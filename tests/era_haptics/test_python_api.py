"""The Python API: names, pages, examples and notebooks, and answers of several contents."""

import ast
import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import era_haptics as era
import era_haptics.plugins
from cases import shortly
from kit.clock import in_virtual_time
from kit.wires import SHARED_WIRES, on_two_amplifiers, rig_on_wire
from model.table.table_file import build_table
from python_page import named
from registry import threads

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
PAGE = (ROOT / "docs" / "reference" / "python-api.md").read_text("utf-8")
PYTHON_BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TEXT_BLOCK = re.compile(r"^```text\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def run_python(program: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    """Run a program in a process of its own, with these additional variables."""
    return subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | environment,
    )


def printed(program: str, **environment: str) -> str:
    """Return the output of a program that must succeed without warnings."""
    completed = run_python(program, **environment)
    assert completed.stderr == ""
    assert completed.returncode == 0
    return completed.stdout


# The reference page


def test_page_documents_every_name() -> None:
    """Exactly the exported names, exceptions in their table."""
    documented = named(PAGE)

    *_, exceptions = PAGE.partition("| exception")
    table, *_ = exceptions.partition("\n## ")
    errors = set(re.findall(r"`(\w+)`", table))
    assert documented | (errors & set(era.__all__)) == set(era.__all__)
    assert documented & errors == set()


# Names


def imports_of_stub() -> dict[str, tuple[str, str]]:
    """Return the module and the name there of all names that type checkers find."""
    stub = Path(era.__file__).with_suffix(".pyi")
    homes = {}
    renamed = {}
    for node in ast.parse(stub.read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                homes[alias.asname or alias.name] = (node.module, alias.name)
                if not alias.asname:
                    renamed[alias.name] = homes.pop(alias.name)
        elif isinstance(node, ast.Assign):
            homes[ast.unparse(node.targets[0])] = renamed[ast.unparse(node.value)]
    return homes


def test_every_name_is_loaded_from_where_type_checkers_find_it() -> None:
    """Compared with the imports of the stub."""
    homes = imports_of_stub()

    assert sorted(homes) == sorted(era.__all__) == sorted(dir(era))
    for name, (module, own_name) in homes.items():
        assert getattr(era, name) is getattr(import_module(module), own_name), name


NOT_LOADED = {
    "e.Client": "scipy matplotlib sim serial",
    "e.load_rig": "matplotlib sim controller",
    "e.plugins.wires": "model controller sim numpy scipy",
    "e.SolvedPlate": "matplotlib controller",
    "e.draw_map": "matplotlib.pyplot",
    "e.plugins.touch_sources": "sim numpy scipy matplotlib pythonosc",
    "e.plugins.content_formats": "sim scipy matplotlib drivers",
    "e.plugins.effects": "sim matplotlib drivers.backend",
    "e.plugins.materials": "sim controller drivers numpy",
}
SHORT_NAMES = ("e.Client", "e.load_rig", "e.plugins.wires")


@pytest.mark.parametrize("name", shortly(NOT_LOADED, SHORT_NAMES))
def test_name_loads_only_what_it_needs(name: str) -> None:
    """A client of the daemon is loaded without linear algebra, a plate without pyplot."""
    submodule = f"import era_haptics.{name[2:]}" if "plugins" in name else "pass"

    modules = printed(
        f"import sys; import era_haptics as e; {submodule}; {name}; print(*sys.modules)"
    )

    unwanted = set(NOT_LOADED[name].split())
    assert unwanted.isdisjoint(modules.split())


PLUGINS_PAGE = (ROOT / "docs" / "reference" / "plugins.md").read_text("utf-8")
PLUGINS = Path(era_haptics.plugins.__file__).parent
PLUGIN_MODULES = sorted(path.stem for path in PLUGINS.glob("[!_]*.py"))


def test_plugin_modules_have_the_names_of_entry_point_groups() -> None:
    """The examples register plug-ins in the groups that the modules are named for."""
    groups = set()
    for path in (EXAMPLES / "plugins").glob("*/pyproject.toml"):
        project = tomllib.loads(path.read_text("utf-8"))["project"]
        groups |= {group.removeprefix("era_haptics.") for group in project["entry-points"]}

    assert groups == set(PLUGIN_MODULES)


@pytest.mark.parametrize("kind", PLUGIN_MODULES)
def test_plugin_module_exports_its_imports_and_the_page_documents_them(kind: str) -> None:
    """Exactly the imported names are exported and documented."""
    tree = ast.parse((PLUGINS / f"{kind}.py").read_text("utf-8"))
    imported = set()
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            imported |= {alias.name for alias in node.names}

    exported = import_module(f"era_haptics.plugins.{kind}").__all__

    assert set(exported) == imported
    directive = rf"^\.\. (?:auto|py:)\w+:: era_haptics\.plugins\.{kind}\.(\w+)"
    documented = re.findall(directive, PLUGINS_PAGE, re.MULTILINE)
    assert sorted(documented) == sorted(exported)
    # If the directive is not filled in, a link leads to the docstrings.
    assert f"](../../era_haptics/plugins/{kind}.py)" in PLUGINS_PAGE


# Answers of several contents

RIG = on_two_amplifiers(era.load_rig(era.example_rig_path()))
PLATE = era.SolvedPlate(RIG)
FIRST = (0.08, 0.06)
SECOND = (0.22, 0.16)
QUIET = (0.15, 0.11)


@pytest.fixture(scope="module", params=[False, True], ids=["quiet", "modulated"])
def answer(request: pytest.FixtureRequest) -> era.Answer:
    """Two fingers, after a quiet one, or the first modulated."""
    frequencies = np.array([60.0, 120.0, 230.0, 250.0, 270.0])
    table = build_table(RIG, frequencies=frequencies, grid=era.Grid(4, 3), drive_mode="phased")
    second = era.Finger(SECOND, era.Stimulus())
    if request.param:
        # At 250 Hz, the only frequency of the table with side bands 20 Hz from it.
        beating = era.Stimulus(modulation_hz=20, band_hz=(250.0, 250.0))
        served = era.answer(table, [era.Finger(FIRST, beating), second])
        assert len(served.layers[0].side_bands) == 2
        return served
    first = era.Finger(FIRST, era.Stimulus(16.0))
    return era.answer(table, [era.Finger(QUIET, load=1.5), first, second])


def test_each_finger_feels_what_the_answer_predicts(answer: era.Answer) -> None:
    """Levels, and contrasts by the lowest set of thresholds, at the end of a playback in time."""
    playback = PLATE.play(answer, duration=1.5)

    contrasts = []
    for threshold in RIG.promised_thresholds:
        by_set = replace(playback, threshold=threshold)
        contrasts.append([felt.contrast_db for felt in by_set.fingers])
    predicted = answer.fingers
    levels = [felt.level_db_sl for felt in playback.fingers]
    assert len(contrasts) == 2
    assert levels == pytest.approx([finger.level_db_sl for finger in predicted], abs=0.1)
    lowest = np.min(contrasts, axis=0).tolist()
    assert lowest == pytest.approx([finger.contrast_db for finger in predicted], abs=0.3)
    first, last = playback.fingers[-2:]
    # A whole modulation, (1 + cos)² of 20 Hz, under a Hann window of 30 ms: 10 log10(3.25 / 0.10).
    swing = 15.1 if answer.layers[0].side_bands else 0.0
    tolerance = 1.5 if swing else 0.2
    assert np.ptp(first.levels_db_sl[-40:]) == pytest.approx(swing, abs=tolerance)
    last_level = last.to_frame()["level_db_sl"].iloc[-1]
    assert last_level == pytest.approx(last.level_db_sl, abs=0.1)


def rms_of_end(record: Any) -> float:
    """Return the highest RMS of the last half second of a record."""
    squares = record.accelerations[-5000:] ** 2
    return float(np.sqrt(squares.mean(axis=0).max()))


@in_virtual_time
async def test_amplifiers_play_an_answer_as_the_plate_does(answer: era.Answer) -> None:
    """Two amplifiers on a wire, by their commands: each finger feels the same within 0.1 dB."""
    playback = PLATE.play(answer, duration=1.5)
    places = {}
    loads = {}
    for number, sensation in enumerate(answer.fingers):
        places[str(number)] = sensation.finger.at
        loads[str(number)] = sensation.finger.load

    async with rig_on_wire(RIG, SHARED_WIRES["serial"]) as hosted:
        hosted.bench.place_fingers(places, loads=loads, now=threads.now())
        await hosted.group.arm()
        await hosted.group.apply(era.commands_for(RIG, answer))
        await hosted.beat_until(threads.now() + 4)
        hosted.bench.advance(threads.now())
        records = hosted.bench.sample_fingers().felt(threads.now() - 0.5, threads.now())

    for number, record in enumerate(playback.records):
        ratio = rms_of_end(record) / rms_of_end(records[str(number)])
        assert 20 * np.log10(ratio) == pytest.approx(0, abs=0.1), number


# Examples and pages


@pytest.fixture(scope="module")
def cache(table_cache: Path) -> Iterator[None]:
    """A cache of tables for these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(table_cache))
        yield


@pytest.fixture
def example_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A working directory with the examples' own plate."""
    (tmp_path / "examples").mkdir()
    shutil.copy(EXAMPLES / "paper_plate.yaml", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)


@pytest.mark.long
@pytest.mark.usefixtures("cache")
def test_researcher_example_reproduces_the_paper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Table 2, separate contents, predicted against played measures, and pictures."""
    monkeypatch.setenv("ERA_PICTURES", str(tmp_path))

    results = runpy.run_path(str(EXAMPLES / "researcher.py"))

    # Founding paper, in-house column of Table 2 [Hz].
    rounded = [f"{frequency:.2f}" for frequency in results["paper_frequencies"]]
    assert rounded == ["31.98", "68.50", "76.62", "107.84", "160.77"]
    assert min(finger.promised_contrast_db for finger in results["joint"].fingers) > 12
    losses = {}
    for name, answer in results["answers"].items():
        predicted = answer.fingers[0]
        onset = era.measures(results["table"], answer)
        felt = results["playbacks"][name]
        assert felt.contrast_db == pytest.approx(predicted.contrast_db, abs=0.2)
        assert felt.transient_contrast_db == pytest.approx(onset.transient_contrast_db, abs=0.4)
        assert felt.level_db_sl == pytest.approx(predicted.level_db_sl, abs=0.05)
        losses[name] = felt.contrast_db - felt.transient_contrast_db
    assert losses["shaped"] < 0.75 * losses["ramp"]
    contrasts = np.array(results["contrasts_db"])
    assert results["kept"] == np.sum(contrasts >= results["promised_db"]) >= 7
    study = results["study"]
    assert min(study["phased"] - study["switched"]) >= -0.5
    assert np.diff(study["phased"]).min() > 0  # the farther, the easier
    pictures = {path.name for path in tmp_path.iterdir()}
    assert pictures == {"answer.png", "contents.png", "map.png", "ramp.png", "shaped.png"}


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.usefixtures("cache")
def test_hmi_engineer_example_feels_the_predicted_contrast() -> None:
    """On the plate in time; the daemon ends with status 0."""
    program = (
        f"import runpy; runpy.run_path({str(EXAMPLES / 'hmi_engineer.py')!r}, None, '__main__')"
    )

    completed = run_python(program, MPLBACKEND="Agg")

    # A busy machine may be warned.
    errors = [line for line in completed.stderr.splitlines() if '"level": "warning"' not in line]
    assert errors == []
    assert completed.returncode == 0
    (felt,) = re.findall(r"contrast (\S+) dB felt", completed.stdout)
    (predicted,) = re.findall(r"(\S+) dB predicted", completed.stdout)
    assert float(predicted) > 20
    # It has vibrated for a second.
    assert float(felt) == pytest.approx(float(predicted), abs=1.5)
    assert "daemon ended with status 0" in completed.stdout


def test_first_program_of_the_page_needs_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of three plates the thickest has the most contrast."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    program, *_ = PYTHON_BLOCK.findall(PAGE)

    exec(program, {"era": era})

    contrasts = [float(line.split()[1]) for line in capsys.readouterr().out.splitlines()]
    assert len(contrasts) == 3
    assert contrasts == sorted(contrasts)


@pytest.mark.usefixtures("cache", "example_folder")
def test_readme_program_prints_the_output_of_the_readme(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line a finger below the scale; a quiet one has no contrast."""
    readme = (ROOT / "README.md").read_text("utf-8")
    (program,) = PYTHON_BLOCK.findall(readme)
    (output,) = TEXT_BLOCK.findall(readme)
    (tmp_path / "readme.py").write_text(program, "utf-8")

    runpy.run_path("readme.py")

    assert capsys.readouterr().out == output
    _, *fingers = output.splitlines()
    assert ["contrast" in line for line in fingers] == [True, True, True, False]


# Backends of matplotlib


@pytest.mark.long
@pytest.mark.parametrize("is_installed", [True, False])
def test_backend_of_a_notebook_is_kept_if_it_is_installed(
    tmp_path: Path, is_installed: bool
) -> None:
    """Pictures stay inline in the notebook; programs started elsewhere load matplotlib too."""
    name = f"backend_{tmp_path.name.lower()}"
    if is_installed:
        (tmp_path / f"{name}.py").write_text('"""A backend."""\n', "utf-8")
    program = (
        "import era_haptics as era; era.draw_map; "
        "import matplotlib; print(matplotlib.rcParams['backend'])"
    )

    backend = printed(program, MPLBACKEND=f"module://{name}", PYTHONPATH=str(tmp_path))

    assert (backend.strip() == f"module://{name}") == is_installed


NOTEBOOK = "module://ipykernel_of_elsewhere.backend_inline"


@pytest.mark.parametrize("backend", shortly([NOTEBOOK, "module://", "Qt4Agg"], ["Qt4Agg"]))
def test_command_draws_into_files_whatever_backend_is_named(backend: str) -> None:
    """A notebook's, none, or one that matplotlib no longer has; children inherit `agg`."""
    program = (
        "import os, sys; sys.argv[1:] = ['--version']; from era_haptics.command import main; "
        "main(); import model.figures.style; print(os.environ['MPLBACKEND'])"
    )

    *_, environment = printed(program, MPLBACKEND=backend).splitlines()

    assert environment == "agg"
