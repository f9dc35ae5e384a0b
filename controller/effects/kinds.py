"""Kinds of effects by name: `BUILT_IN_EFFECTS`, and effects of installed packages.

Each kind is a section of a layout with its parameters, and a run that follows one finger.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from controller.content.formats import named_content, named_contents, read_content
from controller.content.pattern import Pattern
from controller.content.rendition import CLICK_DURATION, Rendition, Tap, rendered
from controller.effects.effect import (
    DB_SL,
    MAX_EFFECT_DURATION,
    MIN_EFFECT_DURATION,
    Effect,
    EffectRun,
    EffectStimulus,
    Modulation,
    NoStimulus,
    Region,
    SteadyRun,
)
from controller.play.intent import MAX_DB_SL, Pulse
from controller.sources.touch import Contact
from model.arrays import FloatArray
from model.config.fields import Quantity
from model.config.units import ANGLE, LENGTH, LEVEL, SPEED, TIME
from model.errors import InputError
from model.finger import STRONG_DB_SL
from registry.plugins import PluginRegistry


class Buzz(Effect):
    """A vibration that lasts as long as the finger stays, or for a duration."""

    kind: ClassVar[str] = "buzz"
    is_for_motion: ClassVar[bool] = False
    needs_entry: ClassVar[bool] = False

    duration: (
        Annotated[float, Quantity(TIME, at_least=MIN_EFFECT_DURATION, at_most=MAX_EFFECT_DURATION)]
        | None
    ) = None
    """None: as long as the finger stays."""

    modulation: Modulation = None
    """Modulation frequency; none: steady."""

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start a steady vibration."""
        pulse = None if self.duration is None else Pulse(self.duration, now)
        return SteadyRun(level_db_sl, pulse, self.modulation)

    @property
    def has_end(self) -> bool:
        """True with a duration."""
        return self.duration is not None


class Click(Effect):
    """One short vibration."""

    kind: ClassVar[str] = "click"
    is_for_motion: ClassVar[bool] = False
    needs_entry: ClassVar[bool] = False

    duration: Annotated[float, Quantity(TIME, at_least=MIN_EFFECT_DURATION, at_most=0.5)] = 0.040
    """The plate needs 20 ms to follow."""

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start a vibration of its duration."""
        return SteadyRun(level_db_sl, Pulse(self.duration, now))


_HYSTERESIS = 0.0005  # m; a finger has passed a detent once it is this far beyond it


class NotchesRun(EffectRun):
    """Clicks of a duration [s] at equal distances along a coordinate of one finger.

    The finger starts halfway between two notches, and passes a notch once it is beyond it by the
    hysteresis.
    """

    def __init__(
        self,
        contact: Contact,
        coordinate: Callable[[Contact], float],
        *,
        spacing: float,
        hysteresis: float,
        duration: float,
        level_db_sl: float | None,
    ) -> None:
        self._coordinate = coordinate
        self._middle = coordinate(contact)  # of the two notches around the finger
        self._spacing = spacing
        self._hysteresis = hysteresis
        self._duration = duration
        self._level = level_db_sl
        self._pulse: Pulse | None = None  # of the last notch

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus:
        """Return a click after each passed notch; several in one step are one click."""
        away = self._coordinate(contact) - self._middle
        passed = math.floor((abs(away) - self._hysteresis) / self._spacing + 0.5)
        if passed > 0:
            self._middle += math.copysign(passed * self._spacing, away)
            self._pulse = Pulse(self._duration, now)
        return self.resting(now)

    def resting(self, now: float) -> EffectStimulus | NoStimulus:
        """Return the rest of the last click, without a further notch."""
        if self._pulse is not None and now < self._pulse.end:
            return EffectStimulus(self._level, until=self._pulse.end, pulse=self._pulse)
        return NoStimulus()


class Detents(Effect):
    """A click at each detent that the finger passes along x or y.

    The finger comes down halfway between two of them.
    """

    kind: ClassVar[str] = "detents"
    is_for_motion: ClassVar[bool] = True

    spacing: Annotated[float, Quantity(LENGTH, at_least=0.002, at_most=0.2)] = 0.010
    """Distance between detents."""

    along: Literal["x", "y"] = "x"
    """Direction of the spacing."""

    duration: Annotated[float, Quantity(TIME, at_least=MIN_EFFECT_DURATION, at_most=0.2)] = 0.030
    """Duration of each click."""

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start halfway between two detents."""
        return NotchesRun(
            contact,
            attrgetter(self.along),
            spacing=self.spacing,
            hysteresis=_HYSTERESIS,
            duration=self.duration,
            level_db_sl=level_db_sl,
        )


