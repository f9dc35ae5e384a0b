"""Captures of fingers that come and go at given times."""

from collections.abc import Sequence
from pathlib import Path

from controller.sources.capture import RecordedDatagram, write_capture
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram

FRAME = 1 / 50  # s


def write_schedule(
    path: Path, schedule: Sequence[tuple[int, float, float, float, float]], seconds: float
) -> Path:
    """Write a TUIO capture of fingers: id, down and up [s], place in TUIO's coordinates."""
    datagrams = []
    for number in range(round(seconds / FRAME)):
        now = number * FRAME
        touches = tuple(Touch(id, x, y) for id, down, up, x, y in schedule if down <= now < up)
        frame = TouchFrame("test", now, touches)
        datagrams.append(RecordedDatagram(now, tuio_datagram(frame, number + 1)))
    write_capture(path, datagrams)
    return path
