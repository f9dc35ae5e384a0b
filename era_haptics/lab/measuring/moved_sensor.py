"""A plate measured with one sensor that is moved from place to place, by a person at a terminal.

Every place is a measurement of its own. Its phases are relative to the loop-back, so that places
measured minutes apart agree; the sensor's gain is one. What is measured is written after each
place, so that the rest can be measured another time.
"""

import math
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import LinkError
from era_haptics.lab.measuring.measure import MeasuredResponses, measure
from era_haptics.lab.measuring.sound_card import Desk, DeviceLost, Multisine, SoundCard, WiredSensor
from model.arrays import ComplexArray, FloatArray
from model.commands.options import Stopwatch
from model.errors import InputError
from model.estimate.measurement import Measurement, measurement_of, read_measured, write_responses

_SAME = 0.02  # of the response, or so many times its noise:
_OF_NOISE = 3.0
_APART = 5e-3  # m; nearer places may sound alike
_AT = 5e-4  # m; places of a file are those of the sensors within that
_NOISY = 0.03  # of the response


@dataclass(eq=False)
class PositionsFile:
    """What is measured at places of a desk with a multisine, and the file that keeps it.

    values (f, eras) [1/s²] by the name of a place.
    """

    path: Path
    desk: Desk
    multisine: Multisine
    values: dict[str, ComplexArray] = field(default_factory=dict)

    @property
    def setting(self) -> str:
        """What must be the same at all places, in words of the file."""
        grams = 1e3 * self.desk.sensors[0].mass
        rig = self.desk.rig.fingerprint[:8]
        return f"level {self.multisine.level:g}, sensor {grams:.6g} g, rig {rig}"

    @property
    def missing(self) -> list[WiredSensor]:
        """Places that are not measured, in the order of their file."""
        return [place for place in self.desk.sensors if place.name not in self.values]

    def read(self) -> None:
        """Go on from the file; raises InputError where it is of another measurement."""
        measured, played = read_measured(self.path), self.multisine.frequencies
        settings = {each.setting for each in measured} - {self.setting}
        if settings:
            raise self._other("setting", self.setting, " and ".join(settings) or "none")
        found = measurement_of(measured, self.desk.rig)
        if found.skipped or not np.array_equal(found.frequencies.round(6), played.round(6)):
            raise self._other("frequencies", _span(played), _span(found.frequencies))
        for at, values in zip(found.points.tolist(), found.values.swapaxes(0, 1), strict=True):
            self.values[self._place_at(at).name] = values

    def keep(self, place: WiredSensor, found: MeasuredResponses) -> None:
        """Write the file with another place; raises OSError."""
        self.values[place.name] = found.responses.values[:, 0]
        places = [place for place in self.desk.sensors if place.name in self.values]
        measured = Measurement(
            tuple(place.place for place in places),
            self.multisine.frequencies,
            np.stack([self.values[place.name] for place in places], axis=1),
        )
        write_responses(self.path, measured, self.desk.rig, setting=self.setting)

    def _place_at(self, at: Sequence[float]) -> WiredSensor:
        for place in self.desk.sensors:
            if math.dist((place.x, place.y), at) <= _AT:
                return place
        raise self._other("places", "one at each line of --sensors", f"({at[0]:g}, {at[1]:g}) m")

    def __str__(self) -> str:
        """How far it is, in a line."""
        count, total = len(self.values), len(self.desk.sensors)
        text = f"{count} of {total} places are measured" + (f", in {self.path}" if count else "")
        return f"{text}; go on with --resume" if 0 < count < total else text

    def _other(self, what: str, expected: str, got: str) -> InputError:
        return InputError(
            f"--resume {self.path}: {what} must be {expected}, got {got} in the file; measure as "
            "it was begun, or leave out --resume and write another file"
        )


