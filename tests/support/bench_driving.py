"""Drive the amplifiers of a bench, by requests that must not be refused."""

from collections.abc import Collection

from drivers.command import CommandSet, DriveCommand
from drivers.protocol.messages import Apply, Arm, Nak, Ping, Request
from sim.bench.bench import Bench


def ask(bench: Bench, name: str, request: Request, now: float) -> None:
    """Exchange a request with an amplifier at a time [s]."""
    reply = bench.exchange(name, request, now=now)
    assert not isinstance(reply, Nak), reply


def play(
    bench: Bench,
    *commands: DriveCommand,
    now: float,
    name: str = "main",
    token: int = 1,
    ramp: float = 0.0,
    watchdog: float | None = None,
) -> None:
    """Apply a set at a time [s]; watchdog [s]: arm before, None where it is armed."""
    if watchdog is not None:
        ask(bench, name, Arm(watchdog), now)
    ask(bench, name, Apply(CommandSet(token, commands, ramp, 0.0)), now)


def keep_alive(
    bench: Bench, until: float, *, every: float = 0.5, names: Collection[str] | None = None
) -> None:
    """Advance to a time [s], with heartbeats to these amplifiers, None for all."""
    while (now := bench.time + every) < until:
        for name in names or bench.amplifiers:
            ask(bench, name, Ping(), now)
    bench.advance(until)
