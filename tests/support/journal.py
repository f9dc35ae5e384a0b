"""What a far end is asked, and how loud it is, moment by moment on the amplifiers' own clock."""

import math
from dataclasses import dataclass
from itertools import pairwise

from daemon_bench import until
from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Arm,
    Commit,
    Disarm,
    LoadEnvelope,
    Nak,
    Ping,
    Reply,
    Request,
    Stage,
    Stop,
)
from wires import FarSide

FEEDING = (Ping, Apply, Commit, Stage, LoadEnvelope, Arm, Disarm, Stop)
"""What a host that is alive sends while something may play."""


@dataclass(frozen=True)
class Asked:
    """A request that an amplifier got at a time [s], its answer, and its levels thereafter."""

    time: float
    amplifier: str
    request: Request
    reply: Reply
    levels: tuple[float, ...]

    @property
    def raises(self) -> bool:
        """Whether it lets something play that asks for more than silence."""
        sets = (self.request,) if isinstance(self.request, Apply | Stage) else ()
        return any(command.level > 0 for one in sets for command in one.command_set.commands)


class Journal:
    """Listens at a far end from now on."""

    def __init__(self, far: FarSide) -> None:
        self.entries: list[Asked] = []
        self._far = far
        exchange = far.bench.exchange

        def noted(amplifier: str, request: Request, *, now: float) -> Reply:
            reply = exchange(amplifier, request, now=now)
            at = far.bench.time
            levels = far.bench.amplifiers[amplifier].status(at).levels
            self.entries.append(Asked(at, amplifier, request, reply, levels))
            return reply

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
            if entry.amplifier == amplifier
            and isinstance(entry.request, FEEDING)
            and not isinstance(entry.reply, Nak)
        )

    def widest_gap(self, since: float, until: float) -> float:
        """The longest time [s] between two signs of life in a window."""
        times = [e.time for e in self.since(since) if isinstance(e.request, FEEDING)]
        moments = [since, *(time for time in times if time <= until), until]
        return max(later - earlier for earlier, later in pairwise(moments))


def energised(far: FarSide) -> list[str]:
    """The amplifiers that are enabled now, or on their way out of it, or still audible."""
    statuses = {name: device.status() for name, device in far.devices.items()}
    alive = (
        AmplifierState.OPERATION_ENABLED,
        AmplifierState.SWITCHED_ON,
        AmplifierState.FAULT_REACTION_ACTIVE,
    )
    return [name for name, one in statuses.items() if one.state in alive or any(one.levels)]


def silent_from(far: FarSide) -> float:
    """When [s] every channel of every amplifier is silent, or was; -inf where none ever played."""
    for device in far.devices.values():
        device.status()
    outputs = (output for one in far.bench.amplifiers.values() for output in one.outputs)
    return max((tone.silent_from for output in outputs for tone in output), default=-math.inf)


def loudness(far: FarSide) -> float:
    """The highest level of any channel now."""
    return max(max(device.status().levels) for device in far.devices.values())
