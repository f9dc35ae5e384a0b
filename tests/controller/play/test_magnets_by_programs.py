"""How far programs of content move magnets, and heat coils, by what reaches the simulated plate.

Content that is as strong as rigs allow, at the frequencies at which magnets move most: each program
is played over a wire in virtual time, and its outputs move the plate of `magnets`.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from chain import Chain
from controller.content.pattern import Curve, Pattern, Transient, sharpness_of
from controller.effects.effect import Effect, Region
from controller.effects.kinds import Buzz, Click, File, Texture
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from exciters import Magnets, Outputs
from long_form import shortly
from model.answer.answer_report import Timing
from model.arrays import ComplexArray
from model.config.fields import Circle
from model.rig.rig import Rig
from model.rig.rig_file import parse_rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from sim.far_ends.wire_assignment import Wire
from virtual_lines import run_virtual

_logger = logging.getLogger(__name__)

ALL = 60.0
"""More than any rig gives [dB SL]."""

PLACES = ((0.3, 0.2), (0.1, 0.1), (0.3, 0.07))


@cache
def rig(name: str) -> Rig:
    """The weekend's as it is, down to 60 Hz, or with the larger exciters at all that they bear."""
    path = Path(__file__).parents[3] / "examples/weekend/rig.yaml"
    text, reach = path.read_text(), "frequency: [100 Hz, 300 Hz]"
    assert reach in text
    if name == "large":
        text = text.replace("DAEX25CT-4", "DAEX25FHE-4").replace("power: 1 W", "power: 24 W")
    low = {"weekend": 90, "low": 60, "large": 40}[name]
    return parse_rig("rig.yaml", text.replace(reach, f"frequency: [{low} Hz, 300 Hz]"))


@cache
def table(name: str, frequencies: tuple[float, ...]) -> LocalizationTable:
    """Of these frequencies [Hz] alone, so that nothing else is chosen."""
    return build_table(rig(name), frequencies=np.array(frequencies), drive_mode="phased")


@cache
def magnets(name: str) -> Magnets:
    """Those of a rig."""
    return Magnets(rig(name))


def swinging(hertz: float, *, seconds: float = 0.8, is_square: bool = False) -> Curve:
    """Intensity that comes and goes as a cosine, or as a square."""
    times = np.arange(0.0, seconds, 0.0025)
    wave = np.cos(2 * np.pi * hertz * times)
    values = ((np.sign(wave) if is_square else wave) + 1) / 2
    return tuple(zip(times.tolist(), values.tolist(), strict=True))


def file(
    curve: Curve, hertz: float, taps: Sequence[float] = (), *, to: float | None = None
) -> Effect:
    """A file of this intensity and of taps at times [s], all that is played; to: swept."""
    first, last = sharpness_of(np.array([hertz, to or hertz])).tolist()
    sharpness = ((0.0, first), (0.8, last))
    pattern = Pattern(1.0, curve, sharpness, tuple([Transient(at, 1.0, first) for at in taps]))
    return File.of(pattern, name="it", level_db_sl=ALL)


@dataclass(frozen=True)
class Program:
    """What fingers feel, by place, until a time [s], and how that ends.

    hertz: of the table; shakes: how often a second the first finger goes 8 mm to and fro.
    """

    rig: str
    hertz: tuple[float, ...]
    effects: tuple[Effect, ...]
    until: float = 0.9
    end: str = "lift"
    shakes: float = 0.0

    async def play(self) -> None:
        """Play it from arming to closing."""
        plate, chosen = rig(self.rig), table(self.rig, self.hertz)
        at = dict(enumerate(PLACES[: len(self.effects)]))
        layout = SurfaceLayout(
            tuple(Region(f"{n}", Circle(*each, 0.03), on_press=f"e{n}") for n, each in at.items()),
            {f"e{n}": each.for_table(chosen.frequencies) for n, each in enumerate(self.effects)},
            elsewhere=None,
        )
        wire = Wire("serial", speed=921_600, unpluggable=True)
        source, timing = EffectPlayer(layout), Timing(chosen)
        async with Chain.armed(
            wire, plate, chosen, intent_source=source, timing=timing, capabilities={"layers": 8}
        ) as chain:
            chain.must_be_felt, chain.at = False, at
            x, y = at[0]

            def way(since: float) -> None:
                away = 0.004 * np.sin(2 * np.pi * self.shakes * since)
                chain.at = {**at, 0: (x + away, y)}

            await chain.hold(self.until, way)
            if self.end == "stop":
                await chain.operate("stop")
            elif self.end == "trip":
                chain.far_end.fault("over_current")
            else:
                chain.at = {}
            await chain.hold(0.15)

    def volts(self) -> ComplexArray:
        """What exciters get."""
        with Outputs.recorded() as outputs:
            run_virtual(self.play())
        return outputs.volts(len(rig(self.rig).eras))


