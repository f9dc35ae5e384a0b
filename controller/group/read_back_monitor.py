"""Whether the amplifiers of a rig play what they were told, heartbeat by heartbeat."""

from collections.abc import Mapping

from drivers.errors import CommandRefused
from drivers.guard import SafeCommandSet
from drivers.operation.read_back import BORNE, Expectation, is_fault, read_back
from drivers.protocol.messages import Achieved, Status


class ReadBackMonitor:
    """What each amplifier should report, by its name; nothing at first."""

    def __init__(self) -> None:
        self._expected: dict[str, Expectation] = {}

    def forget(self) -> None:
        """What they play is not known any more."""
        self._expected.clear()

    def expect(
        self, played: Mapping[str, SafeCommandSet], achieved: Mapping[str, Achieved], *, now: float
    ) -> None:
        """From a time [s] on they play this; of a set that ends by itself nothing is expected."""
        self._expected = {
            name: Expectation.of(
                achieved[name].commands, settled_from=now + played[name].settled_after
            )
            for name in achieved
            if played[name].valid_for == 0
        }

    def check(self, name: str, status: Status, *, now: float) -> None:
        """Raise CommandRefused where levels have been others than commanded for too long."""
        expected = self._expected.get(name)
        if expected is None:
            return
        expected = read_back(expected, status.levels, now)
        self._expected[name] = expected
        if is_fault(expected, now):
            wanted = tuple(
                expected.levels.get(channel, 0.0) for channel in range(len(status.levels))
            )
            raise CommandRefused(
                f"amplifier {name} has reported the levels {_shown(status.levels)} instead of "
                f"{_shown(wanted)} for {BORNE * 1e3:g} ms; all were stopped: look for a derated or "
                "broken channel, then clear and arm again"
            )


def _shown(levels: tuple[float, ...]) -> str:
    return ", ".join(f"{level:.2f}" for level in levels)
