"""The reference of surface layouts against what layouts may say."""

from pathlib import Path

import pytest

from controller.effects.band import TunedSection
from controller.effects.buzz import Buzz
from controller.effects.click import Click
from controller.effects.detents import Detents
from controller.effects.dial import Dial
from controller.effects.effect import Effect
from controller.effects.layout_file import (
    CircleSection,
    LayoutSection,
    RectangleSection,
    RegionSection,
)
from controller.effects.ramp import Ramp
from controller.effects.texture import Texture
from key_tables import key_rows

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "effects.md"
KINDS: tuple[type[Effect], ...] = (Click, Buzz, Ramp, Texture, Detents, Dial)
PARTS = {"rectangle": RectangleSection, "circle": CircleSection}

KEYS = {
    "The file": set(LayoutSection.model_fields),
    "Effects": {
        *("kind", *Effect.model_fields),
        *(
            f"{kind.kind}.{key}"
            for kind in KINDS
            for key in kind.model_fields.keys() - Effect.model_fields.keys()
        ),
    },
    "Regions": {
        *(*RegionSection.model_fields, *TunedSection.model_fields),
        *(f"{part}.{key}" for part, section in PARTS.items() for key in section.model_fields),
    },
}


@pytest.mark.parametrize("heading", KEYS)
def test_every_key_is_documented_and_no_other(heading: str) -> None:
    """The table of a section names its keys."""
    assert set(key_rows(PAGE.read_text("utf-8"), heading)) == KEYS[heading]
