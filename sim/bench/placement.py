"""Fingers that come to rest on a simulated plate, and the plate under them, solved apart.

Solving a large plate takes a tenth of a second, in which its amplifiers must go on replying.
"""

import threading
from collections.abc import Callable, Mapping

from model.structure.attachments import FingertipLoad
from sim.plant.fingers import Position
from sim.plant.loaded_plates import LoadedPlate


class Placement:
    """Positions [m] and loads of all fingers by id from a time [s] on.

    solve: returns the plate under them, may be called in any thread, and is called once; None where
    what loads the plate stays.
    """

    def __init__(
        self,
        time: float,
        positions: Mapping[str, Position],
        contacts: Mapping[str, FingertipLoad],
        solve: Callable[[], LoadedPlate] | None,
    ) -> None:
        self.time = time
        self.positions = dict(positions)
        self.contacts = contacts
        self.is_solved = solve is None
        self._is_started = False
        self._solve = solve
        self._lock = threading.Lock()
        self._loaded: LoadedPlate | None = None

    def supersedes(self, before: "Placement", last: "Placement") -> bool:
        """Whether the last one can be left out, as of fingers that slide faster than is solved.

        Its solution has not begun, and it only moved the same fingers.
        """
        is_slide = self.positions.keys() == last.positions.keys() == before.positions.keys()
        return is_slide and not (last.is_solved or last._is_started)

    def solved(self) -> LoadedPlate | None:
        """The plate under these fingers, solved if it is not yet; raises what solving raises."""
        self._is_started = True
        with self._lock:
            try:
                if self._loaded is None and self._solve is not None:
                    self._loaded = self._solve()
                return self._loaded
            finally:
                self.is_solved = True
