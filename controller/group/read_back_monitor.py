"""Comparison of commanded levels with those that amplifiers report at every heartbeat."""

from collections.abc import Mapping, Sequence

from drivers.errors import CommandRefused
from drivers.guard import SafeCommandSet
from drivers.operation.read_back import MAX_MISMATCH_TIME, Expectation, is_fault, read_back
from drivers.protocol.messages import Achieved, Status


class ReadBackMonitor:
    """The levels that each amplifier should report, by its name; initially empty."""

    def __init__(self) -> None:
        self._expected: dict[str, Expectation] = {}

    def forget(self) -> None:
        """Reset the expected levels: what the amplifiers play is unknown."""
        self._expected.clear()

    def expect(
        self, played: Mapping[str, SafeCommandSet], achieved: Mapping[str, Achieved], *, now: float
    ) -> None:
        """Expect these levels from now [s] on; sets with a time limit are not monitored."""
        self._expected = {
            name: Expectation.of(
                achieved[name].commands, settled_from=now + played[name].settled_after
            )
            for name in achieved
            if played[name].valid_for == 0
        }

    def check(self, name: str, status: Status, *, now: float) -> None:
        """Raise CommandRefused if reported levels have differed for too long."""
        if name not in self._expected:
            return
        expected = self._expected[name] = read_back(self._expected[name], status.levels, now)
        if is_fault(expected, now):
            wanted = [expected.levels.get(channel, 0.0) for channel in range(len(status.levels))]
            raise CommandRefused(
                f"amplifier {name}: levels must be {_format(wanted)}, got {_format(status.levels)} "
                f"for {MAX_MISMATCH_TIME * 1e3:g} ms; all were stopped: look for a derated or "
                "broken channel, then clear and arm again"
            )


def _format(levels: Sequence[float]) -> str:
    return ", ".join(f"{level:.2f}" for level in levels)
