"""Kinds of configuration files for `era config`: rigs, and those of other packages.

The keys of a file determine its kind.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from model.config.document import Document
from model.errors import InputError
from registry.plugins import did_you_mean

DEFAULT_KIND = "rig"


@dataclass(frozen=True)
class CheckedFile:
    """A valid configuration file."""

    line: str
    """One line about it."""

    warnings: Sequence[str] = ()
    more: Mapping[str, Any] = field(default_factory=dict)
    """Further entries of its report as data."""


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
        """A commented file to start from."""
        return self.example_file.read_text(encoding="utf-8")

    def schema(self) -> dict[str, Any]:
        """The JSON schema for editors."""
        draft = "https://json-schema.org/draft/2020-12/schema"
        return {"$schema": draft, **self.keys(), "title": self.title}


KINDS = {
    "daemon": "controller.daemon.config:DAEMON",
    "layout": "controller.effects.layout:LAYOUT",
    DEFAULT_KIND: "model.rig.rig_summary:RIG",
}
"""Where each is, by name: this package does not import those above it."""


def kind_called(name: str) -> ConfigKind:
    """Return the kind of a name; raises InputError for an unknown one."""
    if name not in KINDS:
        raise InputError(
            f"unknown kind of configuration {name[:40]!r}; {did_you_mean(name, KINDS)}"
            f"known are {', '.join(KINDS)}"
        )
    kind: ConfigKind = resolve_name(KINDS[name])
    return kind


def kind_of(document: Document) -> ConfigKind:
    """Return the kind of a document: a rig unless another kind recognises it."""
    return kind_called(_name_of(document))


def check_is_rig(document: Document) -> None:
    """Refuse another kind of file as a whole instead of reporting each unknown key."""
    if (name := _name_of(document)) != DEFAULT_KIND:
        raise InputError(
            f"{document.source}: must be a rig, got a {name} file; "
            "era config init rig.yaml  writes one"
        )


def _name_of(document: Document) -> str:
    for name in KINDS:
        if name != DEFAULT_KIND and kind_called(name).recognises(document):
            return name
    return DEFAULT_KIND
