"""A table in service that follows the settled patterns of its plate.

A `LearnedTable` follows a `LivePlate`, says in words how the plate is known, and keeps in a file
what was learned. It works in the process of the estimator.
"""

import json
import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from model.answer.plan import prepare_answers
from model.arrays import FloatArray
from model.errors import InputError
from model.estimate.following import BY_MASS, LivePlate, PlateEstimate, SettledPattern
from model.estimate.forward import Sensor
from model.files.array_file import (
    UNREADABLE,
    array_names,
    read_arrays,
    remove_partial,
    write_arrays,
)
from model.files.output_paths import begins_with
from model.rig.rig import Rig, Uncertainty
from model.table.table import LocalizationTable
from model.table.table_file import table_following

_IDENTIFIED = 0.5  # of the thickness error of a plate that was not measured

_HELD = "the plate is not as known; the next patterns tell what has changed"
_CHANGED_REMEDY = (
    "run era rig check, and look for a loose mount, a crack or something on the plate; then "
    "identify it (era rig identify), or discard what was learned (era forget)"
)
_IDENTIFY = "identify the plate (era rig identify)"
_MASS_REMEDY = "take away what lies on the plate, or run era rig check"

_VERSION = 3
_TYPES = {"header": "|u1", "x": "<f8", "covariance": "<f8"}
_MAX_BYTES = 1 << 24


@dataclass(frozen=True, eq=False)
class PlateReport:
    """The plate as a learned table knows it, after its start or a pattern."""

    state: Literal["following", "changed", "off"]
    cause: str
    remedy: str | None
    is_alarm: bool = False
    """Whether the pattern is not of the plate as known."""
    table: LocalizationTable | None = None
    """Corrected table, prepared for its first touch; None: answers stay as they are."""
    note: str = ""
    """A line for the log; else ""."""
    lying: tuple[float, float, float] | None = None
    """As `PlateEstimate.lying`."""


class LearnedTable:
    """A table in service, corrected by the settled patterns of its plate; raises InputError.

    table: of the rig as built, never changed; sensors: those that readings come from; drive_mode:
    of the questions that answers are prepared for; file: keeps what is learned. One that is
    damaged, of another plate, or of one that no table can follow is renamed.
    """

    def __init__(
        self,
        rig: Rig,
        table: LocalizationTable,
        sensors: Sequence[Sensor],
        drive_mode: str,
        file: Path,
    ) -> None:
        self._table, self._drive_mode, self._file = table, drive_mode, file
        known = replace(PlateEstimate.of_rig(rig, sensors), why_off=why_only_alarms(rig))
        self.live = LivePlate(known)
        self.current = table
        """The table as corrected so far."""
        self._cause, self._alarms = "the plate is followed from the rig as built on", 0
        self._note, self._is_kept = "", True
        remove_partial(file)
        try:
            if file.exists():
                self._resume(known)
        except ValueError as error:  # InputError and LinAlgError are such
            self._note = f"learning anew: {error}; {_set_aside(file)}"

    def _resume(self, known: PlateEstimate) -> None:
        """Resume with what the file holds; the plate has drifted since it was written."""
        header, x, covariance = load_learned(self._file, table=self._table.fingerprint)
        if (header["names"], header["base"]) != _identity(known):
            raise InputError(
                f"{self._file}: parameters must be those of this rig and its sensors; remove the "
                "file to learn anew"
            )
        then = clock.monotonic() - max(clock.time() - self._file.stat().st_mtime, 0.0)
        known = replace(known, x=x, covariance=covariance, time=then, change=header["change"])
        known = replace(known, lying=header.get("lying"))
        self.current, self.live = self._followed(known), LivePlate(known)
        self._cause = "the plate is followed from what was learned before on"

    def start(self) -> tuple[PlateReport, LocalizationTable]:
        """Report what was learned before, with the cautious table."""
        found = None if self.current is self._table else self.current
        return self._report(found, note=self._note), self._cautious()

    def take(self, pattern: SettledPattern) -> PlateReport:
        """Take a settled pattern, and correct the table by it.

        One without readings, or one that leads to a plate that no table can follow, is not used,
        and a note says so: what was known before is restored, suspect patterns are discarded.
        """
        before = self.live.known
        try:
            if not np.isfinite(pattern.values).all() or not np.any(pattern.values):
                raise InputError("readings must be finite and not all 0, got others")
            found, known = self.live.take(pattern), self.live.known
            is_new = known.x is not before.x or bool(known.change) != bool(before.change)
            table = self._followed(known) if is_new else None
        except Exception as error:
            self.live = LivePlate(before)
            if not isinstance(error, ValueError):  # InputError and LinAlgError are such
                raise
            return self._report(None, note=f"a pattern is not used: {error}")
        if table is not None:
            self.current, self._is_kept = table, False
        self._alarms += found.alarm
        if found.explanation is not None:
            self._cause = f"the plate has changed: {found.explanation}"
        elif found.is_held:
            self._cause = _HELD
        elif found.alarm:
            self._cause = f"the plate is not as the rig says (alarm {self._alarms})"
        elif before.change or self._cause == _HELD:
            self._cause = "the plate is again as it was"
        return self._report(table, is_alarm=found.alarm)

    def keep(self) -> tuple[str, LocalizationTable | None]:
        """Write what was learned since; return why it could not be, and the cautious table of it.

        The next call tries again, with the same reason once only. None: the table is as before.
        """
        if self._is_kept:
            return "", None
        before, self._note = self._note, ""
        try:
            save_learned(self._file, self.live.known, table=self._table.fingerprint)
        except OSError as error:
            self._note = f"{self._file}: not written: {error}"
        self._is_kept = not self._note
        return "" if self._note == before else self._note, self._cautious()

    def _followed(self, known: PlateEstimate) -> LocalizationTable:
        """Return the table for a plate as it is known; raises InputError if none can follow it."""
        if not np.isfinite(known.x).all() or not np.isfinite(known.covariance).all():
            raise InputError("parameters must be finite, got others")
        return table_following(self._table, known.cautious_rig if known.change else known.rig)

    def _report(
        self, table: LocalizationTable | None, *, is_alarm: bool = False, note: str = ""
    ) -> PlateReport:
        known, cause = self.live.known, self._cause
        table = None if table is None else self._prepared(table)
        if known.change:
            remedy = _MASS_REMEDY if known.lying else _CHANGED_REMEDY
            changed = PlateReport("changed", known.change, remedy, is_alarm, table, note)
            return replace(changed, lying=known.lying)
        if known.why_off:
            cause = cause if self._alarms else f"answers stay as built: {known.why_off}"
            return PlateReport("off", cause, _IDENTIFY, is_alarm, table, note)
        by_mass = _MASS_REMEDY if BY_MASS in cause else None
        return PlateReport("following", cause, by_mass, is_alarm, table, note)

    def _cautious(self) -> LocalizationTable:
        return self._prepared(table_following(self._table, self.live.known.cautious_rig))

    def _prepared(self, table: LocalizationTable) -> LocalizationTable:
        table = replace(table)  # not the one that the next correction starts from
        prepare_answers(table, self._drive_mode)
        _ = table.in_time
        return table


