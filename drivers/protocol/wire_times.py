"""Durations on a wire, by arithmetic; without the amplifier's own delay."""

from abc import ABC, abstractmethod
from typing import final


class WireTimes(ABC):
    """Durations [s] on one wire, known before anything is sent."""

    @abstractmethod
    def round_trip(self, channels: int) -> float:
        """Duration of an apply with this number of channels and of its reply."""

    @abstractmethod
    def commit(self) -> float:
        """Duration until a commit has arrived completely."""

    @abstractmethod
    def loading(self, knots: int) -> float:
        """Duration of loading an envelope with this number of knots and of the reply."""


@final
class NoTimes(WireTimes):
    """Zero for everything: a wire without delay, or of unknown speed."""

    def round_trip(self, channels: int) -> float:
        """Zero."""
        return 0.0

    def commit(self) -> float:
        """Zero."""
        return 0.0

    def loading(self, knots: int) -> float:
        """Zero."""
        return 0.0
