"""The time of a wire that several amplifiers share."""

from collections.abc import Iterator
from contextlib import contextmanager

from drivers import clock


class FrameTime:
    """The same for all amplifiers while they take one frame, however long a simulation needs."""

    def __init__(self) -> None:
        self._end_of_frame: float | None = None

    def now(self) -> float:
        """The time [s]."""
        return clock.now() if self._end_of_frame is None else self._end_of_frame

    @contextmanager
    def in_one_frame(self) -> Iterator[None]:
        """Stays at the present time."""
        before, self._end_of_frame = self._end_of_frame, self.now()
        try:
            yield
        finally:
            self._end_of_frame = before
