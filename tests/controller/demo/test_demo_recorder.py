"""Why a touch of the demonstration was not played, as its row says it."""

from pathlib import Path

import pytest

from controller.demo.far_end import SimulatedPlate
from controller.demo.recorder import TouchRecorder
from controller.demo.touch_row import TouchRow
from controller.loop.observer import Silenced
from controller.plate_control import PlateControl
from controller.sources.contacts import Change, Contact, ContactKey
from drivers import clock
from drivers.errors import LinkError

FAULT = "amplifier d: state must be OPERATION_ENABLED, got FAULT with fault WATCHDOG"


def contact(number: int) -> Contact:
    """A contact that is down from now on."""
    return Contact(ContactKey("test", number), 0.1, 0.1, clock.now())


def recorder_of(rows: list[TouchRow], folder: Path) -> TouchRecorder:
    """A recorder whose plate is not there, which no row waits for."""
    plate = SimulatedPlate(PlateControl(folder / "missing", remedy="start it again"), {})
    return TouchRecorder(plate, on_row=rows.append)


async def test_rows_of_an_aborted_demonstration_name_the_fault(tmp_path: Path) -> None:
    """The touch that was down at the fault and the one that came later; not what was silenced."""
    rows: list[TouchRow] = []
    recorder = recorder_of(rows, tmp_path)
    observer = recorder.observer
    near, down, later = contact(1), contact(2), contact(3)
    observer.contacts_changed((near,), Change(down=(near,)))
    observer.silenced(Silenced((near,), (near,), "too close to an edge", None, clock.now()))
    observer.contacts_changed((), Change(up=(near,)))
    observer.contacts_changed((down,), Change(down=(down,)))
    observer.refused(f"{FAULT}; once the cause is gone, clear and arm again")
    observer.contacts_changed((), Change(up=(down,)))
    observer.contacts_changed((later,), Change(down=(later,)))
    observer.contacts_changed((), Change(up=(later,)))
    with pytest.raises(LinkError, match=FAULT):
        await recorder.finish()
    assert [row.reason for row in rows] == ["too close to an edge", FAULT, FAULT]


async def test_demonstration_that_is_armed_again_has_all_rows(tmp_path: Path) -> None:
    """Touches before and after the fault; what was down at the fault names it."""
    rows: list[TouchRow] = []
    recorder = recorder_of(rows, tmp_path)
    observer = recorder.observer
    down, later = contact(1), contact(2)
    observer.contacts_changed((down,), Change(down=(down,)))
    observer.refused(f"{FAULT}; once the cause is gone, clear and arm again")
    recorder.recovered()
    observer.contacts_changed((), Change(up=(down,)))
    observer.contacts_changed((later,), Change(down=(later,)))
    observer.contacts_changed((), Change(up=(later,)))
    with pytest.raises(LinkError, match="missing"):  # the plate of this test, not the fault
        await recorder.finish()
    assert [row.reason == FAULT for row in rows] == [True, False]


async def test_row_of_a_finger_alone_names_no_other_finger(tmp_path: Path) -> None:
    """A touch that lifts before anything was played for it was not beside another target."""
    rows: list[TouchRow] = []
    recorder = recorder_of(rows, tmp_path)
    alone = contact(1)
    recorder.observer.contacts_changed((alone,), Change(down=(alone,)))
    recorder.observer.contacts_changed((), Change(up=(alone,)))
    with pytest.raises(LinkError):
        await recorder.finish()
    assert rows[0].reason is not None
    assert "finger" not in rows[0].reason
