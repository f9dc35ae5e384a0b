"""Touches of the latency benchmark, equal for equal seeds in all its processes."""

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass

from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram
from model.structure.plate import Plate

APART = 0.050  # m; between target and quiet fingers
HELD = (0.25, 0.3)  # of the sensor; the panel's resting finger
FLOODING = (0.7, 0.75)  # of the plate, from its corner SW; the flood's finger
WANDERS = 0.00001  # m; motion of the flood's finger, so that each touch is new
SLIDE = 1.0  # m/s; a fast swipe
EDGE = 0.06  # of the sensor


@dataclass(frozen=True)
class Work:
    """Touches: `taps`, a new finger in another place in every frame, each a query of the table, or
    `slide`, one finger that moves at 1 m/s, with a query about every ninth frame."""

    kind: str
    count: int
    rate: float  # Hz
    seed: int


def places(work: Work, plate: Plate) -> Iterator[tuple[int, float, float]]:
    """Session id and position on the sensor (0..1) of the target, frame by frame."""
    rng = random.Random(work.seed)
    x = y = 0.5
    goal = (x, y)
    step = SLIDE / work.rate
    for number in range(work.count):
        if work.kind == "taps":
            yield number + 2, *_anywhere(rng, plate)
            continue
        while (far := _distance((x, y), goal, plate)) < step:
            goal = _anywhere(rng, plate)
        x += (goal[0] - x) * step / far
        y += (goal[1] - y) * step / far
        yield 2, x, y


def datagrams(work: Work, plate: Plate) -> Iterator[bytes]:
    """TUIO bundles with the resting finger and the target."""
    for number, (session, x, y) in enumerate(places(work, plate)):
        touches = (Touch(1, *HELD), Touch(session, x, y))
        yield tuio_datagram(TouchFrame("bench", 0.0, touches), number + 1)


def _anywhere(rng: random.Random, plate: Plate) -> tuple[float, float]:
    """A random position away from the quiet fingers."""
    while True:
        place = (rng.uniform(EDGE, 1 - EDGE), rng.uniform(EDGE, 1 - EDGE))
        others = (HELD, (FLOODING[0], 1 - FLOODING[1]))
        if all(_distance(place, other, plate) > APART for other in others):
            return place


def _distance(a: tuple[float, float], b: tuple[float, float], plate: Plate) -> float:
    return math.hypot((a[0] - b[0]) * plate.length, (a[1] - b[1]) * plate.width)
