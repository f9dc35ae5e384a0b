"""An event loop with a virtual clock that is stepped explicitly; I/O is served as usual."""

import asyncio

STEP = 0.005  # s; the largest delay of a timer


class SteppedLoop(asyncio.SelectorEventLoop):
    """An event loop whose time begins at 0 s."""

    def __init__(self) -> None:
        self._now = 0.0
        super().__init__()

    def time(self) -> float:
        """The present virtual time [s]."""
        return self._now

    async def step(self, seconds: float) -> None:
        """Advance the time by so many seconds, and run the timers due in it."""
        end = self._now + seconds
        while self._now < end:
            self._now = min(self._now + STEP, end)
            # Twice: a due timer may schedule another call.
            await asyncio.sleep(0)
            await asyncio.sleep(0)
