"""File: content that people have, AHAP and its relatives, felt from its beginning to its end."""

import math
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field, PrivateAttr

from controller.content.formats import named_content, named_contents, read_content
from controller.content.pattern import Pattern
from controller.content.rendition import CLICK_DURATION, Rendition, Tap, rendered
from controller.effects.effect import Effect, EffectRun, EffectStimulus, NoStimulus
from controller.play.intent import MAX_DB_SL, Pulse
from controller.sources.contacts import Contact
from model.arrays import FloatArray
from model.errors import InputError
from model.finger import STRONG_DB_SL

_FREQUENCIES = tuple(float(each) for each in range(40, 501, 10))  # Hz; until a table is known


class File(Effect):
    """A file beside the layout, or a content by its name, once or over and over."""

    kind: ClassVar[str] = "file"
    is_for_motion: ClassVar[bool] = False

    file: Annotated[str, Field(min_length=1, max_length=255)]
    """Its path from the folder of the layout, in which it must be, or the name of a content."""

    loop: bool = False
    """Whether it begins anew at its end, as long as the finger stays."""

    channel: Annotated[int, Field(ge=1, le=64)] | None = None
    """Of a file that has several; none: the first."""

    _pattern: Pattern = PrivateAttr(default=Pattern(0.0))
    _frequencies: tuple[float, ...] = PrivateAttr(default=_FREQUENCIES)

    @classmethod
    def of(cls, pattern: Pattern, *, name: str, level_db_sl: float, loop: bool = False) -> Self:
        """Make one of a pattern that has been read."""
        effect = cls.model_construct({"level"}, file=name, level=level_db_sl, loop=loop)
        effect._pattern = pattern
        return effect

    def read(self, folder: Path) -> None:
        """Read the file; raises InputError, also for one outside of the folder."""
        if self.file in named_contents():
            self._pattern = _named(self.file)
            return
        try:
            path = (folder / self.file).resolve()
        except (OSError, RuntimeError, ValueError) as error:  # links in a circle, no name of a file
            raise InputError(f"file must name a file, got {self.file!a}: {error}") from error
        if not path.is_relative_to(folder.resolve()):
            raise InputError(
                f"file must be in the folder of the layout, got {self.file}; copy it there"
            )
        self._pattern = read_content(path, self.channel) if path.suffix else _named(self.file)

    def for_table(self, frequencies: FloatArray) -> Self:
        """Return it for the frequencies of a table [Hz]; nothing is prepared of it."""
        effect = self.model_copy()
        effect._frequencies, effect._rendered = tuple(frequencies.tolist()), {}
        return effect

    @cached_property
    def _rendered(self) -> dict[float | None, tuple[Rendition, Rendition]]:
        """Renditions by level: no part of what is compared."""
        return {}

    def is_prepared(self, level_db_sl: float | None) -> bool:
        """Whether it is rendered at a level."""
        return level_db_sl in self._rendered

    def prepare(self, level_db_sl: float | None) -> tuple[Rendition, Rendition]:
        """Render it at a level, for a finger that is alone, and for one among others.

        Not by scaling another rendition: the faintest intensity has the same level in each.
        """
        if level_db_sl not in self._rendered:
            level = MAX_DB_SL if level_db_sl is None else level_db_sl
            alone = rendered(self._pattern, level, np.array(self._frequencies))
            self._rendered[level_db_sl] = alone, alone.smoothed()
        return self._rendered[level_db_sl]

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start at its beginning."""
        alone, among = self.prepare(level_db_sl)
        return _FileRun(alone, among, now, loop=self.loop, is_limit=level_db_sl is None)

    @property
    def has_end(self) -> bool:
        """True unless it begins anew."""
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
    """A rendition from a time [s] on: what lasts of it, and its clicks in their turn."""

    def __init__(
        self, alone: Rendition, among: Rendition, now: float, *, loop: bool, is_limit: bool
    ) -> None:
        self._pulse = Pulse(math.inf if loop else alone.duration, now, is_raised=False)
        self._alone, self._among, self._is_limit = alone, among, is_limit
        among_others = self._lasting_of(among, None)
        self._lasting = self._lasting_of(alone, among_others)
        self._started = 0  # clicks
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
        """Return what lasts, and the click that is due, if any."""
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
        """When [s] the next click starts; infinite for none."""
        found, count = self._alone, len(self._alone.clicks)
        if not count or (self._started >= count and self._pulse.duration < math.inf):
            return math.inf
        turns, number = divmod(self._started, count)
        return self._pulse.start + turns * found.duration + found.clicks[number].time
