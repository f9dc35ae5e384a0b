"""Which contents are measured on which plates, with what is to be reached; a row for each case."""

from dataclasses import dataclass, replace
from functools import cache
from itertools import product
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
"""As after `era rig identify`; harmonics are those of any rig."""

FURTHER = ("modulus", "place")
"""Errors of plates that deviate, which promises count since later than others."""

JOINS, CHANGES, LEAVES, MOVES = "joins", "changes", "leaves", "moves"

Band = tuple[float, float]
Point = tuple[float, float]


@dataclass(frozen=True)
class Case:
    """Fingers with contents, then quiet ones, on a plate of its kind.

    goal_db: of the promise at the worst finger, median. bands [Hz]: of the contents in order, any
    without; may_swap: in any order. modulation_hz: of the last content. events: what the last
    finger with a content does, one after the other, once all have been felt together. line: kind of
    the line, prompt without; is_one_bus: or a line for each amplifier; resting [s]: while the
    fingers rest, before it is measured; without: keys of the uncertainty that are none;
    with_errors: whether it is one of several that differ by these alone. clicks: fingers
    that click, one after the other.
    """

    name: str
    goal_db: float | None
    rig_name: str = "paper_plate"
    contents: int = 2
    quiet: int = 0
    is_identified: bool = False
    bands: tuple[Band, ...] = ()
    may_swap: bool = False
    modulation_hz: float | None = None
    apart: float = 0.0
    events: tuple[str, ...] = ()
    line: str | None = None
    is_one_bus: bool = True
    resting: float = 0.0
    without: tuple[str, ...] = ()
    with_errors: bool = False
    clicks: tuple[int, ...] = ()

    @property
    def title(self) -> str:
        """What is measured, in words."""
        uncertainty = "identified" if self.is_identified else "default"
        return f"{self.name}, {len(self.rig.eras)} ERAs {uncertainty}"

    @property
    def rig(self) -> Rig:
        """The rig with its uncertainty."""
        rig = load_rig(EXAMPLES / f"{self.rig_name}.yaml")
        known = IDENTIFIED if self.is_identified else rig.uncertainty
        return replace(rig, uncertainty=replace(known, **dict.fromkeys(self.without, 0.0)))

    @property
    def table(self) -> LocalizationTable:
        """The table of the rig."""
        return _table(self.rig_name, self.is_identified, self.without)

    def bands_for(self, places: list[Point]) -> list[Band]:
        """The band of each content, by the best order where they may swap."""
        bands = [*self.bands] or [ANY_BAND] * self.contents
        if self.may_swap:
            fingers = [
                Finger(at, Stimulus(LEVEL_DB_SL, band))
                for at, band in zip(places, bands, strict=True)
            ]
            found = answer(
                self.table,
                fingers,
                bands_may_swap=True,
                drive_mode="phased",
                min_contrast_db=-np.inf,
            )
            played = [next(iter(each.excitation.values())).frequency for each in found.layers]
            bands = [next(b for b in bands if b[0] <= each <= b[1]) for each in played]
        return bands


@cache
def _table(rig_name: str, is_identified: bool, without: tuple[str, ...]) -> LocalizationTable:
    rig = Case("", None, rig_name, is_identified=is_identified, without=without).rig
    grid = np.arange(max(40.0, rig.limits.frequency_min), 321.0, 10.0)
    return build_table(rig, drive_mode="phased", frequencies=grid)


def _resting(name: str, line: str, *, is_one_bus: bool = False) -> Case:
    """Two contents on three amplifiers whose clocks drift, while fingers rest."""
    return Case(
        f"two contents at rest, {name}",
        None,
        "car_display",
        is_identified=True,
        line=line,
        is_one_bus=is_one_bus,
        resting=RESTING,
    )


_ERRORS = {
    "neither harmonics nor further errors": ("harmonic", *FURTHER),
    "1 % of second harmonic": FURTHER,
    "1 % of second harmonic, and the further errors": (),
}
"""Of plates that deviate, by those that are none."""


