"""Types of exciters that are sold: values of their sheets, each with its source.

No maker's sheet could be opened: values are second hand, or assumed where no source gives any. A
resonance is that of the light coil against the magnet (`free`). Measure one that you have.
"""

from collections.abc import Mapping
from dataclasses import dataclass

_DESIGN = "a public loudspeaker design, AudioPicture V2.2 of 2026-09-29, quoting the maker's sheet"
_PINNED = "HanzoRazer/tap_tone_pi, tests/test_e1_hardware_bom.py, survey of 2026-08-25"
_PART_PAGE = "docs.cirkitdesigner.com, page of the part, read 2026-11-26; not the maker's"
_NET_WEIGHT = f"{_DESIGN}: net weight of 110.9 g less the coil's"


@dataclass(frozen=True)
class SheetValue:
    """A value in SI units with its source; lowest and highest where it is assumed."""

    value: float
    source: str = ""
    assumed: tuple[float, float] | None = None


def _assumed(value: float, lowest: float, highest: float) -> SheetValue:
    return SheetValue(value, assumed=(lowest, highest))


@dataclass(frozen=True)
class ExciterType:
    """A type by its name; note: what to know before buying it; values: by key of a rig file."""

    name: str
    note: str
    values: Mapping[str, SheetValue]

    @property
    def assumed(self) -> dict[str, tuple[float, float]]:
        """Keys that no source gives, with the lowest and highest value that is likely."""
        return {key: each.assumed for key, each in self.values.items() if each.assumed}


_KNOWN = (
    ExciterType(
        "DAEX13-4SM",
        "13 mm; no sheet gives force factor and coil mass, and its resonance is unreliable",
        {
            "coil_mass": _assumed(0.7e-3, 0.5e-3, 1.0e-3),
            "weight": SheetValue(14.3e-3, f"{_PART_PAGE}: 15 g in all, less the coil's"),
            "resonance": SheetValue(200.0, f"{_PART_PAGE}, unreliable"),
            "q": _assumed(3.0, 2.0, 5.0),
            "force_factor": _assumed(1.5, 1.2, 1.8),
            "resistance": _assumed(3.6, 3.2, 4.0),
            "inductance": _assumed(0.06e-3, 0.03e-3, 0.1e-3),
            "excursion": _assumed(0.5e-3, 0.5e-3, 1.0e-3),
            "power": SheetValue(3.0, _PART_PAGE),
        },
    ),
    ExciterType(
        "DAEX25CT-4",
        "25 mm, a coin",
        {
            "coil_mass": SheetValue(1.29e-3, _PINNED),
            "weight": _assumed(33.5e-3, 28.7e-3, 43.7e-3),
            "resonance": SheetValue(306.0, _PINNED),
            "q": _assumed(3.0, 2.0, 5.0),
            "force_factor": SheetValue(1.54, _PINNED),
            "resistance": SheetValue(3.6, _PINNED),
            "inductance": _assumed(0.07e-3, 0.04e-3, 0.1e-3),
            "excursion": _assumed(0.5e-3, 0.5e-3, 1.0e-3),
            "power": SheetValue(10.0, _PINNED),
        },
    ),
    ExciterType(
        "DAEX25FHE-4",
        "25 mm in a frame; superseded by EX25FHE2-4",
        {
            "coil_mass": SheetValue(1.61e-3, _DESIGN),
            "weight": SheetValue(109.29e-3, _NET_WEIGHT),
            "resonance": SheetValue(224.0, _DESIGN),
            "q": _assumed(3.0, 2.0, 5.0),
            "force_factor": SheetValue(3.63, _DESIGN),
            "resistance": SheetValue(4.3, _DESIGN),
            "inductance": SheetValue(0.1e-3, f"{_DESIGN}, at 1 kHz"),
            "excursion": _assumed(0.5e-3, 0.5e-3, 1.0e-3),
            "power": SheetValue(24.0, _DESIGN),
        },
    ),
    ExciterType(
        "EX25FHE2-4",
        "25 mm in a frame, sold in place of DAEX25FHE-4; masses and force factor as of that one",
        {
            "coil_mass": _assumed(1.61e-3, 1.2e-3, 2.0e-3),
            "weight": _assumed(109.29e-3, 85e-3, 130e-3),
            "resonance": SheetValue(115.0, _DESIGN),
            "q": _assumed(3.0, 2.0, 5.0),
            "force_factor": _assumed(3.63, 3.0, 4.2),
            "resistance": SheetValue(4.3, _DESIGN),
            "inductance": SheetValue(0.1e-3, f"{_DESIGN}, at 1 kHz"),
            "excursion": _assumed(0.5e-3, 0.5e-3, 1.0e-3),
            "power": SheetValue(24.0, _DESIGN),
        },
    ),
)

EXCITER_TYPES: Mapping[str, ExciterType] = {each.name: each for each in _KNOWN}
"""Known types by name; the resonance of each is `free`."""
