"""Effects: their parameters in a layout, and their course at one finger.

A region of the plate and its effects.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeAlias

from pydantic import Strict, model_validator

from controller.play.intent import Band, Pulse, Target
from controller.sources.touch import Contact, ContactKey
from model.answer.stimulus import MAX_LEVEL_DB_SL, MAX_MODULATION, MIN_MODULATION, Course
from model.arrays import FloatArray
from model.config.fields import FREQUENCY, LEVEL, Quantity, Section, Shape
from model.finger import STRONG_DB_SL

ON_PRESS, ON_MOVE, ON_RELEASE = USES = ("on_press", "on_move", "on_release")
"""Keys of a region's effects."""


@dataclass(frozen=True)
class Region:
    """A region of the plate and the names of its effects, None for none.

    on_press: when a finger comes down or slides in; on_move: while it moves within; on_release:
    when it slides out. A finger that lifts feels nothing. level_db_sl: replaces the level of the
    effects if has_level; band: their frequencies, if not None. priority: lower ones give way first.
    is_own: a finger in it feels its own content or none; may_share: it may feel that of any finger
    that may share, too; is_protected: no content that it would notice is played elsewhere.
    """

    name: str
    shape: Shape
    on_press: str | None = None
    on_move: str | None = None
    on_release: str | None = None
    level_db_sl: float | None = None
    has_level: bool = False
    priority: int = 0
    band: Band | None = None
    is_own: bool = False
    may_share: bool = False
    is_protected: bool = False

    def as_json(self) -> dict[str, Any]:
        """Return it as the API describes it."""
        return {
            "name": self.name,
            **self.shape.as_json(),
            "on_press": self.on_press,
            "on_move": self.on_move,
            "on_release": self.on_release,
            "priority": self.priority,
            "band_hz": None if self.band is None else [*self.band],
            "own": self.is_own,
            "may_share": self.may_share,
            "protected": self.is_protected,
        }


NEIGHBOURS: Literal["neighbours"] = "neighbours"
"""The level `as strong as the neighbours allow`."""

MIN_DB_SL, DEFAULT_MAX_DB_SL = -20.0, 40.0
"""Lowest level of an effect, and highest of a layout that does not raise it [dB SL]."""

DB_SL = Quantity(LEVEL, at_least=MIN_DB_SL, at_most=MAX_LEVEL_DB_SL)
"""A level of an effect."""


MIN_DURATION = 0.020
"""The plate needs about 20 ms to respond (docs/concepts/transients.md); less is not felt [s]."""

MAX_DURATION = 10.0


Modulation: TypeAlias = (
    Annotated[float, Quantity(FREQUENCY, at_least=MIN_MODULATION, at_most=MAX_MODULATION)] | None
)
"""How often a second a vibration comes and goes [Hz]; None for a steady one."""

Level: TypeAlias = Annotated[float | Literal["neighbours"], replace(DB_SL, word=NEIGHBOURS)]
"""dB above the detection threshold, or `neighbours`."""


@dataclass(frozen=True, slots=True)
class EffectStimulus:
    """Target of one finger from now on.

    level_db_sl: None for as strong as the neighbours allow. until: when [s] that may change though
    the finger does nothing; None for never. pulse: for a vibration of limited duration, which the
    amplifiers end by themselves. modulation_hz: how often a second its strength comes and goes, 10
    to 30; None for a steady one, as are pulses below 0.2 s. course: along which it is felt over its
    pulse, at the level where that is 1, and anew until the pulse ends; None for steadily. band: its
    own frequencies, where the layout says none. click: a short pulse that is felt beside it.
    is_absolute: whether a short pulse is as strong as its level says, whatever lasts there.
    among_others: what is felt instead while other fingers are on the plate; None: the same.
    """

    level_db_sl: float | None
    until: float | None = None
    pulse: Pulse | None = None
    modulation_hz: float | None = None
    course: Course | None = field(default=None, repr=False)
    band: Band | None = None
    click: "EffectStimulus | None" = None
    is_absolute: bool = False
    among_others: "EffectStimulus | None" = None

    def target(
        self,
        key: ContactKey,
        effect: str,
        region: Region | None,
        *,
        band: Band | None,
        priority: int,
        above_db: float | None = None,
    ) -> Target:
        """Return the target of a finger that feels it in a region, or outside of all.

        effect: its name; band: by the layout, None for its own; above_db: that a short pulse has
        over what lasts there.
        """
        is_raised = self.is_short and self.pulse is not None and self.pulse.is_raised
        return Target(
            key,
            self.level_db_sl,
            pulse=self.pulse,
            band=self.band if band is None else band,
            priority=priority,
            content=effect,
            is_own=region is not None and region.is_own,
            may_share=region is not None and region.may_share,
            modulation_hz=self.modulation_hz,
            above_db=above_db if is_raised and not self.is_absolute else None,
            course=self.course,
        )

    @property
    def is_short(self) -> bool:
        """Whether it is a short pulse, beside which another is felt that lasts."""
        return self.pulse is not None and self.pulse.is_short and self.course is None


