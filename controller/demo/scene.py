"""What the demonstration plays: recorded touches, and the layout by which they are felt."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from controller.effects.layout import BUZZ
from controller.sources.capture import RecordedDatagram, read_capture
from model.rig.rig import Rig
from model.structure.plate import Plate

MIN_ERAS_FOR_THREE = 8
"""Number of ERAs from which three people have contents of their own, else two."""

SILENT_SHARE = 0.2
"""Share of the plate's length between the strips of several people."""

_TWO = {"left": None, "right": None}
_THREE = {"left": (60, 110), "middle": (130, 180), "right": (220, 280)}  # Hz


@dataclass(frozen=True)
class Scene:
    """Recorded touches, whose places are shares of the plate.

    layout: as in a layout's file; by default the newest finger feels a vibration and no other.
    """

    touches: Sequence[RecordedDatagram]
    layout: Mapping[str, Any] = field(default_factory=lambda: {"elsewhere": BUZZ})


def example_scenes(rig: Rig) -> list[Scene]:
    """The recorded touches of the demonstration of a rig: one person, then two or three."""
    name = "three_people" if _is_for_three(rig) else "two_people"
    return [
        Scene(read_capture(example_touches_path("touches"))),
        Scene(read_capture(example_touches_path(name)), example_layout(rig)),
    ]


def example_layout(rig: Rig) -> dict[str, Any]:
    """The layout for two or three people at a rig's plate."""
    return layout_of_people(rig.plate, _THREE if _is_for_three(rig) else _TWO)


def _is_for_three(rig: Rig) -> bool:
    return len(rig.eras) >= MIN_ERAS_FOR_THREE


def layout_of_people(
    plate: Plate, bands: Mapping[str, tuple[float, float] | None]
) -> dict[str, Any]:
    """Return a layout of upright strips, from west to east, each with a vibration of its own.

    bands: lowest and highest frequency [Hz] by name, None for any. Between the strips, on a fifth
    of the plate, a finger feels nothing.
    """
    width = (1 - SILENT_SHARE) / len(bands)
    pitch = width + SILENT_SHARE / (len(bands) - 1)
    regions = {}
    for number, (name, band) in enumerate(bands.items()):
        west, east = (plate.length * (number * pitch + side) for side in (0, width))
        regions[name] = {
            "rectangle": {"start": [west, 0], "end": [east, plate.width]},
            "on_press": name,
            **({} if band is None else {"band": [*band]}),
        }
    effects = {name: {"kind": "buzz"} for name in bands}
    return {"effects": effects, "regions": regions, "elsewhere": None}


def example_touches_path(name: str) -> Path:
    """A recording of the demonstration: installed with this package, or in a checkout."""
    file = f"{name}.tuio"
    package = Path(__file__).parents[1]
    installed = package / "data" / file
    return installed if installed.exists() else package.parent / "examples" / file
