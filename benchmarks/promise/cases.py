"""Cases of sessions through the complete signal chain: contents, rigs, lines and events."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from model.answer.plan import answer
from model.answer.stimulus import ANY_BAND, Finger, Stimulus
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import load_rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table

EXAMPLES = Path(__file__).parents[2] / "examples"
LEVEL_DB_SL = 14.0
IDENTIFIED = Uncertainty(
    gain=0.015,
    phase_deg=1.5,
    stiffness=0.01,
    damping=1.1,
    fingertip=0.5,
    **Uncertainty.of_frequency(0.002),
    place=0.0003,
)
"""Uncertainty after `era rig identify`; harmonics have their default."""

JOINS, CHANGES, LEAVES, MOVES = "joins", "changes", "leaves", "moves"
HELD, RESTING = 3.0, 5.0  # s
"""Times for reading clocks: before the first finger, and while fingers rest."""

Band = tuple[float, float]
Point = tuple[float, float]


@dataclass(frozen=True)
class Case:
    """Fingers with contents and quiet fingers, on an example rig.

    bands [Hz]: of the contents in order, any band if empty; may_swap: in any order. modulation_hz:
    of the last content. events: actions of the last finger with a content, once all contents play.
    line: kind of the line, prompt if None; is_one_bus: one line for all amplifiers; resting [s]:
    rest of the fingers before the measurement. clicks: fingers that click, one after the other.
    """

    name: str
    rig_name: str = "paper_plate"
    contents: int = 2
    quiet: int = 0
    is_identified: bool = False
    bands: tuple[Band, ...] = ()
    may_swap: bool = False
    modulation_hz: float | None = None
    events: tuple[str, ...] = ()
    line: str | None = None
    is_one_bus: bool = True
    resting: float = 0.0
    clicks: tuple[int, ...] = ()

    @property
    def title(self) -> str:
        """Contents and rig, for tables."""
        uncertainty = "identified" if self.is_identified else "default"
        return f"{self.name}, {len(self.rig.eras)} ERAs {uncertainty}"

    @property
    def rig(self) -> Rig:
        """The rig with its uncertainty."""
        return _rig(self.rig_name, self.is_identified)

    @property
    def table(self) -> LocalizationTable:
        """The table of the rig."""
        return _table(self.rig_name, self.is_identified)

    def bands_for(self, positions: list[Point]) -> list[Band]:
        """Return the band of each content, in the best order if bands may swap."""
        bands = list(self.bands) or [ANY_BAND] * self.contents
        if not self.may_swap:
            return bands
        fingers = [
            Finger(at, Stimulus(LEVEL_DB_SL, band))
            for at, band in zip(positions, bands, strict=True)
        ]
        best = answer(
            self.table, fingers, bands_may_swap=True, drive_mode="phased", min_contrast_db=-np.inf
        )
        ordered = []
        for layer in best.layers:
            tone = next(iter(layer.excitation.values()))
            ordered += [band for band in bands if band[0] <= tone.frequency <= band[1]]
        return ordered


@cache
def _rig(name: str, is_identified: bool) -> Rig:
    rig = load_rig(EXAMPLES / f"{name}.yaml")
    return replace(rig, uncertainty=IDENTIFIED) if is_identified else rig


@cache
def _table(rig_name: str, is_identified: bool) -> LocalizationTable:
    rig = _rig(rig_name, is_identified)
    frequencies = np.arange(max(40.0, rig.limits.frequency_min), 321.0, 10.0)
    return build_table(rig, drive_mode="phased", frequencies=frequencies)


RIGS = (("paper_plate", False), ("paper_plate", True), ("car_display", True))
"""Rigs by name, and whether they are identified."""

_EVENTS = (LEAVES, JOINS, CHANGES)
_TWO = ((40.0, 110.0), (140.0, 190.0))
_THREE = (*_TWO, (230.0, 320.0))


def _drifting(lines: str, kind: str, *, is_one_bus: bool) -> Case:
    """Two contents on three amplifiers whose clocks drift, while fingers rest."""
    return Case(
        f"two vibrations at rest, {lines}",
        "car_display",
        is_identified=True,
        line=kind,
        is_one_bus=is_one_bus,
        resting=RESTING,
    )


def _clicks(name: str, clicks: tuple[int, ...], *, contents: int, quiet: int = 0) -> list[Case]:
    """Clicks of the same fingers on three rigs."""
    return [
        Case(f"click {name}", rig, contents, quiet, is_identified, clicks=clicks)
        for rig, is_identified in RIGS
    ]


CASES = (
    Case("one vibration, two quiet fingers", contents=1, quiet=2),
    Case("two vibrations", events=(*_EVENTS, MOVES)),
    Case("two vibrations", is_identified=True, events=(*_EVENTS, MOVES)),
    Case("three vibrations", "eight_eras", 3),
    Case("three vibrations", "eight_eras", 3, is_identified=True),
    Case("four vibrations", "car_display", 4, is_identified=True, events=_EVENTS),
    Case("two vibrations, bands given", bands=_TWO),
    Case("two vibrations, bands in any order", bands=_TWO, may_swap=True),
    Case("three vibrations, bands given", contents=3, bands=_THREE),
    Case("three vibrations, bands in any order", contents=3, bands=_THREE, may_swap=True),
    Case("two vibrations, bands given", "car_display", bands=_TWO),
    Case("three vibrations, bands given", "car_display", contents=3, bands=_THREE),
    Case("texture of 20 Hz next to a steady vibration", is_identified=True, modulation_hz=20.0),
    _drifting("one bus, USB high speed", "usb-high-speed", is_one_bus=True),
    _drifting("one bus, USB full speed", "usb-full-speed", is_one_bus=True),
    _drifting("a line each, USB high speed", "usb-high-speed", is_one_bus=False),
    _drifting("a line each, USB full speed", "usb-full-speed", is_one_bus=False),
    *_clicks("alone", (0,), contents=0, quiet=2),
    *_clicks("next to another vibration", (1,), contents=1, quiet=1),
    *_clicks("on its own buzz, next to another", (0, 1), contents=2),
    *(
        Case("two vibrations, one moves", rig, is_identified=is_identified, events=(MOVES,))
        for rig, is_identified in RIGS
    ),
)
