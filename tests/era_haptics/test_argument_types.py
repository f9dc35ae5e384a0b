"""Arguments of another type are refused by all public functions, and never raise TypeError."""

import inspect
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import era_haptics as era
from kit.plates import small_table

RIG = era.load_rig(era.example_rig_path(), mesh="12x9")
PLATE = era.SolvedPlate(RIG)
DRIVE = {"SW": 110}
TARGET = (0.08, 0.06)
ANSWER = era.query(small_table(), TARGET)
FINGER = era.Finger(TARGET, era.Stimulus())
QUIET = era.Finger((0.2, 0.1))
SHEET = era.Plate(length=0.3, width=0.2, thickness="2 mm", material="aluminium")
SPRING = era.Era(at=(0, 0), stiffness="17 kN/m", amplifier="main", channel=0)
CONTRASTS = era.ContrastMap(*np.zeros((2, 1)), (TARGET,), {"phased": np.zeros((1, 1))}, {})

VALID: dict[Callable[..., Any], dict[str, Any]] = {}
"""Valid arguments by function; None: a small table."""


def accepts(function: Callable[..., Any], **arguments: Any) -> None:
    """Register valid arguments of a function."""
    VALID[function] = arguments


accepts(era.load_rig, path=era.example_rig_path(), mesh="12x9")
accepts(era.example_rig_path)
accepts(
    era.rig,
    plate=SHEET,
    eras={"SW": SPRING},
    amplifiers={"main": {"url": "sim://"}},
    masses={},
    supports={},
    mesh="auto",
    limits={},
    uncertainty=era.Uncertainty(),
    fingertip=era.Fingertip(),
    threshold="vibrotactile-probe",
    promised_thresholds=["pressing-fingertip"],
)
accepts(era.change_rig, rig=RIG, changes={})
accepts(era.save_rig, rig=RIG, path="rig.yaml")
accepts(era.load_table, path="t.npz", rig=RIG)
accepts(era.save_table, table=None, path="t.npz")
accepts(
    era.table,
    rig=RIG,
    drive_mode="switched",
    frequencies=[60],
    grid=era.Grid(4, 3),
    progress=print,
)
accepts(
    era.query,
    table=None,
    target=TARGET,
    quiet=(),
    level_db_sl=20.0,
    drive_mode="phased",
    duration=0.04,
)
accepts(era.measures, table=None, answer=ANSWER)
accepts(era.detection_threshold, frequency=60.0, threshold="vibrotactile-probe")
accepts(era.simulated_panel, rig=RIG, seed=1, layout={})
accepts(
    era.contrast_map,
    table=None,
    quiet=TARGET,
    drive_modes=["phased"],
    level_db_sl=20.0,
    grid=era.Grid(2, 2),
    progress=print,
)
accepts(
    era.answer,
    table=None,
    fingers=[FINGER],
    quiet=[QUIET],
    drive_mode="phased",
    apart_hz=30.0,
)
accepts(era.calibrate, rig=RIG, measured="measured.csv", progress=print)
accepts(
    era.design,
    rig=RIG,
    eras=[4],
    layouts="random:3",
    keep=["SW"],
    where="edge",
    contacts="contacts.yaml",
    contents=1,
    apart=0.03,
    lowest=20.0,
    stiffness=[17e3],
    finalists=1,
    starts=1,
    seed=0,
    workers=1,
    cluster="tcp://127.0.0.1:1",
    progress=print,
    on_layout=print,
)
accepts(era.SolvedPlate, rig=RIG, seed=1)
accepts(PLATE.map, drive=DRIVE, raster=(3, 3))
accepts(
    PLATE.play,
    drive=np.zeros((4, 300)),
    target=TARGET,
    quiet=(),
    loads=(1.5,),
    duration=0.3,
    sample_rate=3000,
)
accepts(PLATE.responses, points=[TARGET], frequencies=[60.0], fingers=(), seed=1)
accepts(era.draw_map, plate=PLATE, drive=DRIVE)
accepts(era.draw_contrast_map, table=None, found=CONTRASTS)
accepts(era.draw_answer, table=None, answer=ANSWER, layer=0)
accepts(era.draw_contents, table=None, answer=ANSWER)
accepts(era.draw_playback, playback=None)
accepts(era.page, rig=RIG, path="rig.html", sensors={"P1": TARGET}, progress=print)
accepts(era.open_amplifier, rig=RIG, name="main", url="sim://")
accepts(era.commands_for, rig=RIG, drive=DRIVE)
accepts(era.Drive, frequency=110.0, level=1.0, phase_deg=0.0)
accepts(era.Grid, nx=4, ny=3)
accepts(
    era.Stimulus,
    level_db_sl=20.0,
    band_hz=(40.0, 90.0),
    duration=0.04,
    modulation_hz=None,
    name="click",
    course=None,
)
accepts(
    era.Finger,
    at=TARGET,
    stimulus=era.Stimulus(),
    load=1.0,
    priority=0,
    sharing="never",
    min_contrast_db=12.0,
    max_foreign_db_sl=-10.0,
)

TAKES_ANYTHING = {"bands_may_swap", "is_limit", "is_protected", "title", "shaped", "all_scales"}
STRAY_VALUES = (object(), "here", 3.5, [object()])


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Iterator[era.LocalizationTable]:
    """A small table, saved as t.npz in the working directory."""
    folder = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("XDG_CACHE_HOME", str(folder))
        era.save_table(small_table(), "t.npz")
        yield small_table()


@pytest.mark.parametrize(
    ("function", "name"),
    [(function, name) for function, arguments in VALID.items() for name in arguments],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_function_refuses_an_argument_of_another_type(
    table: era.LocalizationTable, function: Callable[..., Any], name: str
) -> None:
    """By an InputError or a DriverError with a message."""
    arguments = dict(VALID[function])
    for key, value in arguments.items():
        if value is None:
            arguments[key] = table
    kind = str if name == "path" else type(arguments[name])

    for stray in STRAY_VALUES:
        if isinstance(stray, kind):
            continue
        with pytest.raises((era.InputError, era.DriverError)) as error:
            function(**arguments | {name: stray})
        assert len(str(error.value)) > 30


def test_every_function_and_argument_is_tested() -> None:
    """Including new ones."""
    public = {getattr(era, name) for name in era.__all__}
    functions = {exported for exported in public if inspect.isfunction(exported)}

    assert functions <= set(VALID)
    for function, arguments in VALID.items():
        parameters = set(inspect.signature(function).parameters)
        assert parameters - TAKES_ANYTHING == set(arguments), function
