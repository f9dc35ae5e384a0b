"""Matching of commands to touches, without data of the daemon.

The table is queried offline for each touch; a command that plays the result belongs to it.
"""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.latency.touches import FLOODING, HELD, Work, places
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.loop.capabilities import PlaybackCapabilities
from controller.loop.routing import phasor_of, route
from controller.loop.selection import MOVE_TOLERANCE, Selector
from controller.sources.contacts import Contact, ContactKey
from drivers.codec.serial_line.frame import unpack_words
from drivers.contents import Layer, Tone
from drivers.protocol.sets import Assembly, unpack_layers
from drivers.protocol.table import MAX_WORDS, QUANTITIES, read_request
from model.rig.rig import Rig
from model.table.table import LocalizationTable

MAX_AGE = 0.5  # s; of the touch of a command
_Tones = Mapping[tuple[str, int], tuple[float, complex]]
_TOLERANCE = (1e-4, 2e-3)  # absolute in full strokes, relative to the level


@dataclass(frozen=True)
class Command:
    """A set at the far end: arrival of its last byte [s], number of that frame, token, tones.

    commands: the tones of all layers, with the amplifier of each.
    """

    time: float
    sequence: int
    token: int
    commands: tuple[tuple[str, Tone], ...]


def read_commands(
    lines: Iterable[Sequence[int | str]], amplifiers: Collection[str]
) -> Iterator[Command]:
    """Read the lines of the far end: a set plays once the last amplifier has it, and its commit.

    Parts that are staged are of no moment by themselves. A frame that is repeated counts when it
    first came.
    """
    assemblies = {name: Assembly() for name in amplifiers}
    staged: dict[tuple[str, int], tuple[Tone, ...]] = {}
    played: dict[int, dict[str, tuple[Tone, ...]]] = {}
    for when, name, kind, sequence, payload in lines:
        amplifier, number, time = str(name), int(sequence), int(when) * 1e-9
        message, values = read_request(int(kind), unpack_words(bytes.fromhex(str(payload))))
        token = values["token"]
        if message == "Set":
            stream = assemblies[amplifier].add(values, time, MAX_WORDS * values["parts"])
            if stream is None:
                continue
            staged[amplifier, token] = _tones(stream)
            if not values["now"]:
                continue
        several = played.setdefault(token, {})
        several.setdefault(amplifier, staged[amplifier, token])
        if several.keys() == set(amplifiers):
            del played[token]
            all_of_them = tuple((name, each) for name in several for each in several[name])
            yield Command(time, number, token, all_of_them)


def _tones(stream: Sequence[int]) -> tuple[Tone, ...]:
    """Return the tones of all layers of a set."""
    in_units = [QUANTITIES[name].from_wire for name in ("frequency", "level", "phase")]
    frequency, level, phase = in_units
    return tuple(
        Tone(each.channel, frequency(each.frequency), level(each.level), phase(each.phase))
        for layer in unpack_layers(stream)
        for each in layer.commands
    )


@dataclass(frozen=True)
class Matched:
    """Numbers of the touches of commands, and latencies; unmatched: commands without a touch.

    newest [s]: from the command's touch; oldest [s]: from the first touch after that of the command
    before, which waited the longest.
    """

    touch: np.ndarray
    newest: np.ndarray
    oldest: np.ndarray
    unmatched: int


