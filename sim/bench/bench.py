"""A rig that exists in numbers only: its amplifiers, its plate in time, and fingers on it.

It moves when it is told the time and never reads a clock itself. Amplifier channels reach the ERAs
through the rig's wiring, level 1 being the ERA's full stroke, with what imperfections there are.
"""

from collections import OrderedDict, deque
from collections.abc import Collection, Mapping
from functools import lru_cache
from typing import Protocol

import numpy as np

from drivers.protocol.messages import Reply, Request
from model.arrays import FloatArray
from model.fem.assembly import era_positions
from model.fem.mesh import Mesh
from model.finger.load import FingerLoad
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.structure.actuator import Era
from model.structure.plate import Plate
from model.structure.point_load import PointLoad, load_positions
from model.transients.base_motion import Term
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.plant.base_motion import terms_of
from sim.plant.felt import Felt, feel
from sim.plant.finger import KEPT, Fingers, Position, Record
from sim.plant.imperfections import ChannelErrors, Imperfections, delayed, draw_noise, realised
from sim.plant.plant import SAMPLE_RATE, Plant
from sim.waveform.output import Output, Tone

_PORTION = 1.0  # s; what is sampled at once, however long nobody asked
_SHAPES_KEPT = 16  # sets of points; as many listeners ask for them again and again


