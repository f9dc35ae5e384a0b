"""What the benchmark of the plate in time runs: plants and benches, ready to go on for a while."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from benchmarks.plant.problem import FINGERS, Case
from benchmarks.setting import RIG
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts
from model.finger import fingertip_points
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Channel, Rig
from model.rig.rig_file import load_rig
from model.structure.attachments import Fingertip, FingertipLoad, footprints_of
from model.structure.exciter import Actuator
from model.transients.base_motion import raised_cosine
from sim.bench.bench import Bench
from sim.plant.plant import SAMPLE_RATE, Plant

FREQUENCIES = (110.0, 110.0, 250.0, 320.0)
SESSION, HALF = 1, 5000  # of the wire
_FREQUENCY = QUANTITIES["frequency"].to_wire
ONSETS = 0.5  # s between two new tones: a plate that only hums steadily would be no fair case


class Rigs:
    """The paper's rig with more or fewer ERAs, and its plate reduced."""

    def __init__(self) -> None:
        self._paper = load_rig(RIG)
        self.reduced = cache(self._reduce)

    def eras(self, count: int) -> tuple[Actuator, ...]:
        """The four in the corners and others along the edges."""
        length, width = self._paper.plate.length, self._paper.plate.width
        edge = [(x * length / 4, y * width) for y in (0, 1) for x in (1, 2, 3)]
        edge += [(x * length, y * width / 4) for x in (0, 1) for y in (1, 2, 3)]
        like = self._paper.eras[0]
        more = [replace(like, name=f"E{n}", x=x, y=y) for n, (x, y) in enumerate(edge)]
        return (*self._paper.eras, *more)[:count]

    def rig(self, case: Case) -> Rig:
        """With the ERAs wired to the amplifiers in turn."""
        eras = self.eras(case.eras)
        wiring = {
            era.name: Channel(f"A{n % case.amplifiers}", n // case.amplifiers)
            for n, era in enumerate(eras)
        }
        urls = {f"A{n}": "sim://" for n in range(case.amplifiers)}
        return replace(self._paper, eras=eras, wiring=wiring, amplifiers=urls)

    def size(self, frequency_max: float) -> int:
        """How many coordinates the plate on four ERAs has."""
        return len(self.reduced(4, frequency_max).omega)

    def prepare(self, case: Case) -> Callable[[float], None]:
        """What lets such a case go on for some seconds."""
        return self._bench(case) if case.commands else self._plant(case)

    def _reduce(self, eras: int, frequency_max: float) -> ReducedPlate:
        paper = self._paper
        at = footprints_of(self.eras(eras))
        return reduce_plate(paper.plate, paper.mesh, at, frequency_max=frequency_max)

    def _plant(self, case: Case) -> Callable[[float], None]:
        plant = Plant(self.reduced(case.eras, case.frequency_max), self.eras(case.eras))
        if case.loading:
            plant.set_contacts(_resting(FINGERS[: case.fingers]))
        tips = [fingertip_points(*at, self._paper.plate) for at in FINGERS[: case.fingers]]
        points = np.vstack([np.zeros((0, 2)), *tips])
        shapes = plant.reduced.at(points)
        taps = 0

        def go_on(seconds: float) -> None:
            nonlocal shapes, taps
            begin = plant.time
            for number in range(round(seconds / case.step)):
                now = begin + number * case.step
                if now % ONSETS < case.step:
                    _new_tones(plant, case.eras)
                if case.taps and number % round(1 / case.taps / case.step) == 0:
                    taps += 1
                    plant.set_contacts(_resting([FINGERS[taps % 10]]))
                    shapes = plant.reduced.at(points)
                plant.advance(now + case.step, sample_rate=SAMPLE_RATE, shapes=shapes)

        go_on(0.5)
        return go_on

    def _bench(self, case: Case) -> Callable[[float], None]:
        rig = self.rig(case)
        tip = Fingertip() if case.loading else None
        bench = Bench(replace(rig, fingertip=tip), now=0.0)
        bench.place_fingers({str(n): FINGERS[n] for n in range(case.fingers)}, now=0.0)
        token = 0
        for name in bench.amplifiers:
            watchdog = QUANTITIES["watchdog"].to_wire(2.0)
            bench.exchange(
                name, "Arm", {"session": SESSION, "watchdog": watchdog, "shift": 0}, now=0.0
            )

        def go_on(seconds: float) -> None:
            nonlocal token
            begin = bench.time
            every = round(1 / case.commands / case.step)
            for number in range(round(seconds / case.step)):
                now = begin + number * case.step
                if number % every == 0:
                    token += 1
                    for name, amplifier in bench.amplifiers.items():
                        commands = tuple(
                            Command(
                                channel, _FREQUENCY(FREQUENCIES[(channel + token) % 4]), HALF, 0
                            )
                            for channel in range(amplifier.capabilities["channels"])
                        )
                        stream = pack_layers([LayerSet(0, 20, 0, commands)])
                        (part,) = parts(stream, session=SESSION, token=token, now=True)
                        taken = bench.exchange(name, "Set", part, now=now)
                        assert taken["played"]
                bench.advance(now + case.step)
            bench.fingers.felt(bench.time, bench.time)  # sampled to the last

        go_on(0.5)
        return go_on


def _resting(places: Sequence[tuple[float, float]]) -> dict[str, FingertipLoad]:
    return {str(number): FingertipLoad(*at, Fingertip()) for number, at in enumerate(places)}


def _new_tones(plant: Plant, eras: int) -> None:
    for number in range(eras):
        omega = 2 * np.pi * FREQUENCIES[number % 4]
        plant.set_input(number, raised_cosine(plant.time, 0.02, omega, 0j, 1e-4))


def contact_times(rigs: Rigs) -> Iterator[tuple[str, float]]:
    """Seconds of the thread that it takes when fingers come, by how often they came before."""
    for count in (1, 2, 5, 10):
        plant = Plant(rigs.reduced(4, 500.0), rigs.eras(4))
        for what, shift in (("where none has been", 0.001), ("where they have been", 0.0)):
            times = []
            for number in range(5):
                at = [(x + shift * (number + 1), y) for x, y in FINGERS[:count]]
                plant.skip(plant.time + 1.0)
                if not shift:
                    plant.set_contacts(_resting(at))
                    plant.skip(plant.time + 0.1)
                    plant.set_contacts({})
                    plant.skip(plant.time + 1.0)
                used = time.thread_time()
                plant.set_contacts(_resting(at))
                times.append(time.thread_time() - used)
                plant.skip(plant.time + 0.1)
                plant.set_contacts({})
            yield f"{count} at once, {what}", float(np.median(times))
