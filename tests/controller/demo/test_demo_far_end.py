"""Failures of the demonstration's far end."""

from pathlib import Path

import pytest

from controller.demo import far_end
from controller.demo.far_end import SimulatedPlate, simulated_plate
from controller.demo.recorder import TouchRecorder
from controller.plate_control import PlateControl
from drivers.errors import LinkError
from model.rig.file import example_rig_path


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


async def test_recorder_reports_first_error_at_the_end(tmp_path: Path) -> None:
    """Of several errors the first is raised, since it usually causes the others."""
    plate = SimulatedPlate(PlateControl(tmp_path / "missing", remedy="start it again"), {})
    recorder = TouchRecorder(plate, on_row=lambda row: None)
    recorder.observer.refused("no pattern was found")
    recorder._run(plate.place_fingers({"1": (0.1, 0.1)}))
    with pytest.raises(LinkError, match=r"no pattern was found$"):
        await recorder.finish()
