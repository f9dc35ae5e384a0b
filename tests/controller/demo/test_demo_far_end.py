"""Failures of the demonstration's far end."""

from pathlib import Path

import pytest

from controller.demo import far_end
from controller.demo.far_end import simulated_plate
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
