"""The reference of the rig file against what rig files may say."""

import inspect
import re
from pathlib import Path

import model
import rig_page
from model.config.fields import Section
from model.rig import sections
from model.rig.actuator_keys import KINDS
from model.rig.rig_file import load_rig
from model.structure.materials import KNOWN_MATERIALS

ROOT = Path(model.__file__).parent.parent
PAGE = (ROOT / "docs" / "reference" / "rig.md").read_text("utf-8")


def test_tables_of_keys_are_those_of_the_sections() -> None:
    """Of every section; unit, default, limits and meaning of a key."""
    every = {each for _, each in inspect.getmembers(sections, inspect.isclass)}
    every |= {*KINDS.values()}
    assert {each for each in every if issubclass(each, Section)} - {Section} == {
        *rig_page.SECTIONS.values()
    }
    for row in (
        "| `thickness` | m | required, or `layers` | at least 1e-06, at most 1 | at most the",
        "| `stroke` | m | 0.1 mm | above 0, at most 0.01 | amplitude of its base at level 1,",
        "| `channel` | | none | 0 to 255 | its channel;",
        "| `bond` | | `full` | `full`, `none` | whether",
        "| `frequency` | Hz | `[40, 500]` | at least 1, at most 2000 | lowest and highest",
        "| `resonance_is` | | required with `resonance` | `free`, `mounted` | of which",
        "| `kind` | | none | `foam`, `rubber` | of a foot",
        "| `E` | Pa | required, or those with a grain | at least 1000, at most 1e+13 | Young's",
    ):
        assert f"\n{row}" in PAGE


def test_page_has_a_minimal_rig_that_loads(tmp_path):
    """The rig that the page prints loads, with three ERAs."""
    path = tmp_path / "rig.yaml"
    path.write_text(re.search(r"```yaml\n(.*?)```", PAGE, re.DOTALL)[1], encoding="utf-8")
    assert [era.name for era in load_rig(path).eras] == ["SW", "SE", "N"]


def test_page_lists_the_known_materials():
    """By name, all of them and no other."""
    (names,) = re.findall(r"Materials by name are (.+?);", PAGE, re.DOTALL)
    assert re.findall(r"`([\w-]+)`", names) == [*KNOWN_MATERIALS]


def test_choices_of_a_key_that_may_be_left_out() -> None:
    """They are in its row, as those of a key with a default are."""
    assert "| `kind` | | none | `foam`, `rubber` |" in rig_page.PARTS["supports"]()
    assert "| `magnet` | | `free` | `free`, `held` |" in rig_page.PARTS["exciters"]()