@dataclass(frozen=True, slots=True)
class NoStimulus:
    """A finger shall feel nothing now; until as in `EffectStimulus`."""

    until: float | None = None


class EffectRun(ABC):
    """One run of an effect at one finger, from its start."""

    @abstractmethod
    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return what the finger shall feel at a time [s]; None once the run is over.

        Called in order of time: at every change of the contact and when `until` is reached.
        """


@dataclass(frozen=True)
class SteadyRun(EffectRun):
    """A level for one pulse, None for as long as the finger stays."""

    level_db_sl: float | None
    pulse: Pulse | None
    modulation_hz: float | None = None

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return the level until the end of the pulse."""
        end = None if self.pulse is None else self.pulse.end
        if end is not None and now >= end:
            return None
        return EffectStimulus(
            self.level_db_sl, until=end, pulse=self.pulse, modulation_hz=self.modulation_hz
        )


_FREQUENCY = Annotated[float, Quantity(FREQUENCY, at_least=10, at_most=1000)]


class TunedSection(Section):
    """A section that may fix the frequency, or the band that it is in."""

    frequency: _FREQUENCY | None = None
    band: Annotated[tuple[_FREQUENCY, _FREQUENCY], Strict(strict=False)] | None = None

    @model_validator(mode="after")
    def _check_band(self) -> Self:
        if self.band is None:
            return self
        if self.frequency is not None:
            raise ValueError("must have frequency or band, got both; remove one")
        if self.band[0] >= self.band[1]:
            low, high = self.band
            raise ValueError(
                f"band must be a lower and a higher frequency, got {low:g} Hz and {high:g} Hz"
            )
        return self

    @property
    def tuned_band(self) -> Band | None:
        """The band of its frequency; None where it is free."""
        return self.band if self.frequency is None else (self.frequency, self.frequency)


class Effect(TunedSection, ABC):
    """Parameters of an effect; each kind of effect is a subclass.

    kind: its name in layouts; is_for_motion: whether it follows a moving finger and belongs under
    `on_move`, or runs by itself; needs_region: whether it is felt in regions only; needs_entry:
    whether a layout defines it before it is used. Those of the project that need none exist in
    every layout.
    """

    kind: ClassVar[str]
    is_for_motion: ClassVar[bool]
    needs_region: ClassVar[bool] = False
    needs_entry: ClassVar[bool] = True

    level: Level = STRONG_DB_SL

    @abstractmethod
    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start at a finger, at a time [s]; level None for as strong as the neighbours allow."""

    def start_in(
        self, region: Region | None, contact: Contact, now: float, *, level_db_sl: float | None
    ) -> EffectRun:
        """Start in a region, or outside of all; for effects that depend on it."""
        return self.start(contact, now, level_db_sl=level_db_sl)

    def read(self, folder: Path) -> None:
        """Read what it names, from the folder of its layout; raises InputError."""

    def for_table(self, frequencies: FloatArray) -> Self:
        """Return it as it is played at the frequencies of a table [Hz]."""
        return self

    def is_prepared(self, level_db_sl: float | None) -> bool:
        """Whether a start at a level takes no time; else it is prepared first."""
        return True

    def prepare(self, level_db_sl: float | None) -> object:
        """Make what a start at a level would take time for; called outside of the control loop."""

    def gives_level_in(self, region: Region | None) -> bool:
        """Whether its layout gives it a level of its own, in a region or outside of all."""
        is_given = region is not None and region.has_level
        return is_given or "level" in self.model_fields_set

    def band_in(self, region: Region | None) -> Band | None:
        """Return its band [Hz] in a region, or outside of all; None: any."""
        return self.tuned_band if region is None or region.band is None else region.band

    @property
    def has_end(self) -> bool:
        """Whether it ends by itself, so that it can be played where nothing else would end it."""
        return True

    @property
    def level_db_sl(self) -> float | None:
        """Its level; None for as strong as the neighbours allow."""
        return None if isinstance(self.level, str) else self.level

    def max_db_sl(self, level_db_sl: float | None) -> float:
        """Return the highest level [dB SL] in a run at a level; infinite for None."""
        return math.inf if level_db_sl is None else level_db_sl