def why_only_alarms(rig: Rig) -> str:
    """Return why patterns may not correct answers of a rig, or nothing.

    Corrections of a plate that was never measured would put its form errors into other parameters.
    """
    stated, built = rig.uncertainty.thickness, Uncertainty().thickness
    if not stated:
        return "the rig's uncertainty takes its thickness as known exactly"
    if stated > _IDENTIFIED * built:
        return (
            f"the rig's uncertainty of thickness must be at most {100 * _IDENTIFIED * built:g} %, "
            f"that of a plate that was measured, got {100 * stated:g} %"
        )
    return ""


def _set_aside(file: Path) -> str:
    """Rename a file that is not resumed; return what was done, or why not."""
    old = file.with_name(f"{file.name}.old")
    try:
        file.replace(old)
    except OSError as error:
        return f"it could not be renamed and will be replaced: {error}"
    return f"it is {old} now"


def _identity(known: PlateEstimate) -> tuple[list[str], str]:
    """Names of the parameters of a plate, and fingerprint of the rig that they count from."""
    return [*known.model.space.names], known.model.rig.fingerprint


def save_learned(file: Path, known: PlateEstimate, *, table: str) -> None:
    """Write what was learned for a table by its fingerprint, atomically; raises OSError."""
    names, base = _identity(known)
    header = {"version": _VERSION, "table": table, "base": base, "names": names}
    text = json.dumps({**header, "change": known.change, "lying": known.lying})
    encoded = np.frombuffer(text.encode(), dtype=np.uint8)
    write_arrays(file, {"header": encoded, "x": known.x, "covariance": known.covariance})


def load_learned(file: Path, *, table: str) -> tuple[dict[str, Any], FloatArray, FloatArray]:
    """Read what was learned for a table by its fingerprint: header, parameters, covariance.

    Raises InputError for a damaged file, another version, or another table.
    """
    try:
        arrays = read_arrays(file, _TYPES, max_bytes=_MAX_BYTES)
        header = json.loads(arrays["header"].tobytes())
        x, covariance = arrays["x"], arrays["covariance"]
        version, p = header["version"], len(header["names"])
        of, _, _ = header["table"], header["base"], header["change"]
    except (*UNREADABLE, KeyError, TypeError) as error:
        why = (isinstance(error, OSError) and error.strerror) or error
        raise InputError(
            f"{file}: must be a learned plate: {why}; remove the file to learn anew"
        ) from error
    if version != _VERSION or x.shape != (p,) or covariance.shape != (p, p):
        raise InputError(f"{file}: version must be {_VERSION}; remove the file to learn anew")
    if not (np.isfinite(x).all() and np.isfinite(covariance).all()):
        raise InputError(f"{file}: numbers must be finite; remove the file to learn anew")
    if of != table:
        raise InputError(
            f"{file}: must be learned for this table, got one of another rig; remove the file to "
            "learn anew"
        )
    return header, x, covariance


def was_learned(file: Path) -> bool:
    """Whether a file is a learned plate of any version, or may have been before it was damaged."""
    if not begins_with(file, b"PK") or file.stat().st_size > _MAX_BYTES:
        return False
    try:
        return "covariance" in array_names(file, max_bytes=_MAX_BYTES)
    except UNREADABLE:
        return True
