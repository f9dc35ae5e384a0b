"""Surface layouts as a kind of configuration file of `era config`."""

from pathlib import Path
from typing import Any

from controller.effects.layout_file import LayoutSection, is_layout_document, layout_of
from controller.effects.registry import effect_kind, effect_kinds
from model.config.document import Document
from model.config.kinds import CheckedFile, ConfigKind


def _check(document: Document) -> CheckedFile:
    """Read a layout; raises ConfigError. Its fit on a plate shows in the daemon's file."""
    layout = layout_of(document, None)
    return CheckedFile(
        f"good: regions {', '.join(region.name for region in layout.regions) or 'none'}; "
        f"effects {', '.join(layout.effects)}; elsewhere {layout.elsewhere or 'nothing'}. "
        "Check the daemon's file that names it to see whether it fits the plate",
    )


def _keys() -> dict[str, Any]:
    """The JSON schema of a layout; the kinds of effects are under `$defs`."""
    schema = LayoutSection.model_json_schema()
    kinds = {f"effect {name}": effect_kind(name).model_json_schema() for name in effect_kinds()}
    return {**schema, "$defs": {**schema.get("$defs", {}), **kinds}}


LAYOUT = ConfigKind(
    "A surface layout of era-haptics",
    recognises=is_layout_document,
    check=_check,
    example_file=Path(__file__).with_name("example.yaml"),
    keys=_keys,
)
