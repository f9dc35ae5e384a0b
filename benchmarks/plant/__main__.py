"""How much faster than real time the simulated plate is, on one thread, and how that grows.

    python -m benchmarks.plant [--seconds 2] [--repeats 3]

The founding paper's plate on its four ERAs, each driven by a tone that is begun anew twice a
second, two fingertips of 21 points that are sampled at the sensors' rate, all moved on by steps of
10 ms as a far end in real time does. Then one thing at a time is more or less. Times are the
thread's own, which other work lengthens least; the best of the repeats counts, and ratios are to
the first line of the same run. Exits with 1 where that is not fifty times faster than real time.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

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
from sim.plant.plant import PLANT_SAMPLE_RATE, Plant

STEP = 0.01  # s
FINGERS = ((0.10, 0.08), (0.25, 0.17), (0.05, 0.19), (0.18, 0.03), (0.28, 0.05),
           (0.15, 0.14), (0.21, 0.20), (0.03, 0.03), (0.12, 0.21), (0.20, 0.10))  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A simulated case: numbers of ERAs, amplifiers and fingers."""

    eras: int = 4
    amplifiers: int = 1
    fingers: int = 2
    loading: bool = False
    frequency_max: float = 500.0
    step: float = STEP
    taps: int = 0  # per second
    commands: int = 0  # per second


WANTED = 50.0  # times faster than real time


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plant", description=__doc__)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()

    rigs = Rigs()

    def factor(case: Case) -> float:
        run = rigs.prepare(case)
        return max(_factor(run, options.seconds) for _ in range(options.repeats))

    base = Case()
    first = factor(base)
    print(f"{'four ERAs, two fingers':44s} {first:7.0f} times real time")
    for title, cases in (
        ("ERAs", {f"{n} ERAs": Case(eras=n) for n in (3, 8, 16)}),
        (
            "modes kept",
            {
                f"up to {2 * f:.0f} Hz: {rigs.size(f)} coordinates": Case(frequency_max=f)
                for f in (250.0, 500.0, 1000.0, 2000.0)
            },
        ),
        ("fingers that feel", {f"{n} fingers": Case(fingers=n) for n in (0, 1, 5, 10)}),
        (
            "fingers that load",
            {f"{n} fingers": Case(fingers=n, loading=True) for n in (1, 2, 5, 10)},
        ),
        ("steps", {f"{1e3 * s:g} ms": replace(base, step=s) for s in (0.001, 0.1, 1.0)}),
        (
            "one finger that loads, tapping on ten places in turn",
            {f"{n} taps a second": Case(fingers=1, loading=True, taps=n) for n in (2, 5, 10)},
        ),
        (
            "the whole bench, amplifiers and their watchdogs too",
            {
                f"{channels} channels on {n}, {rate} sets a second": Case(
                    eras=channels, amplifiers=n, commands=rate
                )
                for channels, n, rate in (
                    (4, 1, 2),
                    (4, 1, 20),
                    (4, 4, 20),
                    (8, 2, 20),
                    (16, 4, 20),
                )
            },
        ),
    ):
        print(f"\n{title}")
        for name, case in cases.items():
            found = factor(case)
            print(f"  {name:42s} {found:7.0f} times real time, {found / first:5.2f} of the first")
    print("\nwhen fingers that load the plate come")
    for name, seconds in contact_times(rigs):
        print(f"  {name:42s} {1e3 * seconds:7.2f} ms")
    print(f"\n{'at least' if first >= WANTED else 'NOT'} {WANTED:g} times faster than real time")
    return 0 if first >= WANTED else 1


def _factor(run: Callable[[float], None], seconds: float) -> float:
    used = time.thread_time()
    run(seconds)
    return seconds / (time.thread_time() - used)


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
                plant.advance(now + case.step, sample_rate=PLANT_SAMPLE_RATE, shapes=shapes)

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


if __name__ == "__main__":
    sys.exit(main())
