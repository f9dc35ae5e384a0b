"""A table in service that learns its plate: settled patterns in, corrected answers out.

The parameters of an identification drift. Each settled pattern updates them, together with the
loads of its fingers, which are dropped afterwards (`model.estimate.settled_patterns`). An
update would smear a sudden change over all parameters: when innovations become unlikely, the state
goes back to where they began and is held, until the patterns since then are explained by one
change, which is then followed. Without an explanation, as for a crack or a hand that rests on the
plate, the plate counts as changed until patterns fit it again as it was.

Answers follow the plate as known after each pattern. While it counts as changed they are those of
the plate as last known, with the errors of a plate that was not measured.

The file of a learned plate holds parameters and covariance, beside the table that they correct.
"""

import hashlib
import json
import time
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.estimate.forward import ForwardModel, Sensor
from model.estimate.identify import solved_for
from model.estimate.settled_patterns import (
    PLACES,
    Alarm,
    NoiseLevel,
    Observation,
    PatternModel,
    PlateChange,
    SettledPattern,
    State,
    explain,
    update,
)
from model.estimate.space import KINDS, MODE_SHIFTS, Values, rig_with, space_of
from model.files.array_file import UNREADABLE, read_arrays, write_arrays
from model.files.output_paths import begins_with
from model.rig.rig import Rig, Uncertainty
from model.structure.modal_elasticity import lowest_elastic
from model.table.table import LocalizationTable
from model.table.table_file import table_following

_MIN_EXPLAINED, _MAX_EXPLAINED = 4, 6  # patterns that are explained together
_AFTER_ALARM = 2  # patterns before a change counts as unexplained
_CERTAIN = 12.0  # lead in cost of an explanation that is accepted early
_EVALUATIONS = 20
_FINGER = KINDS["fingers"].std

_NOT_STATED = (
    "modulus",
    "damping_each",
    "loss_exponent",
    "bolt_mass",
    "place",
    "mode_shifts",
    "mode_losses",
)
"""Kinds whose uncertainty a rig does not state."""

_VERSION = 2
_TYPES = {"header": "|u1", "x": "<f8", "covariance": "<f8", "digest": "|u1"}
_MAX_BYTES = 1 << 24


@dataclass(frozen=True, eq=False)
class PatternReport:
    """Result of one settled pattern."""

    nis: float
    """Squared innovation in its covariance."""
    count: int
    """Number of real numbers in the innovation."""
    alarm: bool
    """Whether it began an alarm; not while the plate counts as changed."""
    is_held: bool
    """Whether the state waits for an explanation."""
    explanation: PlateChange | None
    """The change that explains the held patterns, if it was found now."""


@dataclass(frozen=True, eq=False)
class PlateEstimate:
    """What is known of a plate in service."""

    before: Rig
    """The rig that parameters count from."""
    uncertainty: Uncertainty
    """Of the rig as known."""
    model: ForwardModel
    """Forward model with a spare mass."""
    state: State
    is_explained: bool = True
    """Whether an identification explains the plate, so that patterns update it, not only alarm."""
    time: float | None = None
    """Time of the state [s], from which it has drifted since; None before the first pattern."""
    change: str = ""
    """How it has changed in a way that its parameters do not follow, "" where it has not."""

    @property
    def rig(self) -> Rig:
        """The rig as it is known now."""
        values = Values.of(self.before, self.model.space, self.state.x)
        return rig_with(self.before, values, self.uncertainty)

    @classmethod
    def of_rig(cls, rig: Rig, sensors: Sequence[Sensor]) -> Self:
        """Start from a rig's `uncertainty`; gains of the sensors are not known.

        What the rig does not state counts as known as well as its thickness, as by identification.
        """
        free = solved_for(rig, rig.limits.frequency_max)
        # Counted in the deviations of a plate that was not measured, which steps are limited by.
        count = len(lowest_elastic(free.modes.eigenvalues, MODE_SHIFTS))
        space, stated = (
            space_of(rig, [each.name for each in sensors], known, masses=1, mode_count=count)
            for known in (widest(rig.uncertainty), rig.uncertainty)
        )
        model = ForwardModel(rig, sensors, np.array([rig.limits.frequency_max]), space, free)
        std = np.divide(stated.std, space.std, out=np.zeros(space.size), where=space.uncertain)
        std[space.of(*_NOT_STATED)] = std[space.index("thickness")]
        std[space.groups["masses"]] = 0.0
        state = State(np.zeros(space.size), np.diag(std**2))
        return cls(rig, rig.uncertainty, model, state)


