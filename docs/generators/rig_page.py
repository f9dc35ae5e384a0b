"""The tables of keys in reference/rig.md, from the sections of a rig file.

`python docs/generators/rig_page.py` rewrites them between the page's marks.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from key_tables import key_table
from model.config.sections import Section
from model.rig import sections

SECTIONS: Mapping[str, type[Section]] = {
    "rig": sections.RigSection,
    "plate": sections.PlateSection,
    "layers": sections.LayerSection,
    "air_gap": sections.AirGapSection,
    "material": sections.MaterialSection,
    "eras": sections.EraSection,
    "masses": sections.MassSection,
    "amplifiers": sections.AmplifierSection,
    "limits": sections.LimitsSection,
    "uncertainty": sections.UncertaintySection,
    "fingertip": sections.FingertipSection,
}

PARTS: Mapping[str, Callable[[], str]] = {
    name: partial(key_table, each) for name, each in SECTIONS.items()
}


if __name__ == "__main__":
    from page_part import insert

    path = Path(__file__).parents[1] / "reference" / "rig.md"
    page = path.read_text("utf-8")
    for name, write in PARTS.items():
        page = insert(page, write(), writer=f"docs/generators/rig_page.py {name}")
    path.write_text(page, encoding="utf-8")
