"""TUIO captures as a touch source."""

import logging
import math
from collections.abc import Callable
from pathlib import Path
from urllib.parse import parse_qsl

from controller.sources.capture import read_capture
from controller.sources.playing import play
from controller.sources.reject_counter import RejectCounter
from controller.sources.touch import TouchFrame, TouchSource
from controller.sources.tuio import TuioReader
from model.errors import InputError

_logger = logging.getLogger(__name__)


class ReplaySource(TouchSource):
    """Replays the TUIO capture at `replay:PATH`, or at another pace by `replay:PATH?speed=2`.

    Ends with the capture and lifts the remaining contacts. Raises InputError for a file that is no
    capture or contains no touches.
    """

    def __init__(self, url: str) -> None:
        path, _, options = url.removeprefix("replay:").partition("?")
        if not url.startswith("replay:") or not path:
            raise InputError(f"touch source must be replay:PATH of a TUIO capture, got {url}")
        self._speed = _speed(url, options)
        reader = TuioReader(RejectCounter(_logger))
        frames = [
            reader.read(datagram.payload, (Path(path).name, 0), now=datagram.time)
            for datagram in read_capture(path)
        ]
        self.frames = [frame for frame in frames if frame is not None]
        if not self.frames:
            raise InputError(f"touch source {url}: capture must contain touches; record it again")

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver the frames of the capture at its pace."""
        await play(self.frames, deliver, speed=self._speed)


def _speed(url: str, options: str) -> float:
    """Return the speed option of a URL; raises InputError."""
    asked = dict(parse_qsl(options, keep_blank_values=True))
    try:
        speed = float(asked.pop("speed", "1"))
    except ValueError:
        speed = math.nan
    if asked or not 0.01 <= speed <= 100:
        raise InputError(
            f"touch source {url}: options must be ?speed=N with N from 0.01 to 100, got ?{options}"
        )
    return speed