class LivePlate:
    """An identified plate in service, updated by settled patterns."""

    def __init__(self, known: PlateEstimate) -> None:
        self.known = known
        """What is known of the plate now."""
        self._alarm = Alarm()
        self._places = PLACES.centres(known.before.plate)
        self._noise = NoiseLevel()
        self._held: list[PatternModel] = []
        self._suspects = 0

    def take(self, pattern: SettledPattern) -> PatternReport:
        """Take a settled pattern: update the state, or hold it and explain what happened."""
        model = PatternModel.of(self.known.model, pattern, _FINGER, noise=self._noise.relative)
        if self.known.time is None:
            self.known = replace(self.known, time=pattern.time)
        known, drifted = self.known, self._drifted(pattern.time)
        if self._held:
            self._held.append(model)
            return self._explained(pattern.time)
        after = update(drifted, [model], evaluations=_EVALUATIONS, theory=self._theory)
        observation = Observation.of(model, known.state, known.time, after, self._places)
        suspect = self._alarm.take(observation)
        if suspect is not None:
            explanation, is_new = None, not self.known.change
            if known.is_explained and is_new:
                self._go_back(suspect)
                explanation = self._explained(pattern.time).explanation
            self._alarm.clear()
            return PatternReport(after.nis, after.count, is_new, bool(self._held), explanation)
        if self.known.change and self._alarm.is_full:
            self.known = replace(self.known, change="")
        if known.is_explained and not self.known.change and not self._alarm.is_odd:
            self.known = replace(self.known, state=after.state, time=pattern.time)
            self._noise.take(after)
        return PatternReport(after.nis, after.count, False, False, None)

    def _go_back(self, suspect: list[Observation]) -> None:
        """Return to the state before the first suspect pattern, and hold them."""
        self.known = replace(self.known, state=suspect[0].before, time=suspect[0].time)
        self._held, self._suspects = [each.model for each in suspect], len(suspect)

    def _explained(self, time: float) -> PatternReport:
        """Explain the held patterns, early if the explanation is certain."""
        count, drifted = len(self._held), self._drifted(time)
        is_full = count >= max(_MAX_EXPLAINED, self._suspects + _AFTER_ALARM)
        found = explain(drifted, self._held) if count >= _MIN_EXPLAINED else None
        if is_full and found and not found.name:
            # The first of them may be from before the change.
            later = explain(drifted, self._held[-_MIN_EXPLAINED:])
            found = later if later.name else found
        if found is None or not (is_full or (found.name and found.lead > _CERTAIN)):
            return PatternReport(np.nan, 0, False, True, None)
        self._held = []
        if found.name:
            self.known = replace(self.known, state=found.state, time=time)
        else:
            self.known = replace(self.known, change=str(found))
        return PatternReport(np.nan, 0, False, False, found)

    @cached_property
    def _theory(self) -> FloatArray:
        """Variances (p,) of the theory's errors, which patterns at other tones show anew."""
        space = self.known.model.space
        return (space.of_kinds(lambda kind: kind.theory) / space.scale) ** 2

    def _drifted(self, time: float) -> State:
        """The state at a time [s], less certain by the drift since its last update."""
        state, since, space = self.known.state, self.known.time, self.known.model.space
        hours = 0.0 if since is None else max(time - since, 0.0) / 3600
        drift, widest = (
            (space.of_kinds(of) / space.scale) ** 2
            for of in (lambda kind: kind.drift, lambda kind: kind.widest)
        )
        room = np.maximum(widest - np.diag(state.covariance), 0.0)
        return State(state.x, state.covariance + np.diag(np.minimum(drift * hours, room)))


def widest(uncertainty: Uncertainty) -> Uncertainty:
    """The larger of each standard deviation and that of a plate that was not measured."""
    built = Uncertainty()
    return Uncertainty(
        **{
            each.name: max(getattr(uncertainty, each.name), getattr(built, each.name))
            for each in fields(Uncertainty)
        }
    )


class OtherPlate(InputError):
    """The file is of another table, or of other parameters."""


@dataclass(frozen=True, eq=False)
class LearnedPlate:
    """The content of the file of a learned plate."""

    table: str
    """Fingerprint of the table that it corrects."""
    base: str
    """Fingerprint of the rig that parameters count from."""
    names: tuple[str, ...]
    """Names of the parameters."""
    state: State
    change: str = ""
    """How the plate has changed since in a way that its parameters do not follow, or ""."""


def save_learned(learned: LearnedPlate, file: Path) -> None:
    """Write a learned plate, atomically; raises OSError."""
    header = {
        "version": _VERSION,
        "table": learned.table,
        "base": learned.base,
        "names": learned.names,
        "change": learned.change,
    }
    text = json.dumps(header)
    x, covariance = learned.state.x, learned.state.covariance
    write_arrays(
        file,
        {
            "header": np.frombuffer(text.encode(), dtype=np.uint8),
            "x": x,
            "covariance": covariance,
            "digest": np.frombuffer(_digest(text, x, covariance), dtype=np.uint8),
        },
    )


