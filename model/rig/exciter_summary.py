"""Exciters of a rig in numbers, and what is assumed of their types."""

import math
from typing import Any

from model.config.sections import quantities
from model.rig.exciter_checks import exciters_of
from model.rig.exciter_section import ExciterSection
from model.rig.rig import Rig
from model.structure.exciter import Exciter
from model.structure.exciter_types import EXCITER_TYPES


def summary_of(one: Exciter) -> dict[str, Any]:
    """An exciter by itself; keys carry their units."""
    return {
        "name": one.name,
        "magnet": "held" if one.held else "free",
        "magnet_resonance_hz": one.magnet_frequency,
        "q": one.quality,
        "force_at_1_w_n": one.force_factor * math.sqrt(2 / one.resistance),
        "full_level_v": one.voltage * one.largest_gain,
        "full_level_force_n": one.largest_force,
        "excursion_max_m": one.excursion if math.isfinite(one.excursion) else None,
    }


def types_of(rig: Rig) -> dict[str, dict[str, Any]]:
    """Types of a rig's exciters by name: what to know of each, and what no source gives of it.

    assumed: by key the lowest and the highest value that is likely, unless every exciter of the
    type states its own.
    """
    found: dict[str, dict[str, Any]] = {}
    if rig.document is None:
        return found
    for one in exciters_of(rig):
        section = ExciterSection.model_validate(rig.document.value(("eras", one.name)))
        known = EXCITER_TYPES.get(section.type or "")
        if known is None:
            continue
        entry = found.setdefault(known.name, {"note": known.note, "assumed": {}})
        for key, between in known.assumed.items():
            (quantity,) = quantities(ExciterSection.model_fields[key])
            if getattr(section, key) is None:
                entry["assumed"][quantity.dimension.key(key)] = list(between)
    return found