_ANGLE_HYSTERESIS = 0.02  # rad; of a detent, or _HYSTERESIS along the circle if that is more
_DEGREES_15 = 0.26179938779914946  # rad; as converted from a file
_CENTRE_RADIUS = 0.006  # m; closer to the centre, the angle of a finger is noise


class Dial(Effect):
    """A click at each detent that the finger passes in angle about the centre of its region.

    The finger comes down halfway between two detents. Near the centre nothing is felt.
    """

    kind: ClassVar[str] = "dial"
    is_for_motion: ClassVar[bool] = True
    needs_region: ClassVar[bool] = True

    spacing: Annotated[float, Quantity(ANGLE, at_least=0.05, at_most=3.2)] = _DEGREES_15
    """Angle between detents."""

    duration: Annotated[float, Quantity(TIME, at_least=MIN_EFFECT_DURATION, at_most=0.2)] = 0.030
    """Duration of each click."""

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start outside all regions: nothing is felt."""
        return self.start_in(None, contact, now, level_db_sl=level_db_sl)

    def start_in(
        self, region: Region | None, contact: Contact, now: float, *, level_db_sl: float | None
    ) -> EffectRun:
        """Start halfway between two detents."""
        return _DialRun(self, None if region is None else region.shape.centre, level_db_sl)


class _DialRun(EffectRun):
    """Clicks by the angle of one finger around a centre; none without a centre."""

    def __init__(
        self, dial: Dial, centre: tuple[float, float] | None, level_db_sl: float | None
    ) -> None:
        self._dial = dial
        self._centre = centre
        self._level = level_db_sl
        self._angle = 0.0  # [rad], including full turns
        self._last: float | None = None  # [rad] within one turn; None before the first
        self._notches: NotchesRun | None = None

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return a click after each passed notch."""
        if self._centre is None:
            return NoStimulus()
        x, y = contact.x - self._centre[0], contact.y - self._centre[1]
        radius = math.hypot(x, y)
        if radius < _CENTRE_RADIUS:
            self._last = None  # the finger can leave the centre at any angle
            return NoStimulus() if self._notches is None else self._notches.resting(now)
        angle = math.atan2(y, x)
        if self._last is not None:
            self._angle += math.remainder(angle - self._last, math.tau)
        self._last = angle
        if self._notches is None:
            self._notches = NotchesRun(
                contact,
                lambda _: self._angle,
                spacing=self._dial.spacing,
                hysteresis=max(_ANGLE_HYSTERESIS, _HYSTERESIS / radius),
                duration=self._dial.duration,
                level_db_sl=self._level,
            )
        return self._notches.feel(contact, now)


RAMP_STEP_DB = 2.0
"""Step between levels of a ramp [dB], below the just noticeable difference."""


