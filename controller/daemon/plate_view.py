"""Describe the fingers on the plate and their playback as messages of the API."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from controller.api.methods import ContactsEvent, PatternEvent, SilenceEvent
from controller.api.schema import ContactStatus, PlayedTone
from controller.play.intent import NO_CONTACTS
from controller.play.reports import PlayReport
from controller.play.routing import Drive
from controller.play.selected_contents import BEING_CHOSEN, FingerSensation, leaks_db_sl
from controller.sources.touch import Contact, ContactKey
from model.answer.answer import is_felt
from model.table.table import LocalizationTable


@dataclass
class PlateView:
    """The contacts on the plate and the last report of their playback."""

    effect_of: Callable[[ContactKey], str | None]
    """Returns the effect that plays for a contact."""
    contacts: tuple[Contact, ...] = ()
    report: PlayReport | None = None
    """The last report of the control loop.

    None before the first one, and after another part of the daemon has silenced the plate.
    """
    why_not: Callable[[ContactKey], str] = lambda key: ""
    """Returns why a contact feels nothing if the report gives no reason; "" if it should feel."""

    @property
    def applied(self) -> PlayReport | None:
        """The report of the pattern that plays; None while nothing plays."""
        if self.report is None or not self.report.contents:
            return None
        return self.report

    def contact_statuses(self) -> list[ContactStatus]:
        """Describe all contacts with their roles."""
        return self._statuses(self.contacts)

    @property
    def silence_reason(self) -> str | None:
        """Why nothing plays for the current contacts; None while a pattern plays."""
        if self.applied is not None:
            return None
        reasons = []
        for contact in self.contact_statuses():
            if contact.held_back and contact.held_back not in reasons:
                reasons.append(contact.held_back)
        return "; ".join(reasons) or NO_CONTACTS

    def statuses_now(self, table: LocalizationTable) -> list[ContactStatus]:
        """Describe all contacts with roles, and crosstalk at their current positions."""
        statuses = self.contact_statuses()
        if self.applied is None:
            return statuses
        contents = [slot.content for slot in self.applied.contents.values() if slot.drive]
        leaks = leaks_db_sl(table, contents, self.contacts)
        current_statuses = []
        for status, contact in zip(statuses, self.contacts, strict=True):
            leak = {"leak_db_sl": finite(leaks[contact.key])}
            current_statuses.append(status.model_copy(update=leak))
        return current_statuses

    @property
    def targets(self) -> list[str]:
        """The current targets, each as source and number."""
        if self.applied is None:
            return []
        keys = [target.contact.key for target in self.applied.targets]
        return [f"{key.source} {key.id}" for key in keys]

    def contacts_event(self) -> ContactsEvent:
        """Return the event of topic `contacts`."""
        return ContactsEvent(contacts=self.contact_statuses())

    def pattern_event(self) -> PatternEvent | None:
        """Return the event of topic `pattern`; None while nothing plays."""
        applied = self.applied
        if applied is None:
            return None
        return PatternEvent(
            contacts=self._statuses(applied.contacts),
            **playing_of(applied),
            latency_ms=in_milliseconds(applied.latency),
        )

    def silence_event(self) -> SilenceEvent | None:
        """Return the event of topic `silence`; None while something plays or before a decision."""
        silenced = self.report
        if silenced is None or silenced.contents:
            return None
        return SilenceEvent(
            contacts=self._statuses(silenced.contacts),
            reason=silenced.reason,
            latency_ms=in_milliseconds(silenced.latency),
        )

    def _statuses(self, contacts: Sequence[Contact]) -> list[ContactStatus]:
        return [self._status(contact) for contact in contacts]

    def _status(self, contact: Contact) -> ContactStatus:
        """Describe a contact, its predicted sensation and its effect."""
        status: dict[str, object] = {
            "source": contact.key.source,
            "id": contact.key.id,
            "x_m": contact.x,
            "y_m": contact.y,
            "effect": self.effect_of(contact.key),
            "load": contact.load,
            "held_back": self._why_nothing_felt(contact),
        }
        if self.report is not None:
            status |= _sensation_of(contact, self.report)
        if contact.why_load_alone:
            role = "hand" if contact.is_hand else "surplus"
            status |= {"role": role, "held_back": contact.why_load_alone, "is_foreign_felt": False}
        return ContactStatus.model_validate(status)

    def _why_nothing_felt(self, contact: Contact) -> str:
        """Return why a contact that is not a target feels nothing."""
        reason = self.why_not(contact.key)
        if reason:
            return reason
        report = self.report
        if report is None or report.targets:
            return BEING_CHOSEN
        # A report without targets gives one reason for its contacts, for instance after a failure.
        for reported in report.contacts:
            if report.reason and _is_same(reported, contact):
                return report.reason
        return BEING_CHOSEN


def _is_same(reported: Contact, contact: Contact) -> bool:
    """Whether a contact of a report is a finger, and not an older one with the same number."""
    return reported.key == contact.key and reported.since == contact.since


def _sensation_of(contact: Contact, report: PlayReport) -> dict[str, object]:
    """Return the role and figures of a contact in a report, by the keys of its status."""
    figures = {}
    for target in report.targets:
        if _is_same(target.contact, contact):
            figures = {"role": "target", **_figures(target)}
    for quiet in report.quiet:
        if quiet.key == contact.key:
            levels = report.quiet_levels.get(contact.key, ())
            highest = max(levels, default=None)
            rig_level = levels[0] if levels else None
            figures["role"] = "quiet"
            figures["foreign_level_db_sl"] = finite(highest)
            figures["rig_foreign_level_db_sl"] = finite(rig_level)
            figures["is_foreign_felt"] = is_felt(highest)
    return figures


def _figures(target: FingerSensation) -> dict[str, object]:
    """Return the figures of a target's sensation, by the keys of its status."""
    sensation = target.sensation
    return {
        "feels": target.content_name,
        "level_db_sl": finite(target.level_db_sl),
        "promised_level_db_sl": finite(target.promised_level_db_sl),
        "promised_contrast_db": finite(sensation.promised_contrast_db),
        "contrast_db": finite(sensation.contrast_db),
        "verdict": sensation.verdict,
        "frequency_hz": target.frequency,
        "foreign_level_db_sl": finite(sensation.foreign_level_db_sl),
        "rig_foreign_level_db_sl": finite(sensation.rig_foreign_level_db_sl),
        "is_foreign_felt": sensation.is_foreign_felt,
        "held_back": target.held_back,
    }


