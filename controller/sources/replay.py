"""TUIO captures as a touch source."""

import logging
from collections.abc import Callable
from pathlib import Path

from controller.sources.capture import read_capture
from controller.sources.playing import play, with_lifts
from controller.sources.reject_counter import RejectCounter
from controller.sources.touch import TouchFrame, TouchSource
from controller.sources.tuio import TuioReader
from controller.sources.url_options import number_option
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
        touched = [frame for frame in frames if frame is not None]
        if not touched:
            raise InputError(f"touch source {url}: capture must contain touches; record it again")
        self.frames = with_lifts(touched, speed=self._speed)

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver the frames of the capture at its pace."""
        await play(self.frames, deliver, speed=self._speed)


def _speed(url: str, options: str) -> float:
    """Return the speed option of a URL; raises InputError."""
    speed = number_option(options, "speed", default=1.0)
    if not 0.01 <= speed <= 100:  # NaN is not
        raise InputError(
            f"touch source {url}: options must be ?speed=N with N from 0.01 to 100, got ?{options}"
        )
    return speed
