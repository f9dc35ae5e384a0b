"""Effects: layout parameters, runs at one finger, and the regions that contain them."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeAlias

from pydantic import Strict, model_validator

from controller.play.intent import Band, Pulse, Target
from controller.sources.touch import Contact, ContactKey
from model.answer.envelope import Course
from model.answer.stimulus import MAX_LEVEL_DB_SL, MAX_MODULATION, MIN_MODULATION
from model.arrays import FloatArray
from model.config.fields import Quantity, Section
from model.config.shapes import RegionShape
from model.config.units import FREQUENCY, LEVEL
from model.finger import STRONG_DB_SL

ON_MOVE = "on_move"
ON_RELEASE = "on_release"
USES = ("on_press", ON_MOVE, ON_RELEASE)
"""Keys of a region's effects."""


@dataclass(frozen=True)
class Region:
    """A region of the plate and the names of its effects."""

    name: str
    shape: RegionShape
    on_press: str | None = None
    """Effect when a finger comes down or slides in."""
    on_move: str | None = None
    """Effect while a finger moves inside."""
    on_release: str | None = None
    """Effect when a finger slides out."""
    level_db_sl: float | None = None
    """Replaces the level of the effects if has_level."""
    has_level: bool = False
    priority: int = 0
    """Effects of lower priority yield first."""
    band: Band | None = None
    """Replaces the band of the effects unless None."""
    is_own: bool = False
    """Whether a finger here feels either its own content or nothing."""
    may_share: bool = False
    """Whether a finger here can share the content of another finger that can share."""
    is_protected: bool = False
    """Whether to play nothing elsewhere that a finger here would notice."""

    def as_json(self) -> dict[str, Any]:
        """Return the region in the format of the API."""
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


NEIGHBORS: Literal["neighbours"] = "neighbours"
"""Level name: as strong as the neighbors allow."""

MIN_DB_SL = -20.0
"""Lowest level of an effect [dB SL]."""

DEFAULT_MAX_DB_SL = 40.0
"""Default of a layout for the highest level of its effects [dB SL]."""

DB_SL = Quantity(LEVEL, at_least=MIN_DB_SL, at_most=MAX_LEVEL_DB_SL)
"""A level of an effect."""

MIN_EFFECT_DURATION = 0.020
"""The plate needs about 20 ms to respond (docs/concepts/transients.md); less is not felt [s]."""

MAX_EFFECT_DURATION = 10.0

Modulation: TypeAlias = (
    Annotated[float, Quantity(FREQUENCY, at_least=MIN_MODULATION, at_most=MAX_MODULATION)] | None
)
"""Frequency [Hz] at which a vibration comes and goes; None for a steady one."""

Level: TypeAlias = Annotated[float | Literal["neighbours"], replace(DB_SL, word=NEIGHBORS)]
"""dB above the detection threshold, or `neighbours`."""


@dataclass(frozen=True, slots=True)
class EffectStimulus:
    """Stimulus of an effect at one finger, from now on."""

    level_db_sl: float | None
    """None for as strong as the neighbors allow."""
    until: float | None = None
    """Time [s] when the stimulus can change without the finger moving; None for never."""
    pulse: Pulse | None = None
    """Set for a vibration of limited duration, which the amplifiers end on their own."""
    modulation_hz: float | None = None
    """Modulation frequency [Hz], 10 to 30; None for a steady vibration. Pulses below 0.2 s are
    steady."""
    course: Course | None = field(default=None, repr=False)
    """Envelope, repeated over the pulse; the level is felt where it is 1."""
    band: Band | None = None
    """Its own frequencies, if the layout gives none."""
    click: "EffectStimulus | None" = None
    """Short pulse felt in addition."""
    is_absolute: bool = False
    """Whether a short pulse keeps this level regardless of a continuous effect at the finger."""
    among_others: "EffectStimulus | None" = None
    """Replacement while other fingers are on the plate; None: unchanged."""

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

        effect: name of the effect; band: given by the layout, None for its own; above_db: minimum
        level of a short pulse above a continuous effect there.
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
        """Whether it is a short pulse, felt in addition to a continuous stimulus."""
        return self.pulse is not None and self.pulse.is_short and self.course is None


