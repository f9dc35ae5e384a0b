"""Effects: their parameters in a layout, their runs at one finger, and the regions they play in."""

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
from model.config.fields import Quantity, RegionShape, Section
from model.config.units import FREQUENCY, LEVEL
from model.finger import STRONG_DB_SL

ON_PRESS, ON_MOVE, ON_RELEASE = USES = ("on_press", "on_move", "on_release")
"""Keys of a region's effects."""


@dataclass(frozen=True)
class Region:
    """A region of the plate and the names of its effects; a finger that lifts feels none."""

    name: str
    shape: RegionShape
    on_press: str | None = None
    """Effect when a finger comes down or slides in."""
    on_move: str | None = None
    """Effect while it moves within."""
    on_release: str | None = None
    """Effect when it slides out."""
    level_db_sl: float | None = None
    """Replaces the level of the effects if has_level."""
    has_level: bool = False
    priority: int = 0
    """Effects of lower priority give way first."""
    band: Band | None = None
    """Replaces the band of the effects unless None."""
    is_own: bool = False
    """Whether a finger in it feels its own content or none."""
    may_share: bool = False
    """Whether it may also feel the content of any other finger that may share."""
    is_protected: bool = False
    """Whether no content is played elsewhere that a finger in it would notice."""

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

MIN_EFFECT_DURATION = 0.020
"""The plate needs about 20 ms to respond (docs/concepts/transients.md); less is not felt [s]."""

MAX_EFFECT_DURATION = 10.0

Modulation: TypeAlias = (
    Annotated[float, Quantity(FREQUENCY, at_least=MIN_MODULATION, at_most=MAX_MODULATION)] | None
)
"""Frequency [Hz] at which a vibration comes and goes; None for a steady one."""

Level: TypeAlias = Annotated[float | Literal["neighbours"], replace(DB_SL, word=NEIGHBOURS)]
"""dB above the detection threshold, or `neighbours`."""


@dataclass(frozen=True, slots=True)
class EffectStimulus:
    """What one finger shall feel of an effect from now on."""

    level_db_sl: float | None
    """None for as strong as the neighbours allow."""
    until: float | None = None
    """When [s] the stimulus may change though the finger does nothing; None for never."""
    pulse: Pulse | None = None
    """Set for a vibration of limited duration, which the amplifiers end by themselves."""
    modulation_hz: float | None = None
    """Frequency [Hz] at which its strength comes and goes, 10 to 30; None for a steady one. Pulses
    below 0.2 s are steady."""
    course: Course | None = field(default=None, repr=False)
    """Course of its strength, again and again over the pulse; the level is felt where it is 1."""
    band: Band | None = None
    """Its own frequencies, where the layout gives none."""
    click: "EffectStimulus | None" = None
    """Short pulse that is felt beside it."""
    is_absolute: bool = False
    """Whether a short pulse has the level given here whatever lasts at the finger."""
    among_others: "EffectStimulus | None" = None
    """Replaces it while other fingers are on the plate; None: nothing does."""

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

        effect: name of the effect; band: given by the layout, None for its own; above_db: least
        level of a short pulse over what lasts there.
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
        """Whether it is a short pulse, which is felt beside a stimulus that lasts."""
        return self.pulse is not None and self.pulse.is_short and self.course is None


@dataclass(frozen=True, slots=True)
class NoStimulus:
    """Silence at one finger; until as in `EffectStimulus`."""

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
    """A steady level for one pulse, or as long as the finger stays if that is None."""

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
    """A section that may fix a frequency or a band."""

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
    """Parameters of an effect; each kind of effect is a subclass."""

    kind: ClassVar[str]
    """Its name in layouts."""
    is_for_motion: ClassVar[bool]
    """Whether it follows a moving finger and belongs under `on_move`; else it runs by itself."""
    needs_region: ClassVar[bool] = False
    """Whether it is felt in regions only."""
    needs_entry: ClassVar[bool] = True
    """Whether a layout must define it; kinds of the project that need no entry are in every
    layout."""

    level: Level = STRONG_DB_SL

    @abstractmethod
    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start a run at a finger, at a time [s]; level None: as strong as the neighbours allow."""

    def start_in(
        self, region: Region | None, contact: Contact, now: float, *, level_db_sl: float | None
    ) -> EffectRun:
        """Start a run in a region, or outside of all; overridden by kinds that depend on it."""
        return self.start(contact, now, level_db_sl=level_db_sl)

    def read(self, folder: Path) -> None:
        """Read the files that it names, from the folder of its layout; raises InputError."""

    def for_table(self, frequencies: FloatArray) -> Self:
        """Return the effect as it is played at the frequencies of a table [Hz]."""
        return self

    def is_prepared(self, level_db_sl: float | None) -> bool:
        """Whether a start at a level takes no time; else it is prepared first."""
        return True

    def prepare(self, level_db_sl: float | None) -> object:
        """Prepare a start at a level that would take time; called outside of the control loop."""

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
