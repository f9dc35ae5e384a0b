"""Recorded TUIO streams as a touch source."""

import asyncio
from pathlib import Path

import pytest

from controller.sources.capture import RecordedDatagram, write_capture
from controller.sources.registry import open_source
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram
from model.errors import InputError
from virtual_loop import run_virtual


def write(path: Path, *moments: tuple[float, tuple[Touch, ...]], source: str = "table") -> None:
    """A capture of a sender's frames."""
    write_capture(
        path,
        [
            RecordedDatagram(time, tuio_datagram(TouchFrame(source, time, touches), number))
            for number, (time, touches) in enumerate(moments, start=1)
        ],
    )


async def delivered(url: str) -> list[tuple[float, str, dict[int, tuple[float, float]]]]:
    """What a source delivers, times from its start."""
    start = asyncio.get_running_loop().time()
    seen = []

    def deliver(frame: TouchFrame) -> None:
        places = {touch.id: (touch.x, touch.y) for touch in frame.touches}
        seen.append((round(frame.time - start, 6), frame.source, places))

    await open_source(url).run(deliver)
    return seen


def test_replay_source_keeps_times(tmp_path: Path) -> None:
    """Frames come at their times, again every 50 ms while a finger is down, lifted in the end."""
    path = tmp_path / "taps.tuio"
    write(path, (0.0, ()), (0.2, (Touch(3, 0.5, 0.25),)), (0.32, (Touch(3, 0.75, 0.25),)))
    seen = run_virtual(delivered(f"replay:{path}"))
    assert [(time, places) for time, _, places in seen] == [
        (0.0, {}),
        (0.2, {3: (0.5, 0.25)}),
        (0.25, {3: (0.5, 0.25)}),
        (0.3, {3: (0.5, 0.25)}),
        (0.32, {3: (0.75, 0.25)}),
        (0.37, {}),
    ]
    assert {source for _, source, _ in seen} == {"tuio:taps.tuio/table"}


def test_replay_source_scales_times(tmp_path: Path) -> None:
    """At twice the speed a finger is down for half the time."""
    path = tmp_path / "taps.tuio"
    write(path, (0.0, (Touch(3, 0.5, 0.25),)), (0.08, ()))
    seen = run_virtual(delivered(f"replay:{path}?speed=2"))
    assert [(time, bool(places)) for time, _, places in seen] == [(0.0, True), (0.04, False)]


@pytest.mark.parametrize("options", ["speed=0", "speed=fast", "speed=nan", "loop=yes", "speed"])
def test_replay_source_refuses_bad_options(tmp_path: Path, options: str) -> None:
    """The error names the valid options."""
    write(tmp_path / "taps.tuio", (0.0, ()))
    with pytest.raises(InputError, match=r"\?speed=N"):
        open_source(f"replay:{tmp_path}/taps.tuio?{options}")


def test_replay_source_refuses_a_capture_without_touches(tmp_path: Path) -> None:
    """The error names the file."""
    write_capture(tmp_path / "noise.tuio", [RecordedDatagram(0.0, b"noise")])
    with pytest.raises(InputError, match=r"noise.tuio"):
        open_source(f"replay:{tmp_path}/noise.tuio")
