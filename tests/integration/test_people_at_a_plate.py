"""Examples with several people or many ERAs: each finger feels its own, as promised."""

import asyncio
import os
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import model
from cases import shortly
from controller.api.client import AsyncClient
from controller.api.schema import ContactStatus
from controller.demo.demonstration import Scene, example_scenes, run_demo
from controller.sources.tuio_capture import read_capture
from kit.clock import run_virtual
from kit.fingers import write_schedule
from model.rig.rig_file import load_rig
from model.table.table_file import build_table
from processes.daemons import (
    PATIENCE,
    STARTING,
    holding,
    next_event,
    ready,
)
from processes.daemons import until as until_seen
from processes.patient_daemon import RESTING

EXAMPLES = Path(model.__file__).parents[1] / "examples"

ANY = (0.0, 500.0)
PEOPLE = {
    "car_display": {(0.15, 0.12): (60.0, 110.0), (0.38, 0.12): (180.0, 280.0)},
    "table": {(0.30, 0.26): ANY, (0.90, 0.26): ANY, (0.90, 0.54): ANY, (0.30, 0.54): ANY},
}
"""Where each person rests a finger, and the band [Hz] that the layout gives it."""


async def contacts_at_full_level(era: AsyncClient) -> list[ContactStatus]:
    """Wait until every finger feels a content at nearly its level of 20 dB SL; by their ids."""
    levels = [0.0]
    while min(levels, default=0.0) < 17:
        status = await era.status()
        levels = [contact.level_db_sl or 0.0 for contact in status.contacts]
    return sorted(status.contacts, key=lambda contact: contact.id)


@pytest.mark.real_time
@pytest.mark.alone
@pytest.mark.parametrize("name", shortly(PEOPLE, []))
async def test_everyone_at_an_example_feels_their_own(
    name: str, tmp_path: Path, table_cache: Path
) -> None:
    """`era daemon examples/NAME_daemon.yaml` as on its page.

    Each in the band of its region, at least 30 Hz apart, 6 dB and more above all others there. With
    nobody at the plate nothing plays.
    """
    process = await asyncio.create_subprocess_exec(
        *(*RESTING, "daemon", str(EXAMPLES / f"{name}_daemon.yaml")),
        env=os.environ | {"XDG_CACHE_HOME": str(table_cache), "XDG_RUNTIME_DIR": str(tmp_path)},
        stderr=asyncio.subprocess.DEVNULL,
    )
    socket, people = tmp_path / "era-haptics" / "daemon.sock", PEOPLE[name]
    try:
        await until_seen(lambda: socket.is_socket() or process.returncode, patience=STARTING)
        async with await AsyncClient.connect(socket, name="test", timeout=PATIENCE) as era:
            await ready(era)
            async with era.armed("test"):
                frequencies = []
                async with holding(era, *people), asyncio.timeout(PATIENCE):
                    contacts = await contacts_at_full_level(era)
                assert len(contacts) == len(people)
                for contact, (low, high) in zip(contacts, people.values(), strict=True):
                    assert contact.verdict in ("own", "mixed")
                    assert contact.promised_contrast_db > 6
                    assert low <= contact.frequency_hz <= high
                    frequencies.append(contact.frequency_hz)
                gaps = np.diff(sorted(frequencies))
                assert min(gaps) >= 30
                await era.subscribe("silence")
                await era.touch([])
                await next_event(era, "silence")
    finally:
        process.terminate()
        await process.wait()


CHANNELS_OF = {"eight_eras": [4, 4], "car_display": [4, 4, 4], "table": [4, 4, 4, 4]}
SCHEDULE = ((1, 0.1, 0.9, 0.30, 0.35), (2, 0.15, 0.9, 0.80, 0.70))
"""Fingers: id, down and up [s], place in TUIO's coordinates; the second shall feel it."""


@pytest.mark.parametrize("name", shortly(CHANNELS_OF, ["eight_eras", "car_display"]))
def test_finger_feels_what_many_eras_promise(name: str, tmp_path: Path) -> None:
    """All ERAs on all amplifiers play, and the fingers feel at least the promised contrast.

    On the first plate that is drawn, level within 3 dB; by fields of the plate in time. The levels
    that its picture shows differ by the contrast in its title.
    """
    file = EXAMPLES / f"{name}.yaml"
    rig = load_rig(file)
    counts = Counter(wire.amplifier for wire in rig.wiring.values())
    assert [counts[amplifier] for amplifier in rig.amplifiers] == CHANNELS_OF[name]
    table = build_table(rig, frequencies=np.array([120.0, 160.0, 200.0]), drive_mode="phased")
    capture = read_capture(write_schedule(tmp_path / "touches.tuio", SCHEDULE, 1.0))
    scenes = [Scene(capture)]
    demo = run_demo(file, table, wire="sim", scenes=scenes, on_row=lambda row: None)
    *_, row = run_virtual(demo).rows
    assert row.drive.keys() == {era.name for era in rig.eras}
    x, y = SCHEDULE[1][3:]
    assert row.targets_m == [pytest.approx((x * rig.plate.length, (1 - y) * rig.plate.width))]
    assert row.steady
    assert row.measured_contrast_db >= row.promised_contrast_db > 6
    (quiet,) = row.quiet
    contrast = row.levels_db_sl[row.target_id] - row.levels_db_sl[quiet]
    assert contrast == pytest.approx(row.measured_contrast_db)
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
    demo = run_demo(file, table, wire="sim", scenes=[scene], on_row=lambda row: None)
    rows = run_virtual(demo).rows
    slid, stayed, third = rows
    assert len(slid.fingers) == 3
    assert slid.fingers == stayed.fingers == third.fingers
    for row, finger in zip(rows, slid.fingers, strict=True):
        assert row.measured_contrast_db == finger.measured_contrast_db
        assert row.targets_m == [finger.at_m]
    assert slid.targets_m == [pytest.approx((0.15 * 0.53, 0.65 * 0.30), abs=0.008)]
    bands = [(70, 110), (180, 220), (250, 300)]
    for finger, (low, high) in zip(slid.fingers, bands, strict=True):
        assert low <= finger.frequency_hz <= high
        assert finger.verdict == "own"
        assert finger.measured_contrast_db >= finger.promised_contrast_db >= 12
        assert finger.measured_level_db_sl == pytest.approx(20.0, abs=3)
    for row in rows:
        assert row.steady
        assert row.as_json()["fingers"]
