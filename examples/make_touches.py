"""Makes touches.tuio: a stream of touches as a TUIO 1.1 tracker sends them, one to three fingers.

The schedule below stands for people at the plate; places are drawn once with a fixed seed, fingers
at least 6 cm apart. Run it again after changing the schedule:

    python examples/make_touches.py
"""

from pathlib import Path

import numpy as np

from controller.sources.capture import RecordedDatagram, write_capture
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram

LENGTH, WIDTH = 0.3048, 0.2286
MARGIN = 0.015
APART = 0.06
FINGERS_PER_GROUP = (1, 2, 3, 2, 3, 1, 3, 2, 3, 2)
AT_ONCE = (3, 7, 9)  # groups whose fingers all come down at one moment
HOLD = 0.55  # seconds from one finger to the next, and after the last one
PAUSE = 0.15  # seconds with no finger down
REST = 0.75  # the same before those that come at one moment: the plate has stopped ringing
FRAME = 1 / 60  # seconds between the frames of a tracker
SETTLING = 0.08  # seconds over which a fingertip rolls into its place
ROLL = 0.0015  # metres that it rolls


def draw_places(count: int, rng: np.random.Generator) -> np.ndarray:
    """Places [m] (count, 2), each at least APART from the others."""
    while True:
        places = rng.uniform([MARGIN, MARGIN], [LENGTH - MARGIN, WIDTH - MARGIN], (count, 2))
        gaps = np.linalg.norm(places[:, None] - places[None], axis=-1)
        if count == 1 or gaps[np.triu_indices(count, 1)].min() > APART:
            return places


def schedule(rng: np.random.Generator) -> tuple[list[tuple[float, float, np.ndarray]], float]:
    """Every touch as (down [s], up [s], place [m]) and when the last one is up."""
    touches = []
    start = 0.3
    for group, count in enumerate(FINGERS_PER_GROUP):
        apart = 0.0 if group in AT_ONCE else HOLD
        start += REST - PAUSE if group in AT_ONCE else 0.0
        up = start + (count - 1) * apart + HOLD
        places = draw_places(count, rng)
        touches += [(start + n * apart, up, place) for n, place in enumerate(places)]
        start = up + PAUSE
    return touches, start


def main() -> None:
    """Write the capture beside this file."""
    rng = np.random.default_rng(2024)
    touches, end = schedule(rng)
    rolls = rng.normal(scale=ROLL, size=(len(touches), 2))
    datagrams = []
    for number, time in enumerate(np.arange(0.0, end, FRAME), start=1):
        alive = []
        for id, ((down, up, place), roll) in enumerate(zip(touches, rolls, strict=True), start=1):
            if down <= time < up:
                x, y = place + roll * max(0.0, 1 - (time - down) / SETTLING)
                alive.append(Touch(id, float(x / LENGTH), float(1 - y / WIDTH)))
        frame = TouchFrame("demo", float(time), tuple(alive))
        datagrams.append(RecordedDatagram(float(time), tuio_datagram(frame, number)))
    write_capture(Path(__file__).with_name("touches.tuio"), datagrams)
    print(f"{len(touches)} touches in {end:.1f} s")


if __name__ == "__main__":
    main()
