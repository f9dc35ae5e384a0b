"""Arguments of another type: refused by every public function, never as an AttributeError."""

import inspect
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import era_haptics as era
from plates import small_table

RIG = era.load_rig(era.example_rig_path(), mesh="12x9")
PLATE, DRIVE, TARGET = era.SolvedPlate(RIG), {"SW": 110}, (0.08, 0.06)
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
    era.save_rig: {"rig": RIG, "path": "rig.yaml"},
    era.load_table: {"path": "t.npz", "rig": RIG},
    era.save_table: {"table": None, "path": "t.npz"},
    era.table: {
        "rig": RIG, "drive_mode": "switched", "frequencies": [60], "grid": era.Grid(4, 3),
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
    era.calibrate: {"rig": RIG, "measured": "measured.csv", "progress": print},
    era.design: {
        "rig": RIG, "eras": [4], "layouts": "random:3", "keep": ["SW"], "where": "edge",
        "contacts": "contacts.yaml", "contents": 1, "apart": 0.03, "lowest": 20.0,
        "stiffness": [17e3], "finalists": 1, "starts": 1, "seed": 0, "workers": 1,
        "cluster": "tcp://127.0.0.1:1", "progress": print,
    },
    era.SolvedPlate: {"rig": RIG, "seed": 1},
    PLATE.map: {"drive": DRIVE, "raster": (3, 3)},
    PLATE.play: {
        "drive": np.zeros((4, 300)), "target": TARGET, "quiet": (), "loads": (1.5,),
        "duration": 0.3, "sample_rate": 3000,
    },
    PLATE.responses: {"points": [TARGET], "frequencies": [60.0], "fingers": (), "seed": 1},
    era.draw_map: {"plate": PLATE, "drive": DRIVE},
    era.draw_contrast_map: {
        "table": None,
        "found": era.ContrastMap(*np.zeros((2, 1)), (TARGET,), {"phased": np.zeros((1, 1))}, {}),
    },
    era.draw_answer: {"table": None, "answer": ANSWER, "layer": 0},
    era.draw_contents: {"table": None, "answer": ANSWER},
    era.draw_playback: {"playback": None},
    era.open_amplifier: {"rig": RIG, "name": "main", "url": "sim://"},
    era.commands_for: {"rig": RIG, "drive": DRIVE},
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
    functions = {each for each in public if inspect.isfunction(each)}
    assert functions <= set(GOOD)
    for function, given in GOOD.items():
        arguments = set(inspect.signature(function).parameters) - TAKES_ANYTHING
        assert arguments == set(given)
