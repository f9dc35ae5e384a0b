"""An event loop whose clock goes on only when it is told to, for a far end that tests step through.

Wires and control are served as ever; what waits for a time waits for this clock.
"""

import asyncio

STEP = 0.005  # s; things that wait for a time come at most this much late


class SteppedLoop(asyncio.SelectorEventLoop):
    """A loop that begins at 0 s."""

    def __init__(self) -> None:
        self._now = 0.0
        super().__init__()

    def time(self) -> float:
        """The present virtual time [s]."""
        return self._now

    async def step(self, seconds: float) -> None:
        """Let so much time [s] pass, and everything happen that is due in it."""
        end = self._now + seconds
        while self._now < end:
            self._now = min(self._now + STEP, end)
            # Twice: what is due now may ask for more to be done at once.
            await asyncio.sleep(0)
            await asyncio.sleep(0)
