"""How long things take on a wire, by arithmetic; an amplifier's own delay is not counted."""

from abc import ABC, abstractmethod
from typing import final


class WireTimes(ABC):
    """Times [s] on one wire, told before anything is sent there."""

    @abstractmethod
    def round_trip(self, channels: int) -> float:
        """Of an apply of so many channels and its answer."""

    @abstractmethod
    def commit(self) -> float:
        """Until a commit has arrived whole."""

    @abstractmethod
    def loading(self, knots: int) -> float:
        """Of loading an envelope of so many knots, and of the answer."""


@final
class NoTimes(WireTimes):
    """Zero for everything: of a wire that takes none, or of which nobody knows."""

    def round_trip(self, channels: int) -> float:
        """None."""
        return 0.0

    def commit(self) -> float:
        """None."""
        return 0.0

    def loading(self, knots: int) -> float:
        """None."""
        return 0.0
