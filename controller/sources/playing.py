"""Recorded touch frames, delivered again at their own pace."""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import replace

from controller.sources.touch import TouchFrame

# A panel at rest says nothing, but a contact without news counts as lifted.
REPEAT = 0.05


async def play(
    frames: Sequence[TouchFrame], deliver: Callable[[TouchFrame], None], *, speed: float = 1.0
) -> None:
    """Deliver frames, times counted from 0 s, on the event loop's clock; at least one.

    Each comes again every 50 ms while it has touches; what is down in the end is lifted 50 ms
    later. speed: how many times as fast as they were recorded.
    """
    loop = asyncio.get_running_loop()
    start = loop.time()
    last: dict[str, TouchFrame] = {frame.source: frame for frame in frames}
    end = max(frame.time for frame in frames) + REPEAT * speed
    lifted = [replace(frame, time=end, touches=()) for frame in last.values() if frame.touches]
    current: dict[str, TouchFrame] = {}
    for frame in (*frames, *lifted):
        due = start + frame.time / speed
        while current and loop.time() + REPEAT < due:
            await asyncio.sleep(REPEAT)
            for held in current.values():
                deliver(replace(held, time=loop.time()))
        await asyncio.sleep(max(0.0, due - loop.time()))
        current.pop(frame.source, None)
        if frame.touches:
            current[frame.source] = frame
        deliver(replace(frame, time=loop.time()))
