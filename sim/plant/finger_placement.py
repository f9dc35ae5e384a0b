"""Placement of all fingers, with the plate under them, which can be solved in another thread.

Solving a large plate takes a tenth of a second, while its amplifiers must continue to reply.
"""

import threading
from collections.abc import Callable, Mapping

from model.arrays import Point
from model.structure.fingertips import FingertipLoad
from sim.plant.loaded_plate import LoadedPlate


class FingerPlacement:
    """Positions [m] and loads of all fingers by id from a time [s] on.

    solve: returns the plate under them; can be called in any thread, and is called once. None if
    the loads of the plate do not change.
    """

    def __init__(
        self,
        time: float,
        positions: Mapping[str, Point],
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

    def supersedes(self, second_last: "FingerPlacement", last: "FingerPlacement") -> bool:
        """Whether the last placement can be left out because fingers slide faster than solutions.

        It only moved the same fingers as the placement before it, and its solution has not begun.
        """
        is_slide = self.positions.keys() == last.positions.keys() == second_last.positions.keys()
        return is_slide and not (last.is_solved or last._is_started)

    def solved(self) -> LoadedPlate | None:
        """The plate under these fingers, solved if necessary; raises the errors of solving."""
        self._is_started = True
        with self._lock:
            try:
                if self._loaded is None and self._solve is not None:
                    self._loaded = self._solve()
                return self._loaded
            finally:
                self.is_solved = True
