"""Strengths: a gain on all that a touch source or a client brings, kept by its name."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from model.errors import InputError
from model.files.array_file import whole_or_nothing

MIN_GAIN_DB = -40.0
"""Lowest strength [dB]; the highest, 0, is what layout and limits allow."""

MAX_STRENGTHS = 64
"""How many names may have a strength, and how many touch sources are remembered."""

_GAINS = TypeAdapter(
    Annotated[
        dict[str, Annotated[float, Field(ge=MIN_GAIN_DB, le=0)]], Field(max_length=MAX_STRENGTHS)
    ],
    config=ConfigDict(allow_inf_nan=False),
)


class Strengths:
    """Gains [dB] by name, -40 to 0; 0 where none is set.

    A name is that of a touch input of the configuration, of a sender there (`table:left@10.0.0.2`),
    of a touch source as its client calls it, or of a client. At a finger the gains of its names and
    of the client that plays its effect add up, each once. file: where they are kept, None for as
    long as this object lives. Raises InputError for a file of something else.
    """

    def __init__(self, file: Path | None = None) -> None:
        self._file = file
        self.gains_db: Mapping[str, float] = {} if file is None else read_strengths(file)
        """Those that are set, by name."""
        self.clients: dict[str, str] = {}
        """Names of clients with touch sources, by the origin with which the keys of these begin."""
        self.sources: Mapping[str, None] = {}
        """Names of touch sources that had fingers, the newest last."""

    def note(self, source: str) -> None:
        """Note that a touch source has a finger."""
        name, _ = self._names_of(source)
        if name not in self.sources:
            self.sources = dict.fromkeys([*self.sources, name][-MAX_STRENGTHS:])

    def gain_db(self, source: str, player: str | None = None) -> float:
        """Return the gain at a finger of a source; player: the client that plays its effect."""
        if not self.gains_db:
            return 0.0
        names = {*self._names_of(source), player}
        return sum([gain for name, gain in self.gains_db.items() if name in names])

    def set(self, name: str, gain_db: float) -> None:
        """Set the gain [dB] of a name from now on; 0 removes it."""
        gains = {**self.gains_db, name: gain_db}
        self.gains_db = {name: gain for name, gain in gains.items() if gain}

    def save(self) -> None:
        """Write the gains, if they are kept, atomically; raises OSError."""
        if self._file is not None:
            with whole_or_nothing(self._file) as stream:
                stream.write(json.dumps(self.gains_db, indent=1).encode())

    def _names_of(self, source: str) -> tuple[str, str]:
        """Return the two names of a source, its own first."""
        first, second, *rest = f"{source}::".split(":", 2)
        client = self.clients.get(f"{first}:{second}")
        return (source, first) if client is None else (rest[0][:-2], client)


def read_strengths(file: Path) -> Mapping[str, float]:
    """Read the gains [dB] of a file, none if it does not exist; raises InputError."""
    try:
        return _GAINS.validate_json(file.read_bytes(), strict=True)
    except FileNotFoundError:
        return {}
    except (ValidationError, OSError) as error:
        raise InputError(
            f"{file}: must have strengths of {MIN_GAIN_DB:g} to 0 dB by name; correct or remove it"
        ) from error
