"""The drifting hour of the demonstration, shortened, and its loop in virtual time."""

import asyncio
from pathlib import Path

import pytest

from controller.demo.drift import Course, Event, Hour, run_drift
from controller.demo.drift_picture import write_drift_picture
from controller.demo.virtual_time import VirtualTimeLoop
from model.rig.file import example_rig_path


@pytest.fixture(scope="module")
def hour() -> Hour:
    """Four touches of it; the mount loosens before the second."""
    course = Course(
        duration=48.0, interval=12.0, loosened_at=12.0, loosened=0.6, sticker_at=99.0, fresh_sets=0
    )
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(run_drift(example_rig_path(), course=course, seed=1))


@pytest.mark.long
def test_plate_is_identified_over_the_wire_and_alarms_when_it_changes(hour: Hour) -> None:
    """The model explains the plate in time; the first pattern on a loose mount or the next alarms.

    Contrast of answers identified once is that of the plate known before, within 3 dB.
    """
    assert hour.chi2 < 2
    kinds = [each.kind for each in hour.events]
    assert kinds[:2] == ["plate", "alarm"]
    first = {way: contrasts[0] for way, contrasts in hour.contrasts.items()}
    assert first["identified"][1] == pytest.approx(first["known"][1], abs=3.0)


def test_figures_of_an_hour_count_from_its_changes(tmp_path: Path) -> None:
    """A mount named after 72 s, a sticker never; an alarm long after any change is a false one."""
    hour = Hour(
        events=[
            Event(0.0, "plate", "a mount loosens", "stiffness NE"),
            Event(12.0, "alarm", ""),
            Event(72.0, "explained", "stiffness NE by -0.22"),
            Event(2400.0, "plate", "a sticker", "a mass"),
            Event(3000.0, "alarm", ""),
            Event(3060.0, "explained", "stiffness NE by -0.22"),
        ]
    )
    for way in hour.contrasts:
        hour.contrasts[way] = [(3300.0, 20.0), (3400.0, 22.0)]
    hour.fresh = {"in service": [20.0, 24.0]}
    assert hour.named == {"stiffness NE": 72.0, "a mass": None}
    assert hour.false_alarms == 1
    found = hour.as_json()
    assert found["last_ten_minutes_db"]["known"] == 21.0
    assert found["end_of_hour_db"] == {"in service": 22.0}
    assert write_drift_picture(hour, tmp_path).exists()


def test_virtual_time_passes_while_nothing_is_to_be_done() -> None:
    """An hour of sleep takes no time; what runs in a thread elsewhere runs at once."""

    async def slept() -> tuple[float, int]:
        await asyncio.sleep(3600)
        return asyncio.get_running_loop().time(), await asyncio.to_thread(sum, [1, 2])

    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        at, total = runner.run(slept())
    assert at == pytest.approx(3600)
    assert total == 3
