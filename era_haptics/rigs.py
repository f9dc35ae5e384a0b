"""Rigs made in a program, by the keys of a rig file, and written to one."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from era_haptics.arguments import expect_rig
from model.arguments import expect_path
from model.config.document import parse_document
from model.config.sections import Section, Validation
from model.files.array_file import whole_or_nothing
from model.files.replacing import check_ending
from model.rig.file import rig_of
from model.rig.from_keys import keys_of, rig_text
from model.rig.rig import Rig
from model.rig.sections import EraSection, PlateSection


class _Keys(dict[str, Any]):
    """Keys of a section of a rig file."""

    _section: ClassVar[type[Section]]

    def __init__(self, **keys: Any) -> None:
        document = keys_of(f"era.{type(self).__name__}", keys)
        Validation(document, self._section).finish()
        super().__init__(document.data)


class Plate(_Keys):
    """A plate by the keys of `plate` in a rig file, values with units or SI numbers.

    `Plate(length="12 in", width="9 in", thickness=0.0015, material="aluminium")`. Raises
    ConfigError, an InputError, with all problems.
    """

    _section = PlateSection


class Era(_Keys):
    """An ERA by the keys below `eras` in a rig file.

    `Era(at=(0, 0), stiffness="17 kN/m", amplifier="main", channel=0)`. Raises ConfigError.
    """

    _section = EraSection


def rig(
    plate: Mapping[str, Any],
    eras: Mapping[str, Mapping[str, Any]],
    *,
    amplifiers: Mapping[str, Mapping[str, Any]],
    masses: Mapping[str, Mapping[str, Any]] | None = None,
    mesh: str | None = None,
    limits: Mapping[str, Any] | None = None,
    uncertainty: Any = None,
    fingertip: Any = None,
    threshold: str | None = None,
) -> Rig:
    """Make a rig of a `Plate` and an `Era` for each name, as of a file with these sections.

    amplifiers: `{"main": {"url": "sim://"}}`; uncertainty, fingertip: also an `Uncertainty` and a
    `Fingertip`, `"none"` for weightless ones. What is left out has the file's default. Raises
    ConfigError with all problems, by argument and key.
    """
    sections = {
        "plate": plate,
        "eras": eras,
        "amplifiers": amplifiers,
        "masses": masses,
        "mesh": mesh,
        "limits": limits,
        "uncertainty": uncertainty,
        "fingertip": fingertip,
        "threshold": threshold,
    }
    return rig_of(keys_of("era.rig", sections))


def save_rig(rig: Rig, path: Path | str) -> None:
    """Write a rig file that reads back as this rig: its file's text, or its keys.

    Of a fitted rig, as of `calibrate`, the values are rounded to six digits. Raises InputError for
    a rig that no file states, OSError if the file cannot be written.
    """
    expect_rig(rig)
    place = expect_path(path, what="path")
    check_ending(place, ".yaml", ".yml", what="a rig file")
    text = rig_text(rig)
    rig_of(parse_document(str(place), text))
    with whole_or_nothing(place) as stream:
        stream.write(text.encode())
