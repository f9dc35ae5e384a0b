"""Recorded TUIO streams as a touch source: a capture is read as its datagrams would be."""

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
    """Replays the TUIO capture at `replay:PATH` or, at another pace, `replay:PATH?speed=2`.

    Ends with the capture; contacts that it leaves down are lifted then. Raises InputError where
    there is no capture or no datagram of it says anything.
    """

    def __init__(self, url: str) -> None:
        path, _, options = url.removeprefix("replay:").partition("?")
        if not url.startswith("replay:") or not path:
            raise InputError(f"touch source {url}: expected replay:PATH of a TUIO capture")
        self._speed = _speed(url, options)
        reader = TuioReader(RejectCounter(_logger))
        frames = [
            reader.read(datagram.payload, (Path(path).name, 0), now=datagram.time)
            for datagram in read_capture(path)
        ]
        self.frames = [frame for frame in frames if frame is not None]
        if not self.frames:
            raise InputError(f"touch source {url}: no datagram of this capture tells of touches")

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver the capture's frames, each again every 50 ms while it has touches."""
        await play(self.frames, deliver, speed=self._speed)


def _speed(url: str, options: str) -> float:
    """The pace that a URL asks for; raises InputError."""
    asked = dict(parse_qsl(options, keep_blank_values=True))
    try:
        speed = float(asked.pop("speed", "1"))
    except ValueError:
        speed = math.nan
    if asked or not 0.01 <= speed <= 100:
        raise InputError(
            f"touch source {url}: expected nothing after the path but ?speed=N with N from 0.01 "
            "to 100, such as ?speed=2 for twice as fast"
        )
    return speed
