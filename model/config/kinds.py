"""Kinds of configuration files for `era config`: rigs, and those of other packages.

The keys of a file determine its kind.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any, Protocol, cast

from model.config.document import Document
from model.errors import InputError
from registry.suggestions import did_you_mean

DEFAULT_KIND = "rig"


@dataclass(frozen=True)
class CheckedFile:
    """A valid configuration file: one line about it, and warnings."""

    line: str
    warnings: Sequence[str] = ()


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


_KINDS = {
    "daemon": "controller.daemon.config_kind:DAEMON",
    "layout": "controller.effects.layout_kind:LAYOUT",
    DEFAULT_KIND: "model.rig.kind:RIG",
}
"""Where each is, by name: this package does not import those above it."""


def kind_called(name: str) -> ConfigKind:
    """Return the kind of a name; raises InputError for an unknown one."""
    if name not in _KINDS:
        suggested = did_you_mean(name, _KINDS)
        raise InputError(
            f"unknown kind of configuration {name[:40]!r}; {suggested}known are {', '.join(_KINDS)}"
        )
    return cast(ConfigKind, resolve_name(_KINDS[name]))


def kind_of(document: Document) -> ConfigKind:
    """Return the kind of a document: a rig unless another kind recognises it."""
    for name in _KINDS:
        if name != DEFAULT_KIND and (kind := kind_called(name)).recognises(document):
            return kind
    return kind_called(DEFAULT_KIND)
