"""Strengths: a gain on all that a touch source or a client brings, kept by its name."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pydantic import ConfigDict, NonPositiveFloat, TypeAdapter, ValidationError

from model.errors import InputError
from model.files.array_file import whole_or_nothing

MAX_SOURCES = 64
"""How many touch sources are remembered."""

_GAINS = TypeAdapter(dict[str, NonPositiveFloat], config=ConfigDict(allow_inf_nan=False))


class Strengths:
    """Gains [dB] by name, 0 at most, which is what holds where none is set.

    A name is that of a touch input of the configuration, of a sender there (`table:left@10.0.0.2`),
    of a touch source as its client calls it, or of a client. At a finger the gains of its names and
    of the client that plays its effect add up, each once.
    """

    def __init__(self, gains_db: Mapping[str, float] | None = None) -> None:
        self.gains_db = gains_db or {}
        """Those that are set, by name."""
        self.clients: Callable[[], Sequence[tuple[str, str]]] = tuple
        """The clients: the origin with which the keys of their sources begin, and their names."""
        self.sources: Sequence[str] = ()
        """Names of touch sources that had fingers."""

    def note(self, source: str) -> None:
        """Note that a touch source has a finger."""
        name, _ = self._names_of(source)
        self.sources = [*dict.fromkeys([*self.sources, name])][-MAX_SOURCES:]

    def gain_db(self, source: str, player: str | None = None) -> float:
        """Return the gain at a finger of a source; player: the client that plays its effect."""
        names = {*self._names_of(source), player} if self.gains_db else ()
        return sum([gain for name, gain in self.gains_db.items() if name in names])

    def set(self, name: str, gain_db: float) -> None:
        """Set the gain [dB] of a name from now on; 0 removes it."""
        gains = {**self.gains_db, name: gain_db}
        self.gains_db = {name: gain for name, gain in gains.items() if gain}

    def save(self, file: Path) -> None:
        """Write the gains that are set, atomically; raises OSError."""
        with whole_or_nothing(file) as stream:
            stream.write(json.dumps(self.gains_db, indent=1).encode())

    def _names_of(self, source: str) -> tuple[str, str]:
        """Return the two names of a source, its own first."""
        first, second, *rest = f"{source}::".split(":", 2)
        client = dict(self.clients()).get(f"{first}:{second}")
        return (source, first) if client is None else (rest[0][:-2], client)


def read_strengths(file: Path | None) -> Mapping[str, float]:
    """Read the gains [dB] of a file, none where there is no file; raises InputError."""
    try:
        return (
            _GAINS.validate_json(file.read_bytes(), strict=True) if file and file.exists() else {}
        )
    except (ValidationError, OSError) as error:
        raise InputError(
            f"{file}: must have strengths of 0 dB or less by name; correct or remove it"
        ) from error
