"""Durations on a wire, by arithmetic; without the amplifier's own delay."""

from typing import ClassVar


class WireTimes:
    """Durations [s] on one wire, known before anything is sent; zero for an unknown speed.

    is_multi_master: whether all amplifiers on a bus may be sent requests at the same time, as on a
    CAN bus; else they reply one at a time.
    """

    is_multi_master: ClassVar[bool] = False

    def round_trip(self, channels: int) -> float:
        """Duration of an apply with this number of channels and of its reply."""
        return 0.0

    def commit(self) -> float:
        """Duration until a commit has arrived completely."""
        return 0.0

    def loading(self, knots: int) -> float:
        """Duration of loading an envelope with this number of knots and of the reply."""
        return 0.0
