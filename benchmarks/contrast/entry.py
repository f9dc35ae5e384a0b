"""An entry of the contrast benchmark: patterns for sets of the data set, as a JSON file.

    {"benchmark": "era-localization", "version": 1, "name": "time reversal",
     "patterns": {"paper_plate/1-00": {"SW": [250, 0.8, -90.0], ...}, ...}}

By set, each driven ERA with its frequency [Hz], level 0..1 of its stroke, and phase [degrees]: its
base moves by level * stroke * sin(2 pi frequency t + phase).
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from benchmarks.contrast.data_set import VERSION, DataSet, data_set
from model.errors import InputError
from model.rig.rig import Rig
from model.vibration import Excitation, Tone
from registry.wording import first_problem

MAX_BYTES = 16 << 20


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    benchmark: Literal["era-localization"]
    version: int
    name: str
    patterns: dict[str, dict[str, tuple[float, float, float]]]


def read_entry(path: Path) -> tuple[str, Mapping[str, Excitation]]:
    """Read the name and the excitations by set of a file; raises InputError naming set and ERA."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: entry must have at most {MAX_BYTES >> 20} MiB")
        entry = _Entry.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except ValidationError as error:
        key, rule = first_problem(error)
        raise InputError(f"{path}: {key or 'entry'}: {rule}") from None
    if entry.version != VERSION:
        raise InputError(f"{path}: version must be {VERSION}, got {entry.version}")
    rigs = _rigs(data_set())
    excitations = {}
    for name, drives in entry.patterns.items():
        if name not in rigs:
            raise InputError(f"{path}: patterns: the data set has no contact set {name!r}")
        try:
            excitations[name] = _excitation(rigs[name], drives)
        except InputError as error:
            raise InputError(f"{path}: patterns.{name}: {error}") from None
    return entry.name, excitations


def _rigs(found: DataSet) -> dict[str, Rig]:
    return {each.name: plate.rig for plate in found.plates.values() for each in plate.sets}


def _excitation(rig: Rig, drives: Mapping[str, tuple[float, float, float]]) -> Excitation:
    """Tones by ERA, those of level 0 left out."""
    strokes = rig.full_levels
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    tones = {}
    for name, (frequency, level, phase) in drives.items():
        if name not in strokes:
            raise InputError(f"the rig has no ERA {name!r}; it has {', '.join(strokes)}")
        if not low <= frequency <= high:
            raise InputError(
                f"frequency of {name} must be {low:g} to {high:g} Hz, got {frequency:g}"
            )
        if not 0 <= level <= 1:
            raise InputError(f"level of {name} must be 0 to 1, got {level:g}")
        if level > 0:
            tones[name] = Tone(frequency, level * strokes[name], math.radians(phase))
    if not tones:
        raise InputError("must drive at least one ERA")
    return tones
