"""Amplifiers on a bench, armed and playing, without a wire."""

from collections.abc import Collection

from drivers.playing import AmplifierTone
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts
from sim.bench.bench import Bench

SESSION = 9
_Q = QUANTITIES


def arm_bench(bench: Bench, watchdog: float, *, now: float, name: str = "main") -> None:
    """Arm an amplifier at a time [s], with a watchdog [s]."""
    values = {"session": SESSION, "watchdog": _Q["watchdog"].to_wire(watchdog), "shift": 0}
    bench.exchange(name, "Arm", values, now=now)


def play(
    bench: Bench,
    *tones: AmplifierTone,
    now: float,
    name: str = "main",
    token: int = 1,
    ramp: float = 0.0,
    watchdog: float | None = None,
) -> None:
    """Play tones in layer 0 at a time [s]; watchdog [s]: arm before, None where it is armed."""
    if watchdog is not None:
        arm_bench(bench, watchdog, now=now, name=name)
    commands = [
        Command(
            tone.channel,
            _Q["frequency"].to_wire(tone.frequency),
            _Q["level"].to_wire(tone.level),
            _Q["phase"].to_wire(tone.phase),
        )
        for tone in tones
    ]
    layer = LayerSet(0, _Q["ramp"].to_wire(ramp), 0, tuple(commands))
    for part in parts(pack_layers([layer]), session=SESSION, token=token, now=True):
        bench.exchange(name, "Set", part, now=now)


def keep_alive(
    bench: Bench, until: float, *, every: float = 0.5, names: Collection[str] | None = None
) -> None:
    """Advance to a time [s], with heartbeats to these amplifiers, None for all."""
    while (now := bench.time + every) < until:
        for name in names or bench.amplifiers:
            bench.exchange(name, "Ping", {"session": SESSION, "rate": 0}, now=now)
    bench.advance(until)