class Ramp(Effect):
    """A change from one level to another in steps of 2 dB, optionally held at the end."""

    kind: ClassVar[str] = "ramp"
    is_for_motion: ClassVar[bool] = False

    start_level: Annotated[float, DB_SL] = 6.0
    """First level, in dB SL; the last one is `level`."""

    duration: Annotated[float, Quantity(TIME, at_least=0.1, at_most=MAX_EFFECT_DURATION)] = 1.0
    """Time from the first level to the last."""

    hold: bool = False
    """Whether to hold the last level."""

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start at the first level, with steps of 2 dB, or larger ones if these were too short."""
        end = STRONG_DB_SL if level_db_sl is None else level_db_sl
        span = end - self.start_level
        count = max(
            1, min(round(abs(span) / RAMP_STEP_DB), int(self.duration / MIN_EFFECT_DURATION) - 1)
        )
        rise = [self.start_level + span * index / count for index in range(count)]
        levels = (*rise, level_db_sl)
        pulse = Pulse(self.duration, now, is_raised=False)
        return _RampRun(pulse, levels, self.duration / len(levels), self.hold)

    @property
    def has_end(self) -> bool:
        """True unless it holds its last level."""
        return not self.hold

    def max_db_sl(self, level_db_sl: float | None) -> float:
        """Return the higher of the first and the last level."""
        return max(self.start_level, super().max_db_sl(level_db_sl))


@dataclass(frozen=True)
class _RampRun(EffectRun):
    """Levels [dB SL] in equal time steps [s] from the start; the last one can be held."""

    pulse: Pulse
    levels: tuple[float | None, ...]
    step: float
    is_held: bool

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return the level of the current step."""
        index = max(0, int((now - self.pulse.start) / self.step))
        if index >= len(self.levels) - 1 and self.is_held:
            return EffectStimulus(self.levels[-1])
        if index >= len(self.levels):
            return None
        until = self.pulse.start + (index + 1) * self.step
        pulse = None if self.is_held else self.pulse
        return EffectStimulus(self.levels[index], until, pulse=pulse)


_SPEED_WINDOW = 0.060  # s; averaging time of the speed: panels report 60 to 200 times a second
_REST_TIMEOUT = 0.080  # s; after this time without movement a finger is at rest
_LEVEL_STEP = 2.0  # dB; between levels, so that not every touch report causes a command
_LEVEL_HYSTERESIS = 1.5  # dB; the level changes when the speed calls for a level this far away
_MIN_REPORT_INTERVAL = 0.002  # s; no panel is faster
_NOISE = 0.0002  # m; movement below it is sensor noise


class Texture(Effect):
    """A vibration that grows with the logarithm of the finger's speed.

    Nothing is felt at rest.
    """

    kind: ClassVar[str] = "texture"
    is_for_motion: ClassVar[bool] = True

    slow: Annotated[float, Quantity(SPEED, above=0, at_most=1)] = 0.01
    """Speed below which nothing is felt."""

    fast: Annotated[float, Quantity(SPEED, above=0, at_most=5)] = 0.20
    """Speed that reaches `level`; above `slow`."""

    range: Annotated[float, Quantity(LEVEL, at_least=0, at_most=40)] = 14.0
    """Attenuation in dB below `level` at `slow`."""

    modulation: Modulation = None
    """Modulation frequency, same as for `buzz`."""

    @model_validator(mode="after")
    def _check_speeds(self) -> Self:
        if self.fast <= self.slow:
            raise ValueError(
                f"fast must be above slow, which is {self.slow:g} m/s, got {self.fast:g} m/s"
            )
        return self

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start from rest."""
        return _TextureRun(self, contact, now, level_db_sl)


class _TextureRun(EffectRun):
    """Level from the speed of one finger along its path."""

    def __init__(
        self, texture: Texture, contact: Contact, now: float, level_db_sl: float | None
    ) -> None:
        self._texture = texture
        self._level = level_db_sl
        self._path = deque([(now, contact.x, contact.y)])
        self._attenuation: float | None = None  # below the level at `fast` [dB]

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return the level for the mean speed over the last 60 ms."""
        before, *position = self._path[-1]
        if math.dist((contact.x, contact.y), position) >= _NOISE:
            if now - before >= _REST_TIMEOUT:  # at rest at this position until now
                self._path = deque([(now - _SPEED_WINDOW, position[0], position[1])])
            self._path.append((now, contact.x, contact.y))
        while len(self._path) > 2 and now - self._path[1][0] >= _SPEED_WINDOW:
            self._path.popleft()
        rests_from = self._path[-1][0] + _REST_TIMEOUT
        if now >= rests_from:
            return NoStimulus()
        speed = self._speed(contact, now)
        if speed < self._texture.slow:
            return NoStimulus(until=rests_from)
        return EffectStimulus(
            self._level_at(speed),
            until=rests_from,
            modulation_hz=self._texture.modulation,
        )

    def _speed(self, contact: Contact, now: float) -> float:
        """Return the mean speed [m/s] along the stored path up to the finger."""
        positions = [*((x, y) for _, x, y in self._path), (contact.x, contact.y)]
        distance = sum(math.dist(one, after) for one, after in pairwise(positions))
        return distance / max(now - self._path[0][0], _MIN_REPORT_INTERVAL)

    def _level_at(self, speed: float) -> float | None:
        """Return the level [dB SL] of a speed [m/s], linear in log speed, in steps of 2 dB."""
        if self._level is None:
            return None
        slow, fast = self._texture.slow, self._texture.fast
        fraction = math.log(min(speed, fast) / slow) / math.log(fast / slow)
        attenuation = (1 - fraction) * self._texture.range
        if self._attenuation is None or abs(attenuation - self._attenuation) > _LEVEL_HYSTERESIS:
            self._attenuation = round(attenuation / _LEVEL_STEP) * _LEVEL_STEP
        return self._level - self._attenuation