@dataclass(frozen=True, slots=True)
class NoStimulus:
    """Silence at one finger; until: see `EffectStimulus`."""

    until: float | None = None


class EffectRun(ABC):
    """One run of an effect at one finger, from its start."""

    @abstractmethod
    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return the stimulus of the finger at a time [s]; None once the run is over.

        Called in order of time: after every change of the contact, and at `until`.
        """


@dataclass(frozen=True)
class SteadyRun(EffectRun):
    """A steady level for one pulse; without a pulse, as long as the finger stays."""

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
    """A section with an optional frequency or band."""

    frequency: _FREQUENCY | None = None
    band: Annotated[tuple[_FREQUENCY, _FREQUENCY], Strict(strict=False)] | None = None

    @model_validator(mode="after")
    def _check_band(self) -> Self:
        if self.band is None:
            return self
        if self.frequency is not None:
            raise ValueError("must have frequency or band, got both; remove one")
        low, high = self.band
        if low >= high:
            raise ValueError(
                f"band must be a lower and a higher frequency, got {low:g} Hz and {high:g} Hz"
            )
        return self

    @property
    def tuned_band(self) -> Band | None:
        """The band, or a band of the frequency alone; None if unrestricted."""
        if self.frequency is None:
            return self.band
        return self.frequency, self.frequency


class Effect(TunedSection, ABC):
    """Parameters of an effect; each kind of effect is a subclass."""

    kind: ClassVar[str]
    """Its name in layouts."""
    is_for_motion: ClassVar[bool]
    """Whether it follows a moving finger and belongs under `on_move`."""
    motion_condition: ClassVar[str] = "while the finger moves"
    """When a motion effect is felt, for the reason of a finger that feels nothing."""
    needs_region: ClassVar[bool] = False
    """Whether it works only in regions."""
    needs_entry: ClassVar[bool] = True
    """Whether a layout must define it; built-in kinds that need no entry are in every layout."""

    level: Level = STRONG_DB_SL

    @abstractmethod
    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start a run at a finger at a time [s]; level None: as strong as the neighbors allow."""

    def start_in(
        self, region: Region | None, contact: Contact, now: float, *, level_db_sl: float | None
    ) -> EffectRun:
        """Start a run in a region, or outside all; overridden by kinds that need the region."""
        return self.start(contact, now, level_db_sl=level_db_sl)

    def read(self, folder: Path) -> None:
        """Read its files from the folder of its layout; raises InputError."""

    def for_table(self, frequencies: FloatArray) -> Self:
        """Return the effect for the frequencies of a table [Hz]."""
        return self

    def is_prepared(self, level_db_sl: float | None) -> bool:
        """Whether a start at a level takes no time; otherwise, `prepare` it first."""
        return True

    def prepare(self, level_db_sl: float | None) -> object:
        """Prepare a slow start at a level; called outside the control loop."""

    def gives_level_in(self, region: Region | None) -> bool:
        """Whether its layout sets its level, in a region or outside all."""
        has_region_level = region is not None and region.has_level
        return has_region_level or "level" in self.model_fields_set

    def band_in(self, region: Region | None) -> Band | None:
        """Return its band [Hz] in a region, or outside all; None: any."""
        if region is None or region.band is None:
            return self.tuned_band
        return region.band

    @property
    def has_end(self) -> bool:
        """Whether it ends on its own, so that it can be played without another end."""
        return True

    @property
    def level_db_sl(self) -> float | None:
        """Its level; None for as strong as the neighbors allow."""
        return None if isinstance(self.level, str) else self.level

    def max_db_sl(self, level_db_sl: float | None) -> float:
        """Return the highest level [dB SL] in a run at a level; infinite for None."""
        return math.inf if level_db_sl is None else level_db_sl
