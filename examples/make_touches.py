"""Write touch recordings as a TUIO 1.1 tracker would send them.

- touches.tuio: one to three fingers at random positions (fixed seed), at least 6 cm apart.
- two_people.tuio: each person stays on one side of the plate.
- three_people.tuio: each person stays in a vertical strip; one person slides a finger, and one
  leaves before the others.

Requires python-osc. Run it again after changing it:

    python examples/make_touches.py
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import CURSORS
from controller.sources.tuio_capture import HEADER, RecordedDatagram

PLATE = np.array([0.3048, 0.2286])  # m
MARGIN = 0.015  # m; from the edges
MIN_DISTANCE = 0.06  # m; between fingers
FINGERS_PER_GROUP = (1, 2, 3, 2, 3, 1, 3, 2)
SIMULTANEOUS_GROUPS = (3, 7)  # groups whose fingers land simultaneously
HOLD = 0.55  # s; from one finger to the next, and after the last one
PAUSE = 0.15  # s; without fingers
REST = 0.75  # s; pause before simultaneous touches, until the plate has stopped ringing
FRAME = 1 / 60  # s; frame interval of the tracker
SETTLING = 0.08  # s; time in which a fingertip rolls into position
ROLL = 0.0015  # m; standard deviation of the rolling distance

# Times [s] from touch to lift, and the position at each time, relative to the plate's size
TWO_PEOPLE = [
    ((0.3, 1.6), [(0.20, 0.35)] * 2),
    ((0.7, 1.6), [(0.80, 0.60)] * 2),
    ((2.0, 3.3), [(0.65, 0.25)] * 2),
    ((2.4, 3.3), [(0.35, 0.80)] * 2),
]
THREE_PEOPLE = [
    ((0.3, 1.9, 2.3, 4.3), [(0.15, 0.30), (0.15, 0.30), (0.15, 0.65), (0.15, 0.65)]),
    ((0.7, 4.3), [(0.50, 0.70)] * 2),
    ((1.1, 3.2), [(0.85, 0.40)] * 2),
]


def draw_positions(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return random positions [m] (count, 2), more than MIN_DISTANCE apart."""
    while True:
        positions = rng.uniform(MARGIN, PLATE - MARGIN, (count, 2))
        distances = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
        if count == 1 or distances[np.triu_indices(count, 1)].min() > MIN_DISTANCE:
            return positions


def one_person(rng: np.random.Generator) -> list[tuple]:
    """Return the paths of several groups of fingers, one group after another."""
    paths = []
    lift = 0.15
    for group, count in enumerate(FINGERS_PER_GROUP):
        is_simultaneous = group in SIMULTANEOUS_GROUPS
        start = lift + (REST if is_simultaneous else PAUSE)
        interval = 0.0 if is_simultaneous else HOLD
        lift = start + (count - 1) * interval + HOLD
        for number, position in enumerate(draw_positions(count, rng) / PLATE):
            landing = start + number * interval
            paths.append(((landing, lift), [position, position]))
    return paths


def tuio_datagram(frame: TouchFrame, sequence: int) -> bytes:
    """Encode all touches of a frame; the frame's source is the sender's name."""
    bundle = OscBundleBuilder(IMMEDIATELY)
    messages: list[tuple[str | int | float, ...]] = [
        ("source", frame.source),
        ("alive", *(touch.id for touch in frame.touches)),
        *(("set", touch.id, touch.x, touch.y, 0.0, 0.0, 0.0) for touch in frame.touches),
        ("fseq", sequence),
    ]
    types = {str: "s", int: "i", float: "f"}
    for arguments in messages:
        message = OscMessageBuilder(CURSORS)
        for argument in arguments:
            message.add_arg(argument, types[type(argument)])
        bundle.add_content(message.build())
    return bytes(bundle.build().dgram)


def write_capture(path: Path | str, datagrams: Sequence[RecordedDatagram]) -> None:
    """Write datagrams sorted by time [s] with a resolution of 1 µs, for `read_capture`."""
    lines = [f"{datagram.time:.6f} {datagram.payload.hex()}" for datagram in datagrams]
    Path(path).write_text("\n".join([HEADER, *lines]) + "\n", encoding="ascii")


def record(name: str, paths: Sequence[tuple], rng: np.random.Generator) -> None:
    """Write a recording to this folder that ends shortly after the last finger lifts."""
    rolls = rng.normal(scale=ROLL, size=(len(paths), 2)) / PLATE
    datagrams = []
    end = max(times[-1] for times, _ in paths) + PAUSE
    for number, time in enumerate(np.arange(0.0, end, FRAME), start=1):
        alive = []
        for id, ((times, positions), roll) in enumerate(zip(paths, rolls, strict=True), start=1):
            if times[0] <= time < times[-1]:
                position = [np.interp(time, times, axis) for axis in zip(*positions, strict=True)]
                remaining = max(0.0, 1 - (time - times[0]) / SETTLING)
                x, y = position + remaining * roll
                alive.append(Touch(id, float(x), float(1 - y)))
        frame = TouchFrame("demo", float(time), tuple(alive))
        datagrams.append(RecordedDatagram(float(time), tuio_datagram(frame, number)))
    write_capture(Path(__file__).with_name(f"{name}.tuio"), datagrams)
    print(f"{name}: {len(paths)} touches in {end:.1f} s")


if __name__ == "__main__":
    rng = np.random.default_rng(2024)
    record("touches", one_person(rng), rng)
    record("two_people", TWO_PEOPLE, rng)
    record("three_people", THREE_PEOPLE, rng)