class Tap(Protocol):
    """Something that hears the plate all the time, by its reduced shapes at points (p, r)."""

    @property
    def shapes(self) -> FloatArray:
        """Where it listens."""
        ...

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Take what was there: (n,) [s], (n, p) [m/s²]; without a gap to what came before."""
        ...


class Bench:
    """A simulated rig that is at rest at time now [s]; sample_rate [Hz]: of all that is measured.

    taps: what listens beside the fingers; finger_load: what every finger does to the plate, None
    for fingers that only feel; imperfections: how its amplifiers differ from what they are told.
    Raises InputError for imperfections of what the rig does not have.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        now: float,
        sample_rate: float = SAMPLE_RATE,
        finger_load: FingerLoad | None = None,
        imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
    ) -> None:
        imperfections.check(rig)
        self.rig = rig
        self.sample_rate = sample_rate
        self.finger_load = finger_load
        self.imperfections = imperfections
        self.taps: list[Tap] = []
        reduced = _reduced(
            rig.plate, rig.mesh, tuple(rig.eras), tuple(rig.loads), rig.limits.frequency_max
        )
        self.fingers = Fingers(reduced)
        self._time = now
        # It is moved when its drive changes or somebody listens: in between it needs no attention.
        self._plant = Plant(reduced, rig.eras, loads=rig.loads, time=now)
        self.amplifiers: Mapping[str, SimulatedAmplifier] = {
            name: SimulatedAmplifier(name, channels=_channel_count(rig, name))
            for name in rig.amplifiers
        }
        # By ERA: what its channel plays, as it was heard last and as the plant has been told; in
        # between lie the changes that are under way, each with its time [s].
        self._heard: list[Output] = [()] * len(rig.eras)
        self._told: list[Output] = [()] * len(rig.eras)
        self._coming: list[deque[tuple[float, Output]]] = [deque() for _ in rig.eras]
        self._noise = [draw_noise(seed=imperfections.seed, number=n) for n in range(len(rig.eras))]
        self._shapes: OrderedDict[bytes, FloatArray] = OrderedDict()
        self._played: deque[tuple[Tone, float]] = deque()  # and when it was replaced [s]

    @property
    def time(self) -> float:
        """How far everything has been moved [s]."""
        return self._time

    def advance(self, now: float) -> None:
        """Let everything happen that happens until now [s], each thing at its own moment."""
        if now - self.time > KEPT and not self.taps:  # what nobody could ask for is not sampled
            self._advance_amplifiers(now - KEPT, watched=False)
        while now - self.time > _PORTION:
            self._advance_amplifiers(self.time + _PORTION, watched=True)
        self._advance_amplifiers(now, watched=True)

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """The reduced shapes (p, r) at points (p, 2) [m]: what a tap there listens by.

        They hold until fingers that load the plate come, go or move: ask again every time.
        """
        key = points.tobytes()
        if key not in self._shapes:
            while len(self._shapes) >= _SHAPES_KEPT:
                self._shapes.popitem(last=False)
            self._shapes[key] = self._plant.reduced.at(points)
        self._shapes.move_to_end(key)
        return self._shapes[key]

    def exchange(self, amplifier: str, request: Request, *, now: float) -> Reply:
        """What an amplifier answers to a request that arrives now [s]."""
        now = max(now, self.time)
        self.advance(now)
        reply = self.amplifiers[amplifier].handle(request, now)
        self._tell_plant()
        return reply

    def place_fingers(
        self, positions: Mapping[str, Position], *, now: float, observers: Collection[str] = ()
    ) -> None:
        """Fingers rest here [m] from now [s] on, and no others; InputError changes nothing.

        observers: those that only feel, whatever the others do to the plate.
        """
        self.fingers.check(positions)
        self.advance(now)
        load = self.finger_load
        if load is not None:
            self._plant.skip(self._time)
            before = self._plant.reduced
            self._plant.set_contacts(
                [load.at(*at) for name, at in positions.items() if name not in observers]
            )
            if self._plant.reduced is not before:
                self._shapes.clear()
        self.fingers.place(positions, reduced=self._plant.reduced)

    def records(self, since: float, until: float) -> tuple[dict[str, Record], list[float]]:
        """What each finger went through in a window of the last ten seconds [s], by its id.

        Also the frequencies [Hz] that were driven in it, ascending.
        """
        return self.fingers.felt(since, until), self._frequencies(since, until)

    def felt(self, since: float, until: float) -> dict[str, Felt]:
        """What each finger felt in such a window, by its id."""
        records, frequencies = self.records(since, until)
        return {name: feel(record, frequencies) for name, record in records.items()}

    def _advance_amplifiers(self, to_time: float, *, watched: bool) -> None:
        while True:
            moment = min((a.next_event for a in self.amplifiers.values()), default=to_time)
            moment = min(moment, *(coming[0][0] for coming in self._coming if coming), to_time)
            self._move_plant(moment, watched=watched)
            for amplifier in self.amplifiers.values():
                amplifier.tick(moment)
            self._tell_plant()
            if moment >= to_time:
                return

    def _move_plant(self, to_time: float, *, watched: bool) -> None:
        if to_time <= self.time:
            return
        since, self._time = self._time, to_time
        if not (watched and (self.fingers.layout.positions or self.taps)):
            return
        self._plant.skip(since)
        heard = [self.fingers.layout.shapes, *(tap.shapes for tap in self.taps)]
        times, accelerations = self._plant.advance(
            to_time, sample_rate=self.sample_rate, shapes=np.concatenate(heard)
        )
        parts = np.split(accelerations, np.cumsum([len(shapes) for shapes in heard])[:-1], axis=1)
        self.fingers.record(times, parts[0])
        for tap, part in zip(self.taps, parts[1:], strict=True):
            tap.record(times, part)

    def _tell_plant(self) -> None:
        """Pass on what the channels play, where it is not what the plant knows already."""
        for index, era in enumerate(self.rig.eras):
            channel = self.rig.wiring[era.name]
            playing = self.amplifiers[channel.amplifier].outputs[channel.number]
            coming = self._coming[index]
            if playing is not self._heard[index]:
                self._heard[index] = playing
                delay = self.imperfections.delay(channel.amplifier)
                coming.append((self.time + delay, delayed(playing, delay)))
            while coming and coming[0][0] <= self.time:
                _, playing = coming.popleft()
                told = self._told[index]
                self._plant.skip(self._time)
                self._plant.set_input(index, self._motion(index, playing))
                self._played.extend((tone, self.time) for tone in told if tone not in playing)
                self._told[index] = playing
        while self._played and self._played[0][1] < self.time - KEPT:
            self._played.popleft()

    def _motion(self, index: int, playing: Output) -> list[Term]:
        """How the base of an ERA moves while its channel plays, imperfections and all."""
        era = self.rig.eras[index]
        terms = [term for tone in playing for term in terms_of(tone, stroke=era.stroke)]
        errors = self.imperfections.channels.get(self.rig.wiring[era.name], ChannelErrors())
        terms = realised(terms, errors)
        if errors.noise and playing:
            end = max(tone.silent_from for tone in playing)
            rms = errors.noise * era.stroke
            terms += self._noise[index].terms(rms, start=self.time, end=end)
        return terms

    def _frequencies(self, since: float, until: float) -> list[float]:
        """Every frequency [Hz] that some channel was asked to play at some time in a window."""
        ended = [(tone, min(end, tone.silent_from)) for tone, end in self._played]
        present = [(tone, tone.silent_from) for output in self._told for tone in output]
        return sorted(
            {tone.frequency for tone, end in ended + present if tone.start < until and end > since}
        )


@lru_cache(maxsize=2)  # benches are made one after the other, of one rig
def _reduced(
    plate: Plate,
    mesh: Mesh,
    eras: tuple[Era, ...],
    loads: tuple[PointLoad, ...],
    frequency_max: float,
) -> ReducedPlate:
    points = np.vstack([era_positions(eras), load_positions(loads)])
    return reduce_plate(plate, mesh, points, frequency_max=frequency_max)


def _channel_count(rig: Rig, amplifier: str) -> int:
    numbers = [channel.number for channel in rig.wiring.values() if channel.amplifier == amplifier]
    return max(numbers, default=0) + 1
