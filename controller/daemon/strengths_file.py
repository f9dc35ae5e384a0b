"""The file in which the daemon keeps strengths: gains [dB] by name, as JSON."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from controller.api.methods import MIN_GAIN_DB
from controller.effects.strengths import MAX_STRENGTHS, Strengths
from model.errors import InputError
from model.files.array_file import whole_or_nothing

_GAINS = TypeAdapter(
    Annotated[
        dict[str, Annotated[float, Field(ge=MIN_GAIN_DB, le=0)]], Field(max_length=MAX_STRENGTHS)
    ],
    config=ConfigDict(allow_inf_nan=False),
)


def read_strengths(file: Path | None) -> Mapping[str, float]:
    """Read the gains [dB] of a file, none where there is no file; raises InputError."""
    try:
        return {} if file is None else _GAINS.validate_json(file.read_bytes(), strict=True)
    except FileNotFoundError:
        return {}
    except (ValidationError, OSError) as error:
        raise InputError(
            f"{file}: must have strengths of {MIN_GAIN_DB:g} to 0 dB by name; correct or remove it"
        ) from error


def save_strengths(strengths: Strengths, file: Path) -> None:
    """Write the gains that are set now, atomically; raises OSError."""
    with whole_or_nothing(file) as stream:
        stream.write(json.dumps(dict(strengths.gains_db), indent=1).encode())
