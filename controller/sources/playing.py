"""Playback of recorded touch frames at their recorded pace."""

import asyncio
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from controller.sources.touch import TouchFrame

# s; a panel at rest is silent, but contacts time out without frames.
REPEAT_INTERVAL = 0.05


def with_lifts(frames: Sequence[TouchFrame], *, speed: float = 1.0) -> list[TouchFrame]:
    """Return recorded frames, of which there is at least one, and the lifts of remaining touches.

    These are 50 ms after the last frame, at a speed relative to the recording. Takes long for a
    long recording.
    """
    last = {frame.source: frame for frame in frames}
    end = max(frame.time for frame in frames) + REPEAT_INTERVAL * speed
    lifts = [replace(frame, time=end, touches=()) for frame in last.values() if frame.touches]
    return [*frames, *lifts]


async def play(
    frames: Iterable[TouchFrame], deliver: Callable[[TouchFrame], None], *, speed: float = 1.0
) -> None:
    """Deliver frames, times from 0 s, on the event loop's clock.

    A frame with touches is repeated every 50 ms. speed: relative to the recording.
    """
    loop = asyncio.get_running_loop()
    start = loop.time()
    current: dict[str, TouchFrame] = {}
    for frame in frames:
        due = start + frame.time / speed
        while current and loop.time() + REPEAT_INTERVAL < due:
            await asyncio.sleep(REPEAT_INTERVAL)
            for held in current.values():
                deliver(replace(held, time=loop.time()))
        await asyncio.sleep(max(0.0, due - loop.time()))
        current.pop(frame.source, None)
        if frame.touches:
            current[frame.source] = frame
        deliver(replace(frame, time=loop.time()))
