"""Strengths: gains of touch sources, clients and regions, stored by name.

The types of names and gains check their bounds, both in the API and in the file.
"""

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from model.config.document import read_bytes
from model.errors import InputError, shown
from model.files.array_file import whole_or_nothing

SourceName: TypeAlias = Annotated[str, Field(min_length=1, max_length=2048)]
"""Type of a name with a strength; escaped sender names can be long."""

GainDb: TypeAlias = Annotated[float, Field(ge=-40, le=0)]
"""Type of the gain [dB] of a name."""

MAX_NAMES = 64
"""Maximum number of remembered touch sources, and of names with a gain."""

UNNAMED = re.compile(r"gateway|era|web:\d+ .*|http .*")
"""Pattern of clients without a strength: commands, and browsers without a name."""

_MAX_SIZE = 1 << 21  # bytes; for this many names of maximum length, with every character escaped
_Gains = Annotated[dict[SourceName, GainDb], Field(max_length=MAX_NAMES)]
_GAINS = TypeAdapter(_Gains, config=ConfigDict(allow_inf_nan=False))


class Strengths:
    """Gains [dB] by name, at most 0, default 0.

    A name refers to a configured touch input, a sender there (`table:tuio:10.0.0.2/left`), a touch
    source as named by its client, a client, or a region of a layout. At a finger, the gains of its
    names, of its region and of the client that plays its effect add up, each once.
    """

    def __init__(self, gains_db: Mapping[str, float] | None = None) -> None:
        self.gains_db = gains_db or {}
        """Gains that were set, by name, including 0."""
        self.clients: Sequence[tuple[str, str]] = ()
        """Prefix of the source keys and name of each client.

        The API updates it, so that the control loop calls no API code.
        """
        self.sources: Sequence[str] = ()
        """Names of touch sources that had fingers."""

    def note(self, source: str) -> None:
        """Record that a touch source has a finger."""
        name, _ = self._names_of(source)
        self.sources = [*dict.fromkeys([*self.sources, name])][-MAX_NAMES:]

    def gain_db(self, source: str, player: str | None = None, region: str | None = None) -> float:
        """Return the gain [dB] at a finger of a source.

        player: the client that plays its effect; region: the region of the effect.
        """
        if not self.gains_db:
            return 0
        names = {*self._names_of(source), player, region}
        return sum([gain_db for name, gain_db in self.gains_db.items() if name in names])

    def set(self, name: str, gain_db: float) -> None:
        """Set the gain [dB] of a name.

        With too many names, removes the oldest with a gain of 0, or raises InputError if none has.
        """
        gains = {**self.gains_db, name: gain_db}
        if len(gains) > MAX_NAMES:
            unused_names = [stored_name for stored_name, gain in gains.items() if not gain]
            if not unused_names:
                raise InputError(
                    f"strengths must have at most {MAX_NAMES} names, got one more; set another one "
                    "to 0 dB first"
                )
            del gains[unused_names[0]]
        self.gains_db = gains

    def save(self, file: Path) -> None:
        """Write all gains atomically; raises OSError."""
        with whole_or_nothing(file) as stream:
            stream.write(json.dumps(self.gains_db, indent=1).encode())

    def _names_of(self, source: str) -> tuple[str, str]:
        """Return the two names of a source: its own, and its input's or client's."""
        for prefix, client in self.clients:
            if source.startswith(f"{prefix}:"):
                return source.removeprefix(f"{prefix}:"), client
        return source, source.partition(":")[0]


def read_strengths(file: Path | None) -> Mapping[str, float]:
    """Read gains [dB] by name from a file; a missing file is empty. Raises InputError."""
    if file is None or not os.path.lexists(file):
        return {}
    text = read_bytes(file, _MAX_SIZE, is_for="remove it", give="a file of strengths")
    try:
        # A number with many digits becomes infinite, and is then rejected.
        gains = json.loads(text, object_pairs_hook=_unique, parse_int=float)
        return _GAINS.validate_python(gains, strict=True)
    except InputError as error:
        raise InputError(f"{file}: {error}; correct or remove it") from error
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{file}: is not JSON ({error}); correct or remove it") from error
    except ValidationError as error:
        raise InputError(
            f"{file}: must have strengths of -40 to 0 dB by name, {MAX_NAMES} at most; correct or "
            "remove it"
        ) from error


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make an object of JSON; raises InputError for a name that is repeated."""
    values = dict[str, Any]()
    for name, value in pairs:
        if name in values:
            raise InputError(f"strengths must have each name once, got {shown(name)} twice")
        values[name] = value
    return values
