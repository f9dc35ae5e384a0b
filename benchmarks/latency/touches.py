"""The touches of the latency benchmark: the same for the same seed, in every process of it."""

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass

from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram
from model.structure.plate import Plate

APART = 0.050  # m; between a finger that is to feel it and those that are not
HELD = (0.25, 0.3)  # of the sensor; a finger of the panel that stays
FLOODING = (0.7, 0.75)  # of the plate, from its south-west corner; the one that the flood holds
WANDERS = 0.00001  # m; how far the flood moves its finger, so that all of it is news
SLIDE = 1.0  # m/s; a fast swipe
EDGE = 0.06  # of the sensor


@dataclass(frozen=True)
class Work:
    """What is touched: `taps`, every frame another finger somewhere else, so that each asks the
    table anew, or `slide`, one finger that wanders at 1 m/s, so that every eighth does or so."""

    kind: str
    count: int
    rate: float  # Hz
    seed: int


def places(work: Work, plate: Plate) -> Iterator[tuple[int, float, float]]:
    """Session id and place on the sensor (0..1) of the finger that feels it, frame by frame."""
    dice = random.Random(work.seed)
    x = y = 0.5
    goal = (x, y)
    step = SLIDE / work.rate
    for number in range(work.count):
        if work.kind == "taps":
            x, y = _anywhere(dice, plate)
            yield number + 2, x, y
            continue
        while (far := _distance((x, y), goal, plate)) < step:
            goal = _anywhere(dice, plate)
        x += (goal[0] - x) * step / far
        y += (goal[1] - y) * step / far
        yield 2, x, y


def datagrams(work: Work, plate: Plate) -> Iterator[bytes]:
    """What a panel sends for it: TUIO bundles with the finger that stays and the one that feels."""
    for number, (session, x, y) in enumerate(places(work, plate)):
        touches = (Touch(1, *HELD), Touch(session, x, y))
        yield tuio_datagram(TouchFrame("bench", 0.0, touches), number + 1)


def _anywhere(dice: random.Random, plate: Plate) -> tuple[float, float]:
    """A place that is not near a finger that is to be kept quiet."""
    while True:
        place = (dice.uniform(EDGE, 1 - EDGE), dice.uniform(EDGE, 1 - EDGE))
        others = (HELD, (FLOODING[0], 1 - FLOODING[1]))
        if all(_distance(place, other, plate) > APART for other in others):
            return place


def _distance(a: tuple[float, float], b: tuple[float, float], plate: Plate) -> float:
    return math.hypot((a[0] - b[0]) * plate.length, (a[1] - b[1]) * plate.width)
