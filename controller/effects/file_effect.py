"""Effects of content files: a file, or a built-in content, played at a finger."""

import math
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import Field, PrivateAttr

from controller.content.formats import named_content, named_contents, read_content
from controller.content.pattern import Pattern
from controller.content.rendition import CLICK_DURATION, Rendition, Tap, rendered
from controller.effects.effect import Effect, EffectRun, EffectStimulus, NoStimulus
from controller.play.intent import MAX_DB_SL, Pulse
from controller.sources.touch import Contact
from model.arrays import FloatArray
from model.errors import InputError
from model.finger import STRONG_DB_SL

_FREQUENCIES = tuple(float(hertz) for hertz in range(40, 501, 10))  # Hz; until a table is known


class _Renditions(NamedTuple):
    """A pattern at one level."""

    alone: Rendition
    among_others: Rendition
    """Replacement while other fingers are on the plate."""


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
            self._pattern = _named_pattern(self.file)
            return
        try:
            path = (folder / self.file).resolve()
        except (OSError, RuntimeError, ValueError) as error:  # circular links, or not a file name
            raise InputError(f"file must name a file, got {self.file!a}: {error}") from error
        if not path.is_relative_to(folder.resolve()):
            raise InputError(
                f"file must be in the folder of the layout, got {self.file}; copy it there"
            )
        if path.suffix:
            self._pattern = read_content(path, self.channel)
        else:
            self._pattern = _named_pattern(self.file)

    def for_table(self, frequencies: FloatArray) -> Self:
        """Return an unprepared copy for the frequencies of a table [Hz]."""
        effect = self.model_copy()
        effect._frequencies = tuple(frequencies.tolist())
        effect._renditions = {}
        return effect

    @cached_property
    def _renditions(self) -> dict[float | None, _Renditions]:
        """Renditions by level; excluded from comparisons."""
        return {}

    def is_prepared(self, level_db_sl: float | None) -> bool:
        """Whether it is rendered at a level."""
        return level_db_sl in self._renditions

    def prepare(self, level_db_sl: float | None) -> _Renditions:
        """Render the file at a level, for a single finger and for a finger among others.

        Renditions cannot be scaled: the faintest intensity has the same level in every rendition.
        """
        if level_db_sl not in self._renditions:
            level = MAX_DB_SL if level_db_sl is None else level_db_sl
            alone = rendered(self._pattern, level, np.array(self._frequencies))
            if self.loop:
                alone = alone.looped()
            self._renditions[level_db_sl] = _Renditions(alone, alone.smoothed())
        return self._renditions[level_db_sl]

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start at the beginning."""
        renditions = self.prepare(level_db_sl)
        return _FileRun(renditions, now, loop=self.loop, is_limit=level_db_sl is None)

    @property
    def has_end(self) -> bool:
        """True unless it repeats."""
        return not self.loop


def named_effects(level_db_sl: float = STRONG_DB_SL) -> dict[str, File]:
    """Return an effect for each named content, at a level."""
    effects = {}
    for name in named_contents():
        effects[name] = File.of(_named_pattern(name), name=name, level_db_sl=level_db_sl)
    return effects


@lru_cache
def _named_pattern(name: str) -> Pattern:
    return read_content(named_content(name))


class _FileRun(EffectRun):
    """A rendition played from a time [s]: its continuous part, and its clicks in order."""

    def __init__(self, renditions: _Renditions, now: float, *, loop: bool, is_limit: bool) -> None:
        """is_limit: whether to play as strongly as the neighbors allow."""
        self._is_limit = is_limit
        self._duration = renditions.alone.duration
        duration = math.inf if loop else self._duration
        self._pulse = Pulse(duration, now, is_raised=False)
        self._clicks = renditions.alone.clicks
        self._clicks_among_others = renditions.among_others.clicks
        among_others = self._continuous_part(renditions.among_others, None)
        self._continuous = self._continuous_part(renditions.alone, among_others)
        self._started_clicks = 0
        self._click: EffectStimulus | None = None  # the last one, until it ends

    def _continuous_part(
        self, rendition: Rendition, among_others: EffectStimulus | None
    ) -> EffectStimulus | None:
        """Return the stimulus of the continuous part, if any."""
        if rendition.course is None:
            return None
        return EffectStimulus(
            None if self._is_limit else rendition.level_db_sl,
            pulse=self._pulse,
            course=rendition.course,
            band=rendition.band,
            among_others=among_others,
        )

    def _click_stimulus(
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
            self._start_click(now)
        change = min(self._next_click(), self._pulse.end)
        if self._click is not None and self._click.pulse is not None:
            if now < self._click.pulse.end:
                change = min(change, self._click.pulse.end)
            else:
                self._click = None
        until = None if math.isinf(change) else change
        if self._continuous is not None:
            return replace(self._continuous, until=until, click=self._click)
        if self._click is not None:
            return replace(self._click, until=until)
        return NoStimulus(until)

    def _start_click(self, now: float) -> None:
        """Start the next click, in place of the last one."""
        number = self._started_clicks % len(self._clicks)
        self._started_clicks += 1
        pulse = Pulse(CLICK_DURATION, now)
        among_others = self._click_stimulus(self._clicks_among_others[number], pulse, None)
        self._click = self._click_stimulus(self._clicks[number], pulse, among_others)

    def _next_click(self) -> float:
        """Start time [s] of the next click; infinite for none."""
        count = len(self._clicks)
        is_loop = math.isinf(self._pulse.duration)
        if not count or (self._started_clicks >= count and not is_loop):
            return math.inf
        turns, number = divmod(self._started_clicks, count)
        return self._pulse.start + turns * self._duration + self._clicks[number].time
