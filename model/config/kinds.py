"""Kinds of configuration files for `era config`: rigs, and those of other packages.

A kind is an entry point of the group `era_haptics.config_kinds` that leads to a `ConfigKind`. The
keys of a file determine its kind.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from model.config.document import Document
from model.errors import InputError
from registry.plugins import Instance, PluginRegistry

DEFAULT_KIND = "rig"


@dataclass(frozen=True)
class CheckedFile:
    """A valid configuration file: one line about it, and warnings."""

    line: str
    warnings: Sequence[str] = ()


@runtime_checkable
class ConfigKind(Protocol):
    """One kind of configuration file."""

    def recognises(self, document: Document) -> bool:
        """Whether a document is of this kind."""

    def check(self, document: Document) -> CheckedFile:
        """Check a file and the files that it names; raises ConfigError."""

    def example(self) -> str:
        """A commented file to start from."""

    def schema(self) -> dict[str, Any]:
        """The JSON schema for editors."""


_KINDS: PluginRegistry[ConfigKind] = PluginRegistry(
    "kind of configuration", "era_haptics.config_kinds", Instance(ConfigKind), error=InputError
)


def kind_called(name: str) -> ConfigKind:
    """Return the kind of a name; raises InputError for an unknown one."""
    return _KINDS.find(name)


def kind_of(document: Document) -> ConfigKind:
    """Return the kind of a document: a rig unless another kind recognises it."""
    for name in _KINDS.names():
        if name != DEFAULT_KIND and (kind := kind_called(name)).recognises(document):
            return kind
    return kind_called(DEFAULT_KIND)
