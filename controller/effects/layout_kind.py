"""Surface layouts as a kind of configuration file of `era config`."""

from pathlib import Path
from typing import Any

from controller.effects.layout_file import LayoutSection, is_layout_document, layout_of
from controller.effects.registry import effect_kind, effect_kinds
from model.config.document import Document
from model.config.kinds import CheckedFile


class LayoutKind:
    """A surface layout."""

    def recognises(self, document: Document) -> bool:
        """Whether a document is a surface layout."""
        return is_layout_document(document)

    def check(self, document: Document) -> CheckedFile:
        """Read a layout; raises ConfigError. Its fit on a plate shows in the daemon's file."""
        layout = layout_of(document, None)
        return CheckedFile(
            f"good: regions {', '.join(region.name for region in layout.regions) or 'none'}; "
            f"effects {', '.join(layout.effects)}; elsewhere {layout.elsewhere or 'nothing'}. "
            "Check the daemon's file that names it to see whether it fits the plate",
            layout.warnings(),
        )

    def example(self) -> str:
        """Return a layout with every key explained."""
        return Path(__file__).with_name("example.yaml").read_text(encoding="utf-8")

    def schema(self) -> dict[str, Any]:
        """Return the JSON schema for editors; the kinds of effects are under `$defs`."""
        schema = LayoutSection.model_json_schema()
        kinds = {f"effect {name}": effect_kind(name).model_json_schema() for name in effect_kinds()}
        return {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            **schema,
            "$defs": {**schema.get("$defs", {}), **kinds},
            "title": "A surface layout of era-haptics",
        }


LAYOUT = LayoutKind()
