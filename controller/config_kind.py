"""`ConfigKind`: how `era config` recognizes, checks and writes one kind of configuration file."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from model.config.document import Document


@dataclass(frozen=True)
class CheckedFile:
    """A valid configuration file."""

    line: str
    """Summary in one line."""

    warnings: Sequence[str] = ()
    data: Mapping[str, Any] = field(default_factory=dict)
    """Further entries of the report as JSON."""
    rows: Sequence[str] = ()
    """Further lines, after the warnings."""


@dataclass(frozen=True)
class ConfigKind:
    """One kind of configuration file."""

    title: str
    recognises: Callable[[Document], bool]
    """Whether a document is of this kind."""

    check: Callable[[Document], CheckedFile]
    """Check a file and the files that it names; raises ConfigError."""

    example_file: Path
    """A commented file to start from."""

    keys: Callable[[], dict[str, Any]]
    """JSON schema of its keys, without the title."""

    def example(self) -> str:
        """Return the text of a commented file to start from."""
        return self.example_file.read_text(encoding="utf-8")

    def schema(self) -> dict[str, Any]:
        """Return the JSON schema for editors."""
        draft = "https://json-schema.org/draft/2020-12/schema"
        return {"$schema": draft, **self.keys(), "title": self.title}