def measure_by_moving(
    desk: Desk,
    opened: AbstractContextManager[tuple[SoundCard, Multisine]],
    output: Path,
    *,
    periods: int,
    is_resumed: bool,
) -> tuple[list[str], dict[str, Any], bool]:
    """Guide a person at a terminal through the places of a desk.

    Return the report, and whether all places are measured. Raises InputError, LinkError,
    KeyboardInterrupt, having said what is kept.
    """
    if output.exists() != is_resumed:
        raise InputError(
            f"{output}: a file must be there to go on from with --resume, got none; leave it out"
            if is_resumed
            else f"{output}: exists; go on with --resume, or choose another name"
        )
    with Stopwatch() as timed, opened as (card, multisine):
        file = PositionsFile(output, desk, multisine)
        if is_resumed:
            file.read()
            _tell(str(file))
        try:
            found = measure_positions(file, card, periods=periods)
        except KeyboardInterrupt:
            card.close()  # silent before anything is said
            _tell(f"\nstopped; {file}")
            raise
        except DeviceLost as problem:
            raise LinkError(f"{problem}; check its cable; {file}") from problem
    missing = [place.name for place in file.missing]
    answer = {
        "frequencies_hz": multisine.frequencies.tolist(),
        "places": {"measured": [*found], "missing": missing},
        "sensors": {name: each.quality(0) for name, each in found.items()},
        "measure_time_s": timed.elapsed,
        "files": [str(output)] if file.values else [],
    }
    return [str(file)], answer, not missing


def _prompt(text: str) -> str:
    sys.stderr.write(text)
    sys.stderr.flush()
    return sys.stdin.readline() or "q"


def _tell(text: str) -> None:
    sys.stderr.write(f"{text}\n")


def measure_positions(
    file: PositionsFile,
    card: SoundCard,
    *,
    periods: int,
    prompt: Callable[[str], str] = _prompt,
    tell: Callable[[str], None] = _tell,
) -> dict[str, MeasuredResponses]:
    """Guide a person through the missing places; returns what was measured now, by place.

    prompt: shows what to do and returns what was typed, "q" at the end; tell: shows a line. A place
    that fails a check is reported with its remedy, and asked for again. Raises DeviceLost, OSError;
    what was measured before is in the file then.
    """
    found: dict[str, MeasuredResponses] = {}
    todo = file.missing
    last: WiredSensor | None = None
    tell(
        "Enter measures a place, r the one before again, s skips it, q stops; what is measured is "
        "kept"
    )
    while todo:
        place, places = todo[0], file.desk.sensors
        reply = prompt(
            f"Put the sensor at {place.name}, x {1e3 * place.x:g} mm, y {1e3 * place.y:g} mm "
            f"(place {places.index(place) + 1} of {len(places)}), then Enter: "
        )
        match reply.strip().lower():
            case "q":
                break
            case "s":
                todo.pop(0)
            case "r" if last is not None:
                todo.insert(0, last)
                last = None
            case "":
                try:
                    measured = measure(
                        replace(file.desk, sensors=(place,)),
                        card,
                        file.multisine,
                        periods=periods,
                        is_heard=bool(file.values),
                    )
                    _check_moved(file, place, measured)
                except DeviceLost:
                    raise
                except (InputError, LinkError) as problem:
                    tell(f"{place.name} is not kept: {problem}")
                    continue
                file.keep(place, measured)
                found[place.name] = measured
                last = todo.pop(0)
                tell(_line(place, measured))
            case _:
                tell(f"a reply must be Enter, s, q, or r once, got {reply.strip()[:20]!r}")
    return found


def _check_moved(file: PositionsFile, place: WiredSensor, found: MeasuredResponses) -> None:
    """Raise InputError for a response that is that of another place."""
    own = found.responses.values[:, 0]
    limit = max(_SAME, _OF_NOISE * float(np.median(found.std)))
    for other in file.desk.sensors:
        is_near = math.dist((place.x, place.y), (other.x, other.y)) < _APART
        before = file.values.get(other.name)
        if before is None or is_near or other.name == place.name:
            continue
        difference = float(np.linalg.norm(own - before) / np.linalg.norm(before))
        if difference < limit:
            raise InputError(
                f"response must differ from that at {other.name} by more than {100 * limit:.1f} %, "
                f"got {100 * difference:.1f} %: the sensor is still there; move it to {place.name}"
            )


def _line(place: WiredSensor, found: MeasuredResponses) -> str:
    noise = float(np.median(found.std))
    text = (
        f"{place.name}: coherence {np.median(found.coherence):.4f}, noise {100 * noise:.2f} % of "
        "the response; kept"
    )
    if noise > _NOISY:
        text += "; it is noisy: raise --periods in another measurement"
    return text


def _span(frequencies: FloatArray) -> str:
    return f"{len(frequencies)} from {frequencies[0]:g} to {frequencies[-1]:g} Hz"
