"""Durations on a wire, as a test sets them."""

from dataclasses import dataclass

from drivers.protocol.wire_times import WireTimes


@dataclass(frozen=True)
class StubWireTimes(WireTimes):
    """Durations [s] of a commit, an envelope and each of its knots; all others are zero."""

    commit_takes: float = 0.0
    envelope_takes: float = 0.0
    knot_takes: float = 0.0

    def round_trip(self, channels: int) -> float:
        """Return zero."""
        return 0.0

    def commit(self) -> float:
        """Return the set duration."""
        return self.commit_takes

    def loading(self, knots: int) -> float:
        """Return the set duration."""
        return self.envelope_takes + knots * self.knot_takes
