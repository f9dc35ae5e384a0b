"""Rows of the demonstration: a touch with its predicted and measured values."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, TypeAlias

from controller.demo.simulated_plate import FingerVibration
from controller.play.reports import PlayReport
from controller.play.selected_contents import FingerSensation
from controller.sources.touch import Contact, ContactKey
from model.answer.answer import Layer
from model.arrays import Point

_Vibration: TypeAlias = Mapping[str, FingerVibration]
"""Measured vibration by id of a finger's sensor."""

_NOT_IN_JSON = ("target_id", "quiet", "pattern", "levels_db_sl", "fingers", "contents")
"""Fields of `TouchRow` that its JSON omits or writes in another form."""


@dataclass(frozen=True, kw_only=True)
class FingerRow:
    """A finger among several contents: frequency, verdict, and promised and measured values.

    A contrast is its own level above the level of all other contents' total power here. Measured
    contrasts are None without a measured own or other content.
    """

    at_m: Point
    frequency_hz: float | None
    verdict: str
    promised_contrast_db: float | None
    measured_contrast_db: float | None
    measured_level_db_sl: float | None


@dataclass(frozen=True, kw_only=True)
class TouchRow:
    """A touch from touch-down to lift, with its last steady pattern with the most contents.

    Its fields are the keys of `era demo --json`, except those in `_NOT_IN_JSON`:

    - quiet: other fingertips by id [m].
    - pattern, levels_db_sl: levels by id: for the target the mean over its tip, for other fingers
      the loudest point. The smallest difference is the contrast.
    - Contrasts are None for a single finger. Measured contrasts are also None if the pattern was
      too short. Predicted values are for the table's plate; 90 % of plates within the tolerances
      reach the promised levels.
    - drive: as achieved by the amplifiers, by ERA.
    - latency_ms: from touch frame to last byte on the wire; None in virtual time.
    - reason: why nothing played, if so.
    - fingers: one for each of several contents; contrasts are then relative to the other contents
      at this finger.
    - contents: their patterns, in the order of layers.
    """

    target_id: str
    time_s: float
    until_s: float
    targets_m: Sequence[Point]
    quiet: Mapping[str, Point]
    reason: str | None = None
    drive: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    mode: str | None = None
    latency_ms: float | None = None
    played_s: float = 0.0
    steady: bool = False
    predicted_contrast_db: float | None = None
    promised_contrast_db: float | None = None
    measured_contrast_db: float | None = None
    predicted_level_db_sl: float | None = None
    measured_level_db_sl: float | None = None
    pattern: Layer | None = None
    levels_db_sl: Mapping[str, float] = field(default_factory=dict)
    fingers: Sequence[FingerRow] = ()
    contents: Sequence[Layer] = ()

    @property
    def keeps_promise(self) -> bool | None:
        """Whether the steady felt contrast is at least the promised one; None if not measured."""
        promised = self.promised_contrast_db
        measured = self.measured_contrast_db
        if not self.steady or promised is None or measured is None:
            return None
        return measured >= promised

    def as_json(self) -> dict[str, Any]:
        """Return the row in the format of `era demo --json`."""
        row: dict[str, Any] = {}
        for attribute in fields(self):
            if attribute.name not in _NOT_IN_JSON:
                row[attribute.name] = getattr(self, attribute.name)
        row["quiet_m"] = list(self.quiet.values())
        if self.fingers:
            row["fingers"] = [asdict(finger) for finger in self.fingers]
        return row


def steady_contrast_db(target: FingerVibration, quiet: Sequence[FingerVibration]) -> float | None:
    """Return the level [dB] of a target above the loudest point of quiet fingers, steady.

    The lowest value over the threshold sets of the target, like a promised contrast. None without
    quiet fingers.
    """
    if not quiet:
        return None
    contrasts = []
    for threshold in target.thresholds:
        loudest = max(finger.loudest_by(threshold) for finger in quiet)
        contrasts.append(target.level_by(threshold) - loudest)
    return min(contrasts)


def with_values(
    row: TouchRow, report: PlayReport, key: ContactKey, vibration: _Vibration
) -> TouchRow:
    """Complete the row of a touch with the predicted and measured values of a pattern.

    key: of the touch, which feels a content of the pattern.
    """
    predicted = next(felt for felt in report.targets if felt.contact.key == key)
    played = next(  # its own content, or the content it shares
        content
        for content in report.contents.values()
        if any(contact.key == key for contact, _ in content.content.targets)
    )
    drive = {}
    for era, tone in played.drive.items():
        drive[era] = {
            "frequency_hz": tone.frequency,
            "level": tone.level,
            "phase_deg": tone.phase,
        }
    levels_db_sl = {}
    for id, finger in vibration.items():
        is_target = id == row.target_id
        levels_db_sl[id] = finger.level_db_sl if is_target else finger.loudest_db_sl
    row = replace(
        row,
        targets_m=[position_of(predicted.contact)],
        quiet={sensor_id(contact): position_of(contact) for contact in report.quiet},
        drive=drive,
        mode=played.layer.drive_mode,
        predicted_contrast_db=predicted.sensation.contrast_db,
        promised_contrast_db=predicted.sensation.promised_contrast_db,
        predicted_level_db_sl=predicted.level_db_sl,
        pattern=played.layer,
        levels_db_sl=levels_db_sl,
    )
    if len(report.contents) > 1:
        finger_row = _finger_row(predicted, vibration)
        return replace(
            row,
            measured_contrast_db=finger_row.measured_contrast_db,
            measured_level_db_sl=finger_row.measured_level_db_sl,
            fingers=[_finger_row(felt, vibration) for felt in report.targets],
            contents=[content.layer for content in report.contents.values()],
        )
    target, quiet = _target_and_quiet(vibration, predicted, report.quiet)
    if target is None:
        return row
    return replace(
        row,
        measured_contrast_db=steady_contrast_db(target, quiet),
        measured_level_db_sl=target.level_db_sl,
    )


def _finger_row(felt: FingerSensation, vibration: _Vibration) -> FingerRow:
    """Make the row of a finger among several contents."""
    level = None
    contrast = None
    measured = vibration.get(sensor_id(felt.contact))
    if measured is not None and felt.frequency is not None:
        own_vibration, foreign_vibration = measured.parted(felt.frequency)
        if math.isfinite(own_vibration.level_db_sl):
            level = own_vibration.level_db_sl
            contrast = steady_contrast_db(own_vibration, [foreign_vibration])
    if contrast == math.inf:
        contrast = None
    return FingerRow(
        at_m=position_of(felt.contact),
        frequency_hz=felt.frequency,
        verdict=felt.sensation.verdict,
        promised_contrast_db=felt.sensation.promised_contrast_db,
        measured_contrast_db=contrast,
        measured_level_db_sl=level,
    )


def _target_and_quiet(
    vibration: _Vibration, felt: FingerSensation, quiet_contacts: Sequence[Contact]
) -> tuple[FingerVibration | None, list[FingerVibration]]:
    """Return the vibration of target and quiet fingers; no target unless all were measured."""
    target = vibration.get(sensor_id(felt.contact))
    quiet_ids = [sensor_id(contact) for contact in quiet_contacts]
    quiet = [vibration[id] for id in quiet_ids if id in vibration]
    if target is None or not len(target.frequencies) or len(quiet) < len(quiet_contacts):
        return None, []
    return target, quiet


def position_of(contact: Contact) -> Point:
    """Return the position [m] of a contact."""
    return contact.x, contact.y


def sensor_id(contact: Contact) -> str:
    """Return the id of a contact's sensor on the plate."""
    return f"{contact.key.source}#{contact.key.id}"
