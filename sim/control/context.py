"""A running far end as control sees it: the bench and all that stands around it."""

import asyncio
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from model.errors import InputError
from sim.bench.bench import Bench
from sim.bench.simulated_device import SimulatedDevice
from sim.sensors.on_bench import Accelerometers
from sim.sensors.recorder import Recorder


@dataclass
class SimulationContext:
    """A bench, and what else there is.

    devices: amplifiers on wires, urls: where, both by name; step: lets virtual time [s] pass, None
    where time is the clock's; recorder: the recording that is being made, if there is one.
    """

    bench: Bench
    devices: Mapping[str, SimulatedDevice] = field(default_factory=dict)
    urls: Mapping[str, str] = field(default_factory=dict)
    step: Callable[[float], Coroutine[Any, Any, None]] | None = None
    recorder: Recorder | None = None
    accelerometers: Accelerometers = field(init=False)

    def __post_init__(self) -> None:
        """No sensor is there at first."""
        self.accelerometers = Accelerometers(self.bench)

    def record(self, path: Path) -> None:
        """Record sensors and fingers that are there now; InputError if one is being made."""
        if self.recorder is not None:
            raise InputError(f"{self.recorder.path} is being recorded; finish it first")
        self.recorder = Recorder(
            self.bench,
            path,
            sensors=self.accelerometers.sensors,
            fingers=tuple(self.bench.fingers.layout.positions),
        )

    def stop_recording(self) -> Recorder:
        """Record no more; what comes back is still to be finished. InputError if there is none."""
        recorder, self.recorder = self.recorder, None
        if recorder is None:
            raise InputError("nothing is being recorded")
        recorder.stop()
        return recorder

    def devices_of(self, amplifier: str | None) -> Sequence[SimulatedDevice]:
        """One amplifier's, or those of all; InputError for none."""
        if amplifier is None:
            return tuple(self.devices.values())
        if amplifier not in self.devices:
            known = ", ".join(self.devices) or "no amplifier on a wire"
            raise InputError(f"{str(amplifier)[:40]!r} is none of the far end's: {known}")
        return (self.devices[amplifier],)


async def finish_recording(context: SimulationContext) -> str | None:
    """Write the recording that is being made; what to say of it, None where there is none."""
    if context.recorder is None:
        return None
    recorder = context.stop_recording()
    await asyncio.to_thread(recorder.finish)
    full = " (as long as it may become; the rest is not in it)" if recorder.is_full else ""
    return f"wrote {recorder.path}: {recorder.seconds:.1f} s{full}"
