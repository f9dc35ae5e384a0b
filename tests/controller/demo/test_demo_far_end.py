"""The far end of the demonstration, where it does not start or something goes wrong with it."""

from pathlib import Path

import pytest

from controller.demo import far_end
from controller.demo.far_end import BenchControl, open_far_end
from controller.demo.recorder import TouchRecorder
from controller.plate_control import PlateControl
from drivers.errors import LinkError
from model.rig.file import example_rig_path


async def test_amplifiers_that_do_not_start_in_time_are_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Told with how long was waited, and what to do; the process does not stay behind."""
    monkeypatch.setattr(far_end, "STARTUP_TIMEOUT", 0.0)
    ended: list[int | None] = []
    end = far_end._end

    async def note(process: "far_end.asyncio.subprocess.Process") -> None:
        await end(process)
        ended.append(process.returncode)

    monkeypatch.setattr(far_end, "_end", note)
    with pytest.raises(LinkError, match="did not start within 0 s; start the demonstration again"):
        async with open_far_end(example_rig_path(), ["main"], wire="serial"):
            pass
    assert len(ended) == 1
    assert ended[0] is not None


async def test_amplifiers_that_cannot_start_say_why_themselves(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Their own error stands above, with the file and the line; here is its exit status."""
    rig = tmp_path / "rig.yaml"
    rig.write_text("plate: 3\n")
    with pytest.raises(LinkError, match=r"did not start \(exit status 2\); what they said stands"):
        async with open_far_end(rig, ["main"], wire="serial"):
            pass
    assert f"{rig}:1: plate: " in capfd.readouterr().err


async def test_a_problem_while_it_plays_is_told_in_the_end(tmp_path: Path) -> None:
    """The first of them: those that follow are most often of its making."""
    control = PlateControl(tmp_path / "nobody", remedy="start it again")
    recorder = TouchRecorder(BenchControl(control), on_row=lambda row: None)
    assert recorder.observer.refused is not None
    recorder.observer.refused("no pattern was found")
    recorder._run(BenchControl(control).place_fingers({"1": (0.1, 0.1)}))
    with pytest.raises(LinkError, match=r"did not run through: no pattern was found$"):
        await recorder.finish()
