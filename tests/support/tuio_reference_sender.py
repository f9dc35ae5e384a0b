"""A TUIO sender that behaves as the reference implementation, TUIO11_CPP's TuioServer, by default.

It sends on change only: what is alive, the cursors that changed, the frame's number; nothing while
fingers rest. With `periodic` it also repeats what is alive once a second, as its option does. It
greets and parts with an empty bundle numbered -1.
"""

from collections.abc import Mapping

from tuio_messages import bundle, cursor, message

Place = tuple[float, float]
INTERVAL = 1.0  # s


class ReferenceSender:
    """Datagrams of a sender without a name; times [s]."""

    def __init__(self, *, periodic: bool = False) -> None:
        self._periodic = periodic
        self._cursors: dict[int, Place] = {}
        self._frame = 0
        self._sent_at = 0.0

    def empty(self) -> bytes:
        """The bundle with which it starts and ends."""
        return bundle(message("alive"), message("fseq", -1))

    def frame(self, cursors: Mapping[int, Place], now: float) -> bytes | None:
        """What it sends for a frame of its camera: cursors by session id."""
        self._frame += 1
        changed = {id: at for id, at in cursors.items() if self._cursors.get(id) != at}
        is_due = self._periodic and now - self._sent_at >= INTERVAL
        if not (changed or is_due) and cursors.keys() == self._cursors.keys():
            return None
        self._cursors, self._sent_at = dict(cursors), now
        return bundle(
            message("alive", *cursors),
            *(cursor(id, x, y) for id, (x, y) in changed.items()),
            message("fseq", self._frame),
        )
