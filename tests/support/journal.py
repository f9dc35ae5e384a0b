"""What a far end is asked, and how loud it is, moment by moment on the amplifiers' own clock."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, cast

from daemon_bench import until
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import unpack_layers
from rig_on_wire import FarSide
from sim.amplifier.contract import Amplifier

FEEDING = ("Ping", "Set", "Commit", "Silence", "Arm", "Disarm", "Stop")
"""What a host that is alive sends while something may play."""


@dataclass(frozen=True)
class Asked:
    """A request that an amplifier got at a time [s], and its levels thereafter.

    is_refused: whether it refused the request.
    """

    time: float
    amplifier: str
    name: str
    values: Values
    is_refused: bool
    levels: tuple[float, ...]

    @property
    def raises(self) -> bool:
        """Whether it is a set, of one part, that asks for more than silence."""
        if self.name != "Set" or self.values["parts"] > 1:
            return self.name == "Set"
        layers = unpack_layers(self.values["stream"])
        return any(command.is_driven for one in layers for command in one.commands)


class Journal:
    """Listens at a far end from now on."""

    def __init__(self, far: FarSide) -> None:
        self.entries: list[Asked] = []
        self._far = far
        exchange = far.bench.exchange

        def noted(amplifier: str, name: str, values: Values, *, now: float) -> Any:
            is_refused = False
            try:
                return exchange(amplifier, name, values, now=now)
            except Refusal:
                is_refused = True
                raise
            finally:
                at = far.bench.time
                levels = far.bench.amplifiers[amplifier].summary(at).levels
                self.entries.append(Asked(at, amplifier, name, values, is_refused, levels))

        far.bench.exchange = noted  # type: ignore[method-assign]

    async def hear(self, requests: int) -> None:
        """Wait until so many more requests have come; a heartbeat comes every 50 ms."""
        enough = len(self.entries) + requests
        await until(lambda: len(self.entries) >= enough)

    def since(self, time: float) -> list[Asked]:
        """What was asked after a time [s]."""
        return [entry for entry in self.entries if entry.time > time]

    def raising_since(self, time: float) -> list[Asked]:
        """The sets after a time [s] that ask for more than silence."""
        return [entry for entry in self.since(time) if entry.raises]

    def last_fed(self, amplifier: str) -> float:
        """When [s] one of them has taken something that feeds its watchdog, for the last time."""
        return max(
            entry.time
            for entry in self.entries
            if entry.amplifier == amplifier and entry.name in FEEDING and not entry.is_refused
        )

    def widest_gap(self, since: float, until: float) -> float:
        """The longest time [s] between two signs of life in a window."""
        times = [e.time for e in self.since(since) if e.name in FEEDING]
        moments = [since, *(time for time in times if time <= until), until]
        return max(later - earlier for earlier, later in pairwise(moments))


def energised(far: FarSide) -> list[str]:
    """The amplifiers that are enabled now, or on their way out of it, or still audible."""
    summaries = {name: far.summary(name) for name in far.devices}
    alive = ("OPERATION_ENABLED", "SWITCHED_ON", "FAULT_REACTION_ACTIVE")
    return [name for name, one in summaries.items() if one.state in alive or any(one.levels)]


def silent_from(far: FarSide) -> float:
    """When [s] every channel of every amplifier is silent, or was; -inf where none ever played."""
    return max(silent_from_of(far, name) for name in far.devices)


def silent_from_of(far: FarSide, name: str) -> float:
    """The same of one amplifier; what has faded is no longer among its tones."""
    far.summary()
    one = cast(Amplifier, far.bench.amplifiers[name])
    ends = [tone.silent_from for output in one.outputs for tone in output]
    return max([one._silent_from, *ends])


def loudness(far: FarSide) -> float:
    """The highest level of any channel now."""
    return max(max(far.summary(name).levels) for name in far.devices)
