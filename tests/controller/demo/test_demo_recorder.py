"""Rows of touches that were not played, a plate that is armed again, a far end that fails."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from controller.demo import far_end, run
from controller.demo.far_end import SimulatedPlate, simulated_plate
from controller.demo.recorder import TouchRecorder
from controller.demo.touch_row import FingerVibration, TouchRow
from controller.loop.content import Prediction, not_served
from controller.loop.observer import Applied, Silenced
from controller.sources.contacts import Change, Contact, ContactKey
from daemon_bench import ENABLED, ready_daemon, until, until_state
from drivers import clock
from drivers.errors import LinkError
from model.rig.file import example_rig_path
from sim.faults.fault_window import FaultWindow
from virtual_loop import in_virtual_time

FAULT = "amplifier d: state must be OPERATION_ENABLED, got FAULT with fault WATCHDOG"


def contact(number: int) -> Contact:
    """A contact that is down from now on."""
    return Contact(ContactKey("test", number), 0.1, 0.1, clock.now())


async def nothing(*_: object) -> dict[str, FingerVibration]:
    """What a plate says that is not there."""
    return {}


@asynccontextmanager
async def recorder_of(
    rows: list[TouchRow], vibration: Callable[[float, float], Awaitable[object]] = nothing
) -> AsyncIterator[TouchRecorder]:
    """A recorder of a plate that is not there; its rows are made at the end."""
    plate = cast(SimulatedPlate, SimpleNamespace(vibration=vibration, place_fingers=nothing))
    async with asyncio.TaskGroup() as tasks:
        yield TouchRecorder(plate, tasks, on_row=rows.append)


async def test_rows_after_a_fault_name_it_until_the_plate_is_armed_again() -> None:
    """The touch that was down at the fault and the one that came later; no other one."""
    rows: list[TouchRow] = []
    near, down, later, last = (contact(number) for number in range(4))
    async with recorder_of(rows) as recorder:
        observer = recorder.observer
        observer.contacts_changed((near,), Change(down=(near,)))
        reason = "too close to an edge"
        silenced = Silenced((near,), (not_served(near, reason),), reason, None, clock.now())
        observer.silenced(silenced)
        observer.contacts_changed((), Change(up=(near,)))
        observer.contacts_changed((down,), Change(down=(down,)))
        recorder.failed(f"{FAULT}; once the cause is gone, clear and arm again")
        observer.contacts_changed((), Change(up=(down,)))
        observer.contacts_changed((later,), Change(down=(later,)))
        observer.contacts_changed((), Change(up=(later,)))
        assert recorder.fault == FAULT
        recorder.armed()
        observer.contacts_changed((last,), Change(down=(last,)))
        observer.contacts_changed((), Change(up=(last,)))
    reasons = [row.reason for row in rows]
    assert reasons[:3] == ["too close to an edge", FAULT, FAULT]
    assert reasons[3] != FAULT
    assert recorder.fault is None


@in_virtual_time
async def test_pattern_is_measured_while_no_finger_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before a slide that lasts until the next pattern; what it rings to afterwards is no level.

    Its onset is measured beside a quiet finger, if it lasts as long as that.
    """
    monkeypatch.setattr(clock, "now", asyncio.get_running_loop().time)
    windows: list[tuple[float, float]] = []

    async def vibration(since: float, until: float) -> dict[str, FingerVibration]:
        windows.append((since, until))
        return {}

    async with recorder_of([], vibration) as recorder:
        observer, start = recorder.observer, clock.now()
        finger = contact(1)
        observer.contacts_changed((finger,), Change(down=(finger,)))
        for quiet in ((), (contact(2),), (contact(2),)):
            applied = SimpleNamespace(
                time=clock.now(),
                targets=(Prediction(finger, 20.0),),
                pattern=SimpleNamespace(ramp=0.04),
                quiet=quiet,
                from_rest=True,
            )
            observer.pattern_applied(cast(Applied, applied))
            await asyncio.sleep(1.0)
            for _ in range(8):
                finger = replace(finger, x=finger.x + 0.004)
                observer.contacts_changed((finger,), Change(moved=(finger,)))
                await asyncio.sleep(0.1)
    assert windows == [
        pytest.approx((start + since, start + until))
        for since, until in ((0.755, 0.995), (2.555, 2.795), (1.8, 1.9))
    ]


@in_virtual_time
async def test_plate_is_armed_again_after_a_fault_but_not_after_a_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After one of amplifiers that stalled it is cleared, and the recorder hears of both."""
    monkeypatch.setattr(run, "RECOVERY", 5.0)
    async with asyncio.TaskGroup() as tasks, ready_daemon(tmp_path) as (bench, era):
        recorder = TouchRecorder(cast(SimulatedPlate, None), tasks, on_row=lambda row: None)
        arming = asyncio.create_task(run._keep_armed(bench.daemon, bench.socket, recorder))
        await recorder.start()
        await until_state(era, ENABLED)
        bench.far.device.inject_fault(FaultWindow("over_voltage", lasts=0.05))
        await until(lambda: recorder.fault is not None)
        await until(lambda: recorder.fault is None or arming.done())
        assert not arming.done()
        await until_state(era, ENABLED)
        await era.stop()
        with pytest.raises(LinkError, match="aborted: stopped"):
            await arming
        assert (await era.status()).state == "QUICK_STOP_ACTIVE"


async def test_far_end_terminates_process_when_not_ready_in_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After the startup timeout the process is terminated."""
    monkeypatch.setattr(far_end, "STARTUP_TIMEOUT", 0.0)
    exit_statuses: list[int | None] = []
    terminate = far_end._terminate

    async def note(process: "far_end.asyncio.subprocess.Process") -> None:
        await terminate(process)
        exit_statuses.append(process.returncode)

    monkeypatch.setattr(far_end, "_terminate", note)
    with pytest.raises(LinkError):
        async with simulated_plate(example_rig_path(), ["main"], wire="serial"):
            pass
    assert len(exit_statuses) == 1
    assert exit_statuses[0] is not None


async def test_far_end_reports_exit_status_when_rig_is_invalid(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The process prints its own error with file and line; the exit status is reported."""
    rig = tmp_path / "rig.yaml"
    rig.write_text("plate: 3\n")
    with pytest.raises(LinkError, match="status 2"):
        async with simulated_plate(rig, ["main"], wire="serial"):
            pass
    assert f"{rig}:1: plate: " in capfd.readouterr().err


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        (b'{"error": "finger is 1; it must be a text"}\n', r"felt refused: finger is 1"),
        (b'{"fingers": ', r"/sock: no reply to felt"),
        (b"x" * (2 << 20), r"/sock: no reply to felt"),
        (None, r"/sock: no reply to felt .*too long"),
    ],
    ids=["an error", "half a line", "no line", "nothing"],
)
async def test_plate_without_a_reply_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: bytes | None, reason: str
) -> None:
    """Of the link, with what was asked; a plate that hangs is not waited for."""
    monkeypatch.setattr(far_end, "_REPLY_TIMEOUT", 10.0 if said else 0.02)
    hung = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if said is None:
            await hung.wait()
        writer.write(said or b"")
        writer.close()

    async with await asyncio.start_unix_server(serve, tmp_path / "sock"):
        with pytest.raises(LinkError, match=reason):
            await SimulatedPlate(tmp_path / "sock", {}).vibration(0.0, 1.0)
        hung.set()