TAPS = tuple(np.arange(0.1, 0.8, 0.06).tolist())

PROGRAMS = {
    "steady, 70 Hz": Program("low", (70.0,), (Buzz(level=ALL),)),
    "steady, 40 Hz, large": Program("large", (40.0,), (Buzz(level=ALL),)),
    "swings 30 times a second, 100 Hz": Program(
        "weekend", (100.0,), (file(swinging(30, is_square=True), 100),)
    ),
    "swings 34 times a second, 110 Hz asked": Program(
        "weekend", (90.0, 100.0, 110.0, 120.0), (file(swinging(34), 110),)
    ),
    "swings 45 times a second, 120 Hz": Program("low", (120.0,), (file(swinging(45), 120),)),
    "swings 20 times a second, 60 Hz, large": Program(
        "large", (60.0,), (file(swinging(20, is_square=True), 60),)
    ),
    "swings 10 times a second, 50 Hz, large": Program(
        "large", (50.0,), (file(swinging(10, is_square=True), 50),)
    ),
    "taps 60 ms apart, 60 Hz, large": Program("large", (60.0,), (file((), 60, TAPS),)),
    "taps 60 ms apart, 100 Hz": Program("weekend", (100.0,), (file((), 100, TAPS),)),
    "swept through the resonance": Program(
        "low", (60.0, 70.0, 80.0, 90.0), (file(swinging(5), 60, to=100),)
    ),
    "two files that beat": Program(
        "low", (70.0, 100.0), (file(swinging(25), 70), file(swinging(30), 100))
    ),
    "a file, a buzz and taps": Program(
        "low",
        (60.0, 90.0, 120.0),
        (file(swinging(15), 90), Buzz(level=ALL), file((), 120, TAPS)),
    ),
    "modulated, 100 Hz": Program(
        "low", (70.0, 80.0, 90.0, 100.0, 110.0, 120.0, 130.0), (Buzz(level=ALL, modulation=25),)
    ),
    "texture, shaken": Program("low", (90.0,), (Texture(level=ALL),), shakes=8.0),
    "steady, 190 Hz, large": Program("large", (190.0,), (Buzz(level=ALL),), until=0.3),
    "click, 80 Hz": Program("low", (80.0,), (Click(level=ALL),), until=0.2),
    "stopped amid an onset": Program("low", (70.0,), (Buzz(level=ALL),), until=0.06, end="stop"),
    "failing amid an onset": Program("large", (60.0,), (Buzz(level=ALL),), until=0.09, end="trip"),
    "stopped amid swings": Program(
        "weekend", (100.0,), (file(swinging(30), 100),), until=0.27, end="stop"
    ),
}


@pytest.mark.parametrize(
    "name",
    shortly(
        PROGRAMS,
        {
            "swings 30 times a second, 100 Hz",
            "taps 60 ms apart, 60 Hz, large",
            "two files that beat",
            "failing amid an onset",
            "steady, 190 Hz, large",
        },
    ),
)
def test_programs_keep_magnets_within_their_excursion(name: str) -> None:
    """By all that the amplifier plays of them; no coil takes more than it bears, in any cycle."""
    program = PROGRAMS[name]
    volts, solved = program.volts(), magnets(program.rig)
    moved = solved.moved(volts)
    limit = rig(program.rig).eras[0].excursion
    share = np.abs(moved).max() / limit
    heat = solved.heat(volts, moved).max()
    _logger.info("%s: %.2f of x_max, %.2g W", name, share, heat)
    assert 0.15 < share < 1.01
    assert heat < {"weekend": 10.0, "low": 10.0, "large": 24.0}[program.rig]
