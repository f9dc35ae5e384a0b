"""Examples of eight, twelve and sixteen ERAs, from their files to fingertips in virtual time."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import model
from controller.demo.demonstration import Scene, example_scenes, run_demo
from controller.effects.layout import load_layout
from controller.sources.tuio import read_capture
from long_form import shortly
from model.rig.rig_file import load_rig
from model.table.table_file import build_table
from several_fingers import write_schedule
from virtual_lines import run_virtual

EXAMPLES = Path(model.__file__).parents[1] / "examples"
CHANNELS = {"eight_eras": [4, 4], "car_display": [4, 4, 4], "table": [4, 4, 4, 4]}
SCHEDULE = ((1, 0.1, 0.9, 0.30, 0.35), (2, 0.15, 0.9, 0.80, 0.70))
"""Fingers: id, down and up [s], place in TUIO's coordinates."""


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two fingers, the second of which shall feel it."""
    path = tmp_path_factory.mktemp("touches") / "touches.tuio"
    return write_schedule(path, SCHEDULE, 1.0)


@pytest.mark.parametrize("name", shortly(CHANNELS, ["eight_eras", "car_display"]))
def test_finger_feels_what_many_eras_promise(name: str, capture: Path) -> None:
    """All ERAs on all amplifiers play, and the fingers feel at least the promised contrast.

    On the first plate that is drawn, level within 3 dB; by fields of the plate in time. The levels
    that its picture shows differ by the contrast in its title.
    """
    file = EXAMPLES / f"{name}.yaml"
    rig = load_rig(file)
    counts = Counter(wire.amplifier for wire in rig.wiring.values())
    assert [counts[amplifier] for amplifier in rig.amplifiers] == CHANNELS[name]
    table = build_table(rig, frequencies=np.array([120.0, 160.0, 200.0]), drive_mode="phased")
    rows = run_virtual(
        run_demo(
            file,
            table,
            wire="sim",
            scenes=[Scene(read_capture(capture))],
            on_row=lambda row: None,
        )
    )
    row = rows[-1]
    assert row.drive.keys() == {era.name for era in rig.eras}
    x, y = SCHEDULE[1][3:]
    assert row.targets_m == [pytest.approx((x * rig.plate.length, (1 - y) * rig.plate.width))]
    assert row.steady
    assert row.measured_contrast_db is not None
    assert row.promised_contrast_db is not None
    assert row.measured_contrast_db >= row.promised_contrast_db > 6
    (quiet,) = row.quiet
    shown = row.levels_db_sl[row.target_id] - row.levels_db_sl[quiet]
    assert shown == pytest.approx(row.measured_contrast_db)
    assert row.measured_level_db_sl == pytest.approx(row.predicted_level_db_sl, abs=3)


def test_three_people_each_feel_their_own_content_while_one_slides_and_one_leaves() -> None:
    """In its band, and promised as its own; at least that on the first plate that is drawn.

    The one that slides by a third of the plate feels it where it rests at last, and the rows of
    all three are of that moment, with one set of figures.
    """
    file = EXAMPLES / "car_display.yaml"
    rig = load_rig(file)
    table = build_table(rig, frequencies=np.arange(70.0, 301.0, 10.0), drive_mode="phased")
    scene = example_scenes(rig)[-1]
    rows = run_virtual(run_demo(file, table, wire="sim", scenes=[scene], on_row=lambda row: None))
    slid, stayed, left = rows
    assert len(slid.fingers) == 3
    assert slid.fingers == stayed.fingers == left.fingers
    for row, finger in zip(rows, slid.fingers, strict=True):
        assert row.measured_contrast_db == finger.measured_contrast_db
        assert row.targets_m == [finger.at_m]
    assert slid.targets_m == [pytest.approx((0.15 * 0.53, 0.65 * 0.30), abs=0.008)]
    bands = [(70, 110), (180, 220), (250, 300)]
    for finger, (low, high) in zip(slid.fingers, bands, strict=True):
        assert finger.frequency_hz is not None
        assert low <= finger.frequency_hz <= high
        assert finger.verdict == "own"
        assert finger.measured_contrast_db is not None
        assert finger.promised_contrast_db is not None
        assert finger.measured_contrast_db >= finger.promised_contrast_db >= 12
        assert finger.measured_level_db_sl == pytest.approx(20.0, abs=3)
    for row in rows:
        assert row.steady
        assert row.as_json()["fingers"]


@pytest.mark.parametrize("name", CHANNELS)
def test_layout_lies_on_its_plate(name: str) -> None:
    """Every control is where a finger can be, and no control covers the middle of another."""
    plate = load_rig(EXAMPLES / f"{name}.yaml").plate
    regions = load_layout(EXAMPLES / f"{name}_layout.yaml", plate).regions
    assert len(regions) >= 6
    for region in regions:
        x, y = region.shape.centre
        assert 0 < x < plate.length
        assert 0 < y < plate.width
        assert [each.name for each in regions if each.shape.contains(x, y)] == [region.name]