def match(
    commands: Sequence[Command],
    sent: np.ndarray,
    *errors: Callable[[int, Command], float],
    first: Callable[[int, int], int],
) -> Matched:
    """Match commands to touches sent at times (n,) [s], in ascending order.

    errors: distance of a command from the one expected for a touch, at most 1 for a match; the
    nearest counts, and later functions only where earlier ones match none. first: the touch for
    which a command was first due, after the touch before and up to that of this one.
    """
    found: list[tuple[int, float, float]] = []
    before, unmatched = -1, 0
    for command in commands:
        newest = int(np.searchsorted(sent, command.time)) - 1
        oldest = int(np.searchsorted(sent, command.time - MAX_AGE))
        # Of equal ones the newest, in favour of the daemon.
        touches = range(newest, max(before, oldest - 1), -1)
        touch = _nearest(touches, command, errors)
        if touch is None:
            unmatched += 1
            continue
        since = sent[first(before, touch)]
        found.append((touch, command.time - sent[touch], command.time - since))
        before = touch
    numbers, newest_, oldest_ = np.array(found).T if found else np.zeros((3, 0))
    return Matched(numbers.astype(int), newest_, oldest_, unmatched)


def _nearest(
    touches: Sequence[int],
    command: Command,
    errors: Sequence[Callable[[int, Command], float]],
) -> int | None:
    """The touch of a command by the first error function that matches any."""
    for error in errors if touches else ():
        found = [error(touch, command) for touch in touches]
        nearest = int(np.argmin(found))
        if found[nearest] <= 1:
            return touches[nearest]
    return None


class Expected:
    """Commands expected by the table for each touch of some work.

    flooded: displacement of the flood's finger [m]; None without one.
    """

    def __init__(
        self,
        work: Work,
        rig: Rig,
        table: LocalizationTable,
        capabilities: PlaybackCapabilities,
        *,
        flooded: float | None,
    ) -> None:
        self._rig, self._table, self._capabilities = rig, table, capabilities
        self._places = [self._on_plate(x, y) for _, x, y in places(work, rig.plate)]
        self._work = work
        self._others = [self._on_plate(*HELD)]
        if flooded is not None:
            length, width = rig.plate.length, rig.plate.width
            self._others.append((FLOODING[0] * length + flooded, FLOODING[1] * width))
        self._known: dict[tuple[float, float], _Tones] = {}

    def error(self, touch: int, command: Command) -> float:
        """Distance of a command from the one expected for a touch; up to 1 it matches."""
        expected = self._expected(touch)
        absolute, relative = _TOLERANCE
        loudest = max((abs(amplitude) for _, amplitude in expected.values()), default=0.0)
        most = 0.0
        for amplifier, played in command.commands:
            frequency, amplitude = expected.get((amplifier, played.channel), (played.frequency, 0j))
            if played.level > 0 and abs(played.frequency - frequency) > 0.01:
                return math.inf
            difference = abs(phasor_of(played) - amplitude)
            most = max(most, difference / (absolute + relative * loudest))
        return most

    def first(self, before: int, touch: int) -> int:
        """The first touch after one that needs another set."""
        if self._work.kind == "taps" or before < 0:
            return before + 1 if before >= 0 else touch
        then = self._places[before]
        for number in range(before + 1, touch):
            if math.dist(self._places[number], then) > MOVE_TOLERANCE:
                return number
        return touch

    def _expected(self, touch: int) -> _Tones:
        """Frequency [Hz] and complex level by amplifier and channel."""
        place = self._places[touch]
        if place not in self._known:
            contacts = [
                Contact(ContactKey("bench", number), x, y, since=float(number))
                for number, (x, y) in enumerate([*self._others, place])
            ]
            intent = EffectPlayer(SurfaceLayout()).intent(contacts, 0.0)
            pattern = Selector(self._table).select(contacts, intent, self._capabilities).pattern
            layers: Mapping[str, Layer] = {}
            if pattern is not None:
                layers = route(pattern.excitation, self._rig, ramp=pattern.ramp)
            self._known[place] = {
                (name, each.channel): (each.frequency, phasor_of(each))
                for name, one in layers.items()
                for each in one.tones
                if each.level > 0
            }
        return self._known[place]

    def _on_plate(self, x: float, y: float) -> tuple[float, float]:
        """Position on the plate [m] after transfer in single precision."""
        plate = self._rig.plate
        return float(np.float32(x)) * plate.length, (1 - float(np.float32(y))) * plate.width
