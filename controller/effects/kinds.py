"""Kinds of effects by name: `BUILT_IN_EFFECTS`, and effects of installed packages.

Each kind is a section of a layout with its parameters, and a run that follows one finger.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from typing import Annotated, ClassVar, Literal, Self

from pydantic import model_validator

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
from controller.effects.file_effect import File
from controller.play.intent import Pulse
from controller.sources.touch import Contact
from model.config.fields import Quantity
from model.config.units import ANGLE, LENGTH, LEVEL, SPEED, TIME
from model.errors import InputError
from model.finger import STRONG_DB_SL
from registry.plugins import PluginRegistry

RAMP_STEP_DB = 2.0
"""Step between levels of a ramp [dB], below the just noticeable difference."""

_HYSTERESIS = 0.0005  # m; a finger has passed a detent once it is this far beyond it
_ANGLE_HYSTERESIS = 0.02  # rad; of a detent, or _HYSTERESIS along the circle if that is more
_DEGREES_15 = 0.26179938779914946  # rad; as converted from a file
_CENTRE_RADIUS = 0.006  # m; closer to the center, the angle of a finger is noise

_SPEED_WINDOW = 0.060  # s; averaging time of the speed: panels report 60 to 200 times a second
_REST_TIMEOUT = 0.080  # s; after this time without movement a finger is at rest
_LEVEL_STEP = 2.0  # dB; between levels, so that not every touch report causes a command
_LEVEL_HYSTERESIS = 1.5  # dB; the level changes when the speed calls for a level this far away
_MIN_REPORT_INTERVAL = 0.002  # s; no panel is faster
_NOISE = 0.0002  # m; movement below it is sensor noise


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
        distance = self._coordinate(contact) - self._middle
        passed = math.floor((abs(distance) - self._hysteresis) / self._spacing + 0.5)
        if passed > 0:
            self._middle += math.copysign(passed * self._spacing, distance)
            self._pulse = Pulse(self._duration, now)
        return self.resting(now)

    def resting(self, now: float) -> EffectStimulus | NoStimulus:
        """Return the remainder of the last click, without a further notch."""
        if self._pulse is not None and now < self._pulse.end:
            return EffectStimulus(self._level, until=self._pulse.end, pulse=self._pulse)
        return NoStimulus()


class Detents(Effect):
    """A click at each detent that the finger passes along x or y.

    The finger comes down halfway between two detents.
    """

    kind: ClassVar[str] = "detents"
    is_for_motion: ClassVar[bool] = True
    motion_condition: ClassVar[str] = "as the finger passes a detent"

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


class Dial(Effect):
    """A click at each detent that the finger passes in angle about the center of its region.

    The finger comes down halfway between two detents. Near the center nothing is felt.
    """

    kind: ClassVar[str] = "dial"
    is_for_motion: ClassVar[bool] = True
    motion_condition: ClassVar[str] = "as the finger passes a detent"
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
        return _DialRun(self, None if region is None else region.shape.center, level_db_sl)


class _DialRun(EffectRun):
    """Clicks by the angle of one finger around a center; none without a center."""

    def __init__(
        self, dial: Dial, center: tuple[float, float] | None, level_db_sl: float | None
    ) -> None:
        self._dial = dial
        self._center = center
        self._level = level_db_sl
        self._angle = 0.0  # [rad], including full turns
        self._last_direction: float | None = None  # [rad] within one turn; None if unknown
        self._notches: NotchesRun | None = None

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return a click after each passed notch."""
        if self._center is None:
            return NoStimulus()
        center_x, center_y = self._center
        x = contact.x - center_x
        y = contact.y - center_y
        radius = math.hypot(x, y)
        if radius < _CENTRE_RADIUS:
            self._last_direction = None  # the finger can leave the center at any angle
            return NoStimulus() if self._notches is None else self._notches.resting(now)
        direction = math.atan2(y, x)
        if self._last_direction is not None:
            self._angle += math.remainder(direction - self._last_direction, math.tau)
        self._last_direction = direction
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
        end_level = STRONG_DB_SL if level_db_sl is None else level_db_sl
        span = end_level - self.start_level
        max_count = int(self.duration / MIN_EFFECT_DURATION) - 1
        count = max(1, min(round(abs(span) / RAMP_STEP_DB), max_count))
        levels: list[float | None] = []
        for index in range(count):
            levels.append(self.start_level + span * index / count)
        levels.append(level_db_sl)
        pulse = Pulse(self.duration, now, is_raised=False)
        return _RampRun(pulse, tuple(levels), self.duration / len(levels), self.hold)

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


class Texture(Effect):
    """A vibration that grows with the logarithm of the finger's speed.

    Nothing is felt at rest.
    """

    kind: ClassVar[str] = "texture"
    is_for_motion: ClassVar[bool] = True

    slow: Annotated[float, Quantity(SPEED, above=0, at_most=1)] = 0.01
    """Speed below which nothing is felt."""

    fast: Annotated[float, Quantity(SPEED, above=0, at_most=5)] = 0.20
    """Speed at which `level` is reached; above `slow`."""

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
        self._path = deque([(now, contact.x, contact.y)])  # times [s] and positions [m]
        self._attenuation: float | None = None  # below the level at `fast` [dB]

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return the level for the mean speed over the last 60 ms."""
        last_time, x, y = self._path[-1]
        if math.dist((contact.x, contact.y), (x, y)) >= _NOISE:
            if now - last_time >= _REST_TIMEOUT:  # at rest at this position until now
                self._path = deque([(now - _SPEED_WINDOW, x, y)])
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
        positions = [(x, y) for _, x, y in self._path]
        positions.append((contact.x, contact.y))
        distance = sum(math.dist(start, end) for start, end in pairwise(positions))
        start_time = self._path[0][0]
        return distance / max(now - start_time, _MIN_REPORT_INTERVAL)

    def _level_at(self, speed: float) -> float | None:
        """Return the level [dB SL] of a speed [m/s], linear in log speed, in steps of 2 dB."""
        if self._level is None:
            return None
        slow = self._texture.slow
        fast = self._texture.fast
        fraction = math.log(min(speed, fast) / slow) / math.log(fast / slow)
        attenuation = (1 - fraction) * self._texture.range
        if self._attenuation is None or abs(attenuation - self._attenuation) > _LEVEL_HYSTERESIS:
            self._attenuation = round(attenuation / _LEVEL_STEP) * _LEVEL_STEP
        return self._level - self._attenuation


BUILT_IN_EFFECTS: tuple[type[Effect], ...] = (Buzz, Click, Detents, Dial, File, Ramp, Texture)
"""Built-in kinds of effects."""

_KINDS: PluginRegistry[type[Effect]] = PluginRegistry(
    "kind of effect",
    "era_haptics.effects",
    Effect,
    error=InputError,
    own={effect.kind: effect for effect in BUILT_IN_EFFECTS},
    called=attrgetter("kind"),
)


def effect_kinds() -> tuple[str, ...]:
    """Return the names of all kinds, built-in kinds first, without loading any plug-in."""
    return _KINDS.names()


def effect_kind(name: str) -> type[Effect]:
    """Return the kind of this name; raises InputError if unknown or if its plug-in fails."""
    return _KINDS.find(name)