def _two_contents(errors: str) -> list[Case]:
    """Two contents on plates of some errors, on each kind of rig."""
    name, without = f"two contents, {errors}", _ERRORS[errors]
    return [
        Case(name, None, rig, is_identified=known, without=without, with_errors=True)
        for known in (False, True)
        for rig in ("paper_plate", "car_display")
    ]


def _landing(contents: int, rig_name: str, apart: float) -> Case:
    """Contents that fingers feel who land together, or one after the other."""
    name = f"{'two' if contents == 2 else 'three'} contents, landing"
    name = f"{name} {apart:g} s apart" if apart else f"{name} together"
    return Case(name, None, rig_name, contents, is_identified=True, apart=apart)


APART = 0.35  # s; between fingers that land one after the other


def _clicks(name: str, clicks: tuple[int, ...], *, contents: int = 2, quiet: int = 0) -> list[Case]:
    """Clicks of the same fingers on three rigs."""
    rigs = (("paper_plate", False), ("paper_plate", True), ("car_display", True))
    return [
        Case(f"click {name}", None, rig, contents, quiet, is_known, clicks=clicks)
        for rig, is_known in rigs
    ]


_LANDINGS = (("together", 0.0), (f"{APART:g} s apart", APART))

HELD, RESTING = 3.0, 5.0  # s
"""While clocks are read before any finger comes, and while fingers rest after."""

_EVENTS = (LEAVES, JOINS, CHANGES)
_TWO, _THREE = ((40.0, 110.0), (140.0, 190.0)), ((40.0, 110.0), (140.0, 190.0), (230.0, 320.0))
CASES = (
    Case("one content, two quiet fingers", None, contents=1, quiet=2),
    Case("two contents", 14.9, events=(*_EVENTS, MOVES)),
    Case("two contents", 23.5, is_identified=True, events=(*_EVENTS, MOVES)),
    Case("three contents", 8.0, contents=3, events=_EVENTS),
    Case("three contents", 11.6, contents=3, is_identified=True, events=_EVENTS),
    Case("four contents", 17.8, "car_display", 4, is_identified=True, events=_EVENTS),
    Case("two contents, bands given", 11.1, bands=_TWO),
    Case("two contents, bands in any order", 13.5, bands=_TWO, may_swap=True),
    Case("three contents, bands given", 4.4, contents=3, bands=_THREE),
    Case("three contents, bands in any order", 6.4, contents=3, bands=_THREE, may_swap=True),
    Case("two contents, bands given", 21.2, "car_display", bands=_TWO),
    Case("three contents, bands given", 11.5, "car_display", contents=3, bands=_THREE),
    Case("texture of 20 Hz beside a steady content", 22.0, is_identified=True, modulation_hz=20.0),
    *(
        Case("two contents, by every set of thresholds", None, name, is_identified=is_identified)
        for name, is_identified in (
            ("paper_plate", False),
            ("paper_plate", True),
            ("car_display", True),
        )
    ),
    _resting("one bus, USB of high speed", "usb-high-speed", is_one_bus=True),
    _resting("one bus, USB of full speed", "usb-full-speed", is_one_bus=True),
    _resting("lines of USB, high speed", "usb-high-speed"),
    _resting("lines of USB, full speed", "usb-full-speed"),
    *(case for errors in _ERRORS for case in _two_contents(errors)),
    *[_landing(*each) for each in product((2, 3), ("paper_plate", "car_display"), (0.0, APART))],
    Case("two contents", None, "car_display", is_identified=True, events=(*_EVENTS, MOVES)),
    *_clicks("where nothing else is felt", (0,), contents=0, quiet=2),
    *_clicks("beside another's content", (1,), contents=1, quiet=1),
    *_clicks("at a finger with its own buzz, beside another", (0, 1)),
    *[
        Case("two contents, one moves", None, name, is_identified=known, events=(MOVES,))
        for name, known in (("paper_plate", False), ("paper_plate", True), ("car_display", True))
    ],
    *[Case("three contents", None, "eight_eras", 3, is_identified=it) for it in (False, True)],
    *[Case(f"two contents, landing {when}", None, apart=each) for when, each in _LANDINGS],
)
