"""Write recordings of touches in the format of a TUIO 1.1 tracker; schedules simulate people.

In touches.tuio, one to three fingers come and go at random positions (fixed seed), at least 6 cm
apart. In the other files each person stays in a vertical strip of the plate: two_people.tuio, and
three_people.tuio, in which one person slides and one leaves before the others. Run it again after a
change; it requires python-osc:

    python examples/make_touches.py
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import CURSORS, HEADER, RecordedDatagram

PLATE = np.array([0.3048, 0.2286])  # metres
MARGIN, APART = 0.015, 0.06  # metres
FINGERS_PER_GROUP = (1, 2, 3, 2, 3, 1, 3, 2)
AT_ONCE = (3, 7)  # groups whose fingers all come down at one moment
HOLD = 0.55  # seconds from one finger to the next, and after the last one
PAUSE = 0.15  # seconds with no finger down
REST = 0.75  # the same before simultaneous touches: the plate has stopped ringing
FRAME = 1 / 60  # seconds between the frames of a tracker
SETTLING = 0.08  # seconds over which a fingertip rolls into its place
ROLL = 0.0015  # metres that it rolls

# Times [s] from down to up, and where the finger is at each, in shares of the plate
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
    """Places [m] (count, 2), each at least APART from the others."""
    while True:
        places = rng.uniform(MARGIN, PLATE - MARGIN, (count, 2))
        gaps = np.linalg.norm(places[:, None] - places[None], axis=-1)
        if count == 1 or gaps[np.triu_indices(count, 1)].min() > APART:
            return places


def one_person(rng: np.random.Generator) -> list[tuple]:
    """Groups of fingers, one group after another."""
    paths = []
    up = 0.15
    for group, count in enumerate(FINGERS_PER_GROUP):
        start = up + (REST if group in AT_ONCE else PAUSE)
        apart = 0.0 if group in AT_ONCE else HOLD
        up = start + (count - 1) * apart + HOLD
        for number, place in enumerate(draw_positions(count, rng) / PLATE):
            paths.append(((start + number * apart, up), [place, place]))
    return paths


def tuio_datagram(frame: TouchFrame, sequence: int) -> bytes:
    """Encode a frame as a sender with the name of its source would, with all positions."""
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
    """Write datagrams in order of time, to a microsecond; `read_capture` checks them."""
    lines = [f"{each.time:.6f} {each.payload.hex()}" for each in datagrams]
    Path(path).write_text("\n".join([HEADER, *lines]) + "\n", encoding="ascii")


def record(name: str, paths: Sequence[tuple], rng: np.random.Generator) -> None:
    """Write the recording of some fingers to this folder, until shortly after the last lift."""
    rolls = rng.normal(scale=ROLL, size=(len(paths), 2)) / PLATE
    datagrams = []
    end = max(times[-1] for times, _ in paths) + PAUSE
    for number, time in enumerate(np.arange(0.0, end, FRAME), start=1):
        alive = []
        for id, ((times, places), roll) in enumerate(zip(paths, rolls, strict=True), start=1):
            if times[0] <= time < times[-1]:
                place = [np.interp(time, times, along) for along in zip(*places, strict=True)]
                x, y = place + roll * max(0.0, 1 - (time - times[0]) / SETTLING)
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
