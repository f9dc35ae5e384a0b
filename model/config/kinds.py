"""Kinds of configuration files that `era config` knows: rigs, and what other packages bring.

A kind is an entry point of the group `era_haptics.config_kinds`: an object as `ConfigKind`, under
its name. Files say what they are by their keys, so that nobody has to.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from model.config.document import Document
from model.errors import InputError
from registry.plugins import Instance, PluginRegistry

USUAL = "rig"


@dataclass(frozen=True)
class Good:
    """A file that can be used: what it is, in a line, and what to be warned of."""

    line: str
    warnings: Sequence[str] = ()


@runtime_checkable
class ConfigKind(Protocol):
    """One kind of configuration file."""

    def recognises(self, document: Document) -> bool:
        """Whether this document is meant to be one."""

    def check(self, path: Path) -> Good:
        """Read one with all that it names; raises ConfigError for one that cannot be used."""

    def example(self) -> str:
        """A commented one to begin with."""

    def schema(self) -> dict[str, Any]:
        """Its JSON schema, for editors."""


_KINDS: PluginRegistry[ConfigKind] = PluginRegistry(
    "kind of configuration", "era_haptics.config_kinds", Instance(ConfigKind), error=InputError
)


def kind_called(name: str) -> ConfigKind:
    """The kind of a name; raises InputError for none."""
    return _KINDS.find(name)


def kind_of(document: Document) -> ConfigKind:
    """The kind that a document is meant to be: a rig, unless another kind knows it for its own."""
    for name in _KINDS.names():
        if name != USUAL and (kind := kind_called(name)).recognises(document):
            return kind
    return kind_called(USUAL)
