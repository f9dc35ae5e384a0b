"""The reference of the rig file against what rig files may say."""

import re
from pathlib import Path

import pytest

import model
from key_tables import bounds_in_words, key_rows, quantities
from model.config.units import quantity
from model.rig.file import load_rig
from model.rig.sections import (
    AirGapSection,
    AmplifierSection,
    EraSection,
    FingertipSection,
    LayerSection,
    LimitsSection,
    MassSection,
    MaterialSection,
    PlateSection,
    RigSection,
    UncertaintySection,
)
from model.structure.materials import KNOWN_MATERIALS

ROOT = Path(model.__file__).parent.parent
PAGE = (ROOT / "docs" / "reference" / "rig.md").read_text("utf-8")
SECTIONS = {
    "The file": RigSection,
    "plate": PlateSection,
    "layers": LayerSection,
    "air_gap": AirGapSection,
    "material": MaterialSection,
    "eras": EraSection,
    "masses": MassSection,
    "amplifiers": AmplifierSection,
    "limits": LimitsSection,
    "uncertainty": UncertaintySection,
    "fingertip": FingertipSection,
}


def rows(heading):
    """The table of keys under a heading: (unit, default, limits, meaning) by key."""
    return key_rows(PAGE, heading)


@pytest.mark.parametrize("heading", SECTIONS)
def test_page_lists_the_keys_of_each_section(heading):
    """A section's table names exactly the keys that the section has, in their order."""
    assert list(rows(heading)) == list(SECTIONS[heading].model_fields)


@pytest.mark.parametrize("heading", SECTIONS)
def test_page_has_the_units_and_bounds_of_each_key(heading):
    """A quantity's row has its SI unit and every finite bound, in the words of the error."""
    for key, field in SECTIONS[heading].model_fields.items():
        unit, _, limits, _ = rows(heading)[key]
        found = quantities(field)
        assert unit == (found[0].dimension.unit if found else "")
        for asked in found:
            assert limits == bounds_in_words(asked)


@pytest.mark.parametrize("heading", SECTIONS)
def test_page_has_the_defaults_of_each_key(heading):
    """Required keys say so; the others show the value that stands in when they are left out."""
    for key, field in SECTIONS[heading].model_fields.items():
        default = rows(heading)[key][1]
        if field.is_required():
            assert default == "required"
        elif isinstance(field.default, float):
            (asked,) = quantities(field)
            assert quantity(default, asked.dimension) == field.default
        elif isinstance(field.default, tuple):
            assert default == f"`[{', '.join(f'{bound:g}' for bound in field.default)}]`"
        elif isinstance(field.default, str):
            assert default == f"`{field.default}`"
        else:
            assert "none" in default or "`layers`" in default or default == "see there"


def test_page_has_a_minimal_rig_that_loads(tmp_path):
    """The rig that the page prints loads, with three ERAs."""
    path = tmp_path / "rig.yaml"
    path.write_text(re.search(r"```yaml\n(.*?)```", PAGE, re.DOTALL)[1], encoding="utf-8")
    assert [era.name for era in load_rig(path).eras] == ["SW", "SE", "N"]


def test_page_lists_the_known_materials():
    """Names and numbers of the page's table are the list's."""
    printed = re.findall(
        r"^\| `([\w-]+)` \| ([\d.]+) GPa \| (\d+) kg/m³ \| ([\d.]+) \|", PAGE, re.M
    )
    known = [known.material for known in KNOWN_MATERIALS.values()]
    assert [(name, float(E) * 1e9, float(rho), float(nu)) for name, E, rho, nu in printed] == [
        (material.name, material.E, material.rho, material.nu) for material in known
    ]