_FREQUENCIES = tuple(float(each) for each in range(40, 501, 10))  # Hz; until a table is known


class File(Effect):
    """A file in the layout's folder, or a built-in content, played once or in a loop."""

    kind: ClassVar[str] = "file"
    is_for_motion: ClassVar[bool] = False

    file: Annotated[str, Field(min_length=1, max_length=255)]
    """Path inside the layout's folder, or the name of a built-in content."""

    loop: bool = False
    """Whether to repeat it for as long as the finger stays."""

    channel: Annotated[int, Field(ge=1, le=64)] | None = None
    """Channel of a file with several channels; the first by default."""

    _pattern: Pattern = PrivateAttr(default=Pattern(0.0))
    _frequencies: tuple[float, ...] = PrivateAttr(default=_FREQUENCIES)

    @classmethod
    def of(cls, pattern: Pattern, *, name: str, level_db_sl: float, loop: bool = False) -> Self:
        """Make an effect from a pattern."""
        effect = cls.model_construct({"level"}, file=name, level=level_db_sl, loop=loop)
        effect._pattern = pattern
        return effect

    def read(self, folder: Path) -> None:
        """Read the file; raises InputError, also for a file outside the folder."""
        if self.file in named_contents():
            self._pattern = _named(self.file)
            return
        try:
            path = (folder / self.file).resolve()
        except (OSError, RuntimeError, ValueError) as error:  # circular links, or not a file name
            raise InputError(f"file must name a file, got {self.file!a}: {error}") from error
        if not path.is_relative_to(folder.resolve()):
            raise InputError(
                f"file must be in the folder of the layout, got {self.file}; copy it there"
            )
        self._pattern = read_content(path, self.channel) if path.suffix else _named(self.file)

    def for_table(self, frequencies: FloatArray) -> Self:
        """Return an unprepared copy for the frequencies of a table [Hz]."""
        effect = self.model_copy()
        effect._frequencies, effect._rendered = tuple(frequencies.tolist()), {}
        return effect

    @cached_property
    def _rendered(self) -> dict[float | None, tuple[Rendition, Rendition]]:
        """Renditions by level; excluded from comparisons."""
        return {}

    def is_prepared(self, level_db_sl: float | None) -> bool:
        """Whether it is rendered at a level."""
        return level_db_sl in self._rendered

    def prepare(self, level_db_sl: float | None) -> tuple[Rendition, Rendition]:
        """Render it at a level, for a single finger and for one among others.

        Renditions cannot be scaled: the faintest intensity has the same level in all of them.
        """
        if level_db_sl not in self._rendered:
            level = MAX_DB_SL if level_db_sl is None else level_db_sl
            alone = rendered(self._pattern, level, np.array(self._frequencies))
            self._rendered[level_db_sl] = alone, alone.smoothed()
        return self._rendered[level_db_sl]

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start at the beginning."""
        alone, among = self.prepare(level_db_sl)
        return _FileRun(alone, among, now, loop=self.loop, is_limit=level_db_sl is None)

    @property
    def has_end(self) -> bool:
        """True unless it repeats."""
        return not self.loop


def named_effects(level_db_sl: float = STRONG_DB_SL) -> dict[str, File]:
    """Return an effect for each named content, at a level."""
    return {
        each: File.of(_named(each), name=each, level_db_sl=level_db_sl) for each in named_contents()
    }


@lru_cache
def _named(name: str) -> Pattern:
    return read_content(named_content(name))


class _FileRun(EffectRun):
    """A rendition played from a time [s]: its continuous part, and its clicks in order."""

    def __init__(
        self, alone: Rendition, among: Rendition, now: float, *, loop: bool, is_limit: bool
    ) -> None:
        self._pulse = Pulse(math.inf if loop else alone.duration, now, is_raised=False)
        self._alone, self._among, self._is_limit = alone, among, is_limit
        among_others = self._lasting_of(among, None)
        self._lasting = self._lasting_of(alone, among_others)
        self._started = 0  # number of clicks
        self._click: EffectStimulus | None = None

    def _lasting_of(
        self, rendition: Rendition, among_others: EffectStimulus | None
    ) -> EffectStimulus | None:
        if rendition.course is None:
            return None
        return EffectStimulus(
            None if self._is_limit else rendition.level_db_sl,
            pulse=self._pulse,
            course=rendition.course,
            band=rendition.band,
            among_others=among_others,
        )

    def _click_of(
        self, tap: Tap, pulse: Pulse, among_others: EffectStimulus | None
    ) -> EffectStimulus:
        return EffectStimulus(
            None if self._is_limit else tap.level_db_sl,
            pulse=pulse,
            band=tap.band,
            is_absolute=True,
            among_others=among_others,
        )

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return the continuous part, and the click that is due, if any."""
        if now >= self._pulse.end:
            return None
        while now >= self._next_click():
            number = self._started % len(self._alone.clicks)
            self._started += 1
            pulse = Pulse(CLICK_DURATION, now)
            among_others = self._click_of(self._among.clicks[number], pulse, None)
            self._click = self._click_of(self._alone.clicks[number], pulse, among_others)
        until = min(self._next_click(), self._pulse.end)
        if self._click is not None and self._click.pulse is not None:
            if now < self._click.pulse.end:
                until = min(until, self._click.pulse.end)
            else:
                self._click = None
        wakes = until if until < math.inf else None
        if self._lasting is not None:
            return replace(self._lasting, until=wakes, click=self._click)
        return NoStimulus(wakes) if self._click is None else replace(self._click, until=wakes)

    def _next_click(self) -> float:
        """Start time [s] of the next click; infinite for none."""
        found, count = self._alone, len(self._alone.clicks)
        if not count or (self._started >= count and self._pulse.duration < math.inf):
            return math.inf
        turns, number = divmod(self._started, count)
        return self._pulse.start + turns * found.duration + found.clicks[number].time


BUILT_IN_EFFECTS: tuple[type[Effect], ...] = (Buzz, Click, Detents, Dial, File, Ramp, Texture)
"""Built-in kinds of effects."""

_KINDS: PluginRegistry[type[Effect]] = PluginRegistry(
    "kind of effect",
    "era_haptics.effects",
    Effect,
    error=InputError,
    own={each.kind: each for each in BUILT_IN_EFFECTS},
    called=attrgetter("kind"),
)


def effect_kinds() -> tuple[str, ...]:
    """Return the names of all kinds, built-in kinds first, without loading any plug-in."""
    return _KINDS.names()


def effect_kind(name: str) -> type[Effect]:
    """Return the kind of this name; raises InputError if unknown or if its plug-in fails."""
    return _KINDS.find(name)