def playing_of(applied: PlayReport | None) -> dict[str, Any]:
    """Return the values of `PatternFields`: the tones of a pattern and its figures."""
    playing: dict[str, Any] = {
        "drive": {},
        "layers": {},
        "promised_contrast_db": None,
        "predicted_contrast_db": None,
        "predicted_level_db_sl": None,
    }
    if applied is None:
        return playing
    playing["drive"] = _played_tones(applied.drive)
    for number, slot in applied.contents.items():
        playing["layers"][str(number)] = _played_tones(slot.drive)
    if applied.felt is not None:
        sensation = applied.felt.sensation
        playing["promised_contrast_db"] = finite(sensation.promised_contrast_db)
        playing["predicted_contrast_db"] = finite(sensation.contrast_db)
        playing["predicted_level_db_sl"] = finite(sensation.level_db_sl)
    return playing


def _played_tones(drive: Drive) -> dict[str, PlayedTone]:
    """Describe the tones of a layer by ERA."""
    tones = {}
    for era, tone in drive.items():
        tones[era] = PlayedTone(frequency_hz=tone.frequency, level=tone.level, phase_deg=tone.phase)
    return tones


def finite(value: float | None) -> float | None:
    """Return a finite value unchanged; None for infinity and NaN, which JSON lacks."""
    return value if value is not None and abs(value) < float("inf") else None


def in_milliseconds(duration: float | None) -> float | None:
    """Convert a duration [s] to milliseconds; None if it is unknown."""
    return None if duration is None else 1e3 * duration
