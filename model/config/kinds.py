"""Kinds of configuration files that `era config` knows: rigs, and what other packages bring.

A kind is an entry point of the group `era_haptics.config_kinds`: an object as `ConfigKind`, under
its name. Files say what they are by their keys, so that nobody has to.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Protocol

from model.config.document import Document
from model.errors import InputError

GROUP = "era_haptics.config_kinds"
USUAL = "rig"


@dataclass(frozen=True)
class Good:
    """A file that can be used: what it is, in a line, and what to be warned of."""

    line: str
    warnings: Sequence[str] = ()


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


def kind_called(name: str) -> ConfigKind:
    """The kind of a name; raises InputError for none."""
    points = {point.name: point for point in _points()}
    if name not in points:
        raise InputError(
            f"there is no kind {name!r} of configuration; known are {', '.join(sorted(points))}"
        )
    return _load(points[name])


def kind_of(document: Document) -> ConfigKind:
    """The kind that a document is meant to be: a rig, unless another kind knows it for its own."""
    for point in sorted(_points(), key=lambda point: point.name):
        if point.name != USUAL and (kind := _load(point)).recognises(document):
            return kind
    return kind_called(USUAL)


def _points() -> Iterable[EntryPoint]:
    return entry_points(group=GROUP)


def _load(point: EntryPoint) -> ConfigKind:
    kind: ConfigKind = point.load()
    return kind
