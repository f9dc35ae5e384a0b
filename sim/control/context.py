"""The running simulation: its bench, devices, sensors and recording."""

import asyncio
import math
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from model.errors import InputError
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.plant.imperfections import PlateErrors
from sim.sensors.recorder import Accelerometers, Recorder


@dataclass
class SimulationContext:
    """A bench with its devices on wires and their URLs, both by name.

    step: advances virtual time [s], None in real time; recorder: None while nothing is recorded.
    """

    bench: Bench
    devices: Mapping[str, AmplifierDevice] = field(default_factory=dict)
    urls: Mapping[str, str] = field(default_factory=dict)
    step: Callable[[float], Coroutine[Any, Any, None]] | None = None
    recorder: Recorder | None = None
    accelerometers: Accelerometers = field(init=False)
    first_plate: PlateErrors = field(init=False)
    _solving: asyncio.Task[None] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        """Start without sensors, from the plate as it is."""
        self.accelerometers = Accelerometers(self.bench)
        self.first_plate = self.bench.imperfections.plate

    def start_solving(self) -> None:
        """Solve the plate under the newest fingers in a thread, so that amplifiers go on replying.

        At once in virtual time.
        """
        if self.step is not None:
            return  # the first who reads the plate solves it
        if self._solving is None or self._solving.done():
            self._solving = asyncio.create_task(self.solved(math.inf), name="solve the plate")

    async def solved(self, until: float) -> None:
        """Solve the plate under the fingers up to a time [s], or wait until it is."""
        while (placement := self.bench.unsolved) is not None and placement.time <= until:
            # An error is raised once more where the plate is read.
            await asyncio.gather(asyncio.to_thread(placement.solved), return_exceptions=True)

    async def stop_solving(self) -> None:
        """Leave what is unsolved."""
        if self._solving is not None:
            self._solving.cancel()
            await asyncio.wait({self._solving})

    def record(self, path: Path) -> None:
        """Start recording the present sensors and fingers; InputError while another one runs."""
        if self.recorder is not None:
            raise InputError(f"already recording {self.recorder.path}; finish it first")
        self.recorder = Recorder(
            self.bench,
            path,
            sensors=self.accelerometers.sensors,
            fingers=tuple(self.bench.fingers.layout.positions),
        )

    def stop_recording(self) -> Recorder:
        """Stop recording; returns the recorder to be finished. InputError if there is none."""
        recorder, self.recorder = self.recorder, None
        if recorder is None:
            raise InputError("no recording is running")
        recorder.stop()
        return recorder

    def devices_of(self, amplifier: str | None) -> Sequence[AmplifierDevice]:
        """The device of an amplifier, or all devices; InputError for an unknown name."""
        if amplifier is None:
            return tuple(self.devices.values())
        if amplifier not in self.devices:
            known = ", ".join(self.devices) or "(none on a wire)"
            raise InputError(f"amplifier must be one of {known}, got {str(amplifier)[:40]!r}")
        return (self.devices[amplifier],)

    async def finish_recording(self) -> str | None:
        """Write the running recording; returns a message about it, None where there is none."""
        if self.recorder is None:
            return None
        recorder = self.stop_recording()
        await asyncio.to_thread(recorder.finish)
        full = " (truncated at its maximum size)" if recorder.is_full else ""
        return f"wrote {recorder.path}: {recorder.seconds:.1f} s{full}"
