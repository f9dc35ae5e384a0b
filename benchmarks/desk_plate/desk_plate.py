"""The plate behind a sound card: samples of all outputs in, samples of all inputs out."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.desk_plate.lifted_blocks import SAMPLES, LiftedBlocks, sampled
from benchmarks.desk_plate.model_in_time import DeskModel
from benchmarks.desk_plate.sensing import Converters, SensorChannels
from benchmarks.desk_plate.truth import Truth
from era_haptics.lab.measuring.sound_card import Desk, WiredSensor, are_positions
from model.arrays import FloatArray
from model.errors import InputError
from model.finger import fingertips_on
from model.structure.attachments import FingertipLoad, fingertip_loads

_LOOPED = 0.9  # of what a cable from an output to an input brings back


class DeskPlate:
    """A plate with accelerometers, a loop-back cable, and fingers on request.

    Outputs and inputs of the card are those of a `Desk`; is_shared: the loop-back is a Y-cable
    beside the last ERA. rate [Hz]. One sensor that is
    moved is at the first of its places, with its mass, and off the plate while it is touched.
    `advance` and all else may be called by different threads.
    """

    def __init__(
        self,
        truth: Truth,
        sensors: Sequence[WiredSensor],
        *,
        rate: float,
        converters: Converters,
        seed: int,
        is_shared: bool = False,
    ) -> None:
        self._truth, self._rate = truth, rate
        desk = Desk(truth.rig, tuple(sensors), is_shared)
        self._columns = [output - 1 for _, output in desk.eras]
        self._looped, self.outputs = desk.sources[-1] - 1, desk.output
        self._model = DeskModel(truth, np.array([[sensor.x, sensor.y] for sensor in sensors]))
        self._sensors = tuple(sensors)
        self._fingers: tuple[FingertipLoad, ...] = ()
        self._place = 0 if are_positions(sensors) else None
        self._channels = SensorChannels(
            sensors if self._place is None else sensors[:1],
            loopback=desk.input,
            converters=converters,
            rate=rate,
            seed=seed,
        )
        self.inputs = self._channels.count
        self._next: LiftedBlocks | None = None
        self._plate = self._now()
        self._kept = self._model.shared

    def set_fingers(
        self, places: Sequence[tuple[float, float]], factors: Sequence[float] = ()
    ) -> None:
        """Replace the fingers on the plate, at places [m]; computed here, swapped between blocks.

        factors: of their loads, empty for those of the rig's. The plate's motion is continuous;
        phalanges begin at rest.
        """
        loads = fingertip_loads(self._truth.rig.fingertip, places)
        self._fingers = tuple(
            replace(each, fingertip=each.fingertip.multiplied(factor))
            for each, factor in zip(loads, factors or [1.0] * len(loads), strict=True)
        )
        self._next = self._now()

    def begin_feeling(self) -> None:
        """Keep from now on what the fingers feel."""
        self._plate.history = []

    def felt(self) -> FloatArray:
        """What they felt: accelerations (n, k, p) [m/s²] at the points under k fingertips.

        At the rate of the samples over SAMPLES; until now, and no longer.
        """
        history, self._plate.history = self._plate.history, None
        plate, at = self._truth.rig.plate, np.array([(each.x, each.y) for each in self._fingers])
        points, _ = fingertips_on(at, length=plate.length, width=plate.width)
        model = self._model.under(self._fingers, points=points.reshape(-1, 2))
        found = sampled(model, rate=self._rate).outputs(np.array(history))
        return found.reshape(-1, *points.shape[:2])

    def move_sensor(self, name: str) -> None:
        """Put a sensor that is moved to another of its places; raises InputError."""
        names = [sensor.name for sensor in self._sensors]
        if self._place is None or name not in names:
            raise InputError(
                f"a sensor is moved to one of the places of one sensor, got {name!r} of "
                f"{', '.join(names)}"
            )
        self._place = names.index(name)
        self._next = self._now()

    def _now(self) -> LiftedBlocks:
        moved = None
        if self._place is not None:
            mass = 0.0 if self._fingers else self._sensors[self._place].mass
            moved = self._place, mass
        return LiftedBlocks(sampled(self._model.under(self._fingers, moved=moved), rate=self._rate))

    def advance(self, played: FloatArray) -> FloatArray:
        """Samples (n, inputs) for samples (n, outputs); n a multiple of 16."""
        following, self._next = self._next, None
        if following is not None:
            following.carry_on(self._plate, self._kept)
            self._plate = following
        accelerations = self._plate.advance(played[:, self._columns])
        return self._channels.samples(accelerations, _LOOPED * played[:, self._looped])


BLOCK_MULTIPLE = SAMPLES
"""Frames of a block must be a multiple of this."""