def load_learned(file: Path, *, table: str) -> LearnedPlate:
    """Read a learned plate of a table by its fingerprint.

    Raises InputError for a damaged file or another version, OtherPlate for another table.
    """
    try:
        arrays = read_arrays(file, _TYPES, max_bytes=_MAX_BYTES)
        text, x, covariance = arrays["header"].tobytes().decode(), arrays["x"], arrays["covariance"]
        if arrays["digest"].tobytes() != _digest(text, x, covariance):
            raise ValueError("digest must be that of the content")
        header = json.loads(text)
        version, names = header["version"], tuple(header["names"])
        found = LearnedPlate(
            header["table"],
            header["base"],
            names,
            State(x, covariance),
            str(header["change"]),
        )
    except (*UNREADABLE, KeyError, TypeError) as error:
        why = (isinstance(error, OSError) and error.strerror) or error
        raise InputError(
            f"{file}: must be a learned plate: {why}; remove the file to learn anew"
        ) from error
    p = len(names)
    if version != _VERSION or x.shape != (p,) or covariance.shape != (p, p):
        raise InputError(f"{file}: version must be {_VERSION}; remove the file to learn anew")
    if found.table != table:
        raise OtherPlate(
            f"{file}: must be learned for this table, got one of another rig; remove the file to "
            "learn anew"
        )
    return found


def was_learned(file: Path) -> bool:
    """Whether a file is a learned plate of any version, or may have been before it was damaged."""
    if not begins_with(file, b"PK"):
        return False
    try:
        with zipfile.ZipFile(file) as members:
            return "covariance.npy" in members.namelist()
    except zipfile.BadZipFile:
        return True


def _digest(text: str, x: np.ndarray, covariance: np.ndarray) -> bytes:
    return hashlib.sha256(text.encode() + x.tobytes() + covariance.tobytes()).digest()


class LearnedTable:
    """A table in service, corrected by the settled patterns of its plate.

    table: that of the rig as known when service began, which is never changed; file: keeps what was
    learned, None to keep nothing.
    """

    def __init__(
        self, table: LocalizationTable, known: PlateEstimate, *, file: Path | None = None
    ) -> None:
        self._table, self._file = table, file
        self.live = LivePlate(known)
        self.current = table
        """The table as corrected so far."""

    @classmethod
    def resumed(
        cls, table: LocalizationTable, known: PlateEstimate, *, file: Path, now: float = 0.0
    ) -> Self:
        """Resume with what the file holds, if it exists.

        now: time [s] on the clock of the patterns; the plate has drifted since the file is written.
        Raises InputError for another kind of file, OtherPlate for one of another table or of other
        parameters.
        """
        if not file.exists():
            return cls(table, known, file=file)
        learned = load_learned(file, table=table.fingerprint)
        space = known.model.space
        if learned.names != space.names or learned.base != known.before.fingerprint:
            raise OtherPlate(
                f"{file}: parameters must be those of this rig and its sensors; remove the file to "
                "learn anew"
            )
        written_at = now - max(time.time() - file.stat().st_mtime, 0.0)
        known = replace(known, state=learned.state, time=written_at, change=learned.change)
        resumed = cls(table, known, file=file)
        resumed.current = resumed._followed()
        return resumed

    @property
    def change(self) -> str:
        """How the plate has changed in a way that its parameters do not follow, or ""."""
        return self.live.known.change

    def take(self, pattern: SettledPattern) -> tuple[PatternReport, LocalizationTable | None]:
        """Take a settled pattern, and correct the table by it; None where that stays the same.

        Raises InputError or another ValueError for a pattern that leads to a plate that no table
        can follow; the state before it is restored, suspect patterns are discarded.
        """
        if not np.isfinite(pattern.values).all() or not np.any(pattern.values):
            raise InputError("readings must be finite and not all 0, got others")
        before = self.live.known
        try:
            report = self.live.take(pattern)
            state, change = self.live.known.state, self.live.known.change
            if not np.isfinite(state.x).all() or not np.isfinite(state.covariance).all():
                raise InputError("parameters must be finite after a pattern, got others")
            if state is before.state and bool(change) == bool(before.change):
                return report, None
            self.current = self._followed()
        except Exception:
            self.live = LivePlate(before)
            raise
        return report, self.current

    def _followed(self) -> LocalizationTable:
        """The table for the plate as it is known now."""
        return table_following(
            self._table, self.cautious_rig if self.change else self.live.known.rig
        )

    def save(self) -> None:
        """Write what was learned, atomically."""
        if self._file is None:
            return
        known = self.live.known
        learned = LearnedPlate(
            self._table.fingerprint,
            known.before.fingerprint,
            known.model.space.names,
            known.state,
            known.change,
        )
        save_learned(learned, self._file)

    @property
    def cautious_rig(self) -> Rig:
        """The rig as last known, with the errors of a plate that was not measured."""
        rig = self.live.known.rig
        return replace(rig, uncertainty=widest(rig.uncertainty))
