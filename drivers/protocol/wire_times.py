"""Durations on a wire, by arithmetic; without the amplifier's own delay."""


class WireTimes:
    """Durations [s] on one wire, known before anything is sent; zero for an unknown speed."""

    def round_trip(self, channels: int) -> float:
        """Duration of an apply with this number of channels and of its reply."""
        return 0.0

    def commit(self) -> float:
        """Duration until a commit has arrived completely."""
        return 0.0

    def loading(self, knots: int) -> float:
        """Duration of loading an envelope with this number of knots and of the reply."""
        return 0.0
