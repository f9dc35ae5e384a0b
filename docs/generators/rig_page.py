"""The tables of keys in reference/rig.md, from the sections of a rig file."""

from collections.abc import Callable, Mapping
from functools import partial

from key_tables import key_table
from model.config.sections import Section
from model.rig import sections
from model.rig.era_section import EraSection
from model.rig.exciter_section import ExciterSection

SECTIONS: Mapping[str, type[Section]] = {
    "rig": sections.RigSection,
    "plate": sections.PlateSection,
    "layers": sections.LayerSection,
    "air_gap": sections.AirGapSection,
    "material": sections.MaterialSection,
    "eras": EraSection,
    "exciters": ExciterSection,
    "masses": sections.MassSection,
    "supports": sections.SupportSection,
    "amplifiers": sections.AmplifierSection,
    "limits": sections.LimitsSection,
    "uncertainty": sections.UncertaintySection,
    "fingertip": sections.FingertipSection,
}

PARTS: Mapping[str, Callable[[], str]] = {
    name: partial(key_table, each) for name, each in SECTIONS.items()
}
