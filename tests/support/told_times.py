"""What a wire is said to take, as a test wants it."""

from dataclasses import dataclass

from drivers.protocol.wire_times import WireTimes


@dataclass(frozen=True)
class ToldTimes(WireTimes):
    """A commit, an envelope and each knot of it take so long [s]; all else nothing."""

    commit_takes: float = 0.0
    envelope_takes: float = 0.0
    knot_takes: float = 0.0

    def round_trip(self, channels: int) -> float:
        """Nothing."""
        return 0.0

    def commit(self) -> float:
        """As told."""
        return self.commit_takes

    def loading(self, knots: int) -> float:
        """As told."""
        return self.envelope_takes + knots * self.knot_takes
