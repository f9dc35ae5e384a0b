"""What clients are told of the control loop: its news, in the words of the API."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from controller.api.schema import AmplifierStatus, ContactStatus, LinkCounters, PlayedTone
from controller.api.topics import ContactsEvent, PatternEvent, SilenceEvent
from controller.daemon.records import RecordedBackend
from controller.loop.observer import Applied, Silenced
from controller.sources.contacts import Contact, ContactKey
from drivers import clock
from drivers.amplifier import Amplifier
from drivers.errors import CommandError


@dataclass
class Scene:
    """What is on the plate and what is played: the last that the control loop has told.

    effect_of: the effect that plays for a finger.
    """

    effect_of: Callable[[ContactKey], str | None]
    contacts: tuple[Contact, ...] = ()
    applied: Applied | None = None
    silenced: Silenced | None = None

    def changed(self, contacts: tuple[Contact, ...]) -> None:
        """The contacts are these."""
        self.contacts = contacts

    def played(self, applied: Applied) -> None:
        """A pattern is played."""
        self.applied, self.silenced = applied, None

    def fell_silent(self, silenced: Silenced) -> None:
        """Nothing is played."""
        self.applied, self.silenced = None, silenced

    def ended(self) -> None:
        """The amplifiers were silenced by something else than the control loop."""
        self.applied = None

    @property
    def silent_because(self) -> str | None:
        """Why the control loop plays nothing; None where it plays, or has decided nothing yet."""
        return None if self.silenced is None else self.silenced.reason

    def contact_statuses(self) -> list[ContactStatus]:
        """All contacts, with what was decided about each."""
        return [
            contact_status(contact, self.applied, effect=self.effect_of(contact.key))
            for contact in self.contacts
        ]

    def contacts_event(self) -> ContactsEvent:
        """For the topic `contacts`."""
        return ContactsEvent(contacts=self.contact_statuses())

    def pattern_event(self) -> PatternEvent | None:
        """For the topic `pattern`; None where none is played."""
        return None if self.applied is None else pattern_event(self.applied, self.effect_of)

    def silence_event(self) -> SilenceEvent | None:
        """For the topic `silence`; None where something is played, or nothing was decided yet."""
        return None if self.silenced is None else silence_event(self.silenced)

    def drive(self) -> dict[str, PlayedTone]:
        """What is played, by ERA."""
        return {} if self.applied is None else _drive(self.applied)


def contact_status(
    contact: Contact, applied: Applied | None, *, effect: str | None = None
) -> ContactStatus:
    """A contact with what it is predicted to feel of a pattern, and the effect that it has."""
    told: dict[str, object] = {
        "source": contact.key.source,
        "id": contact.key.id,
        "x_m": contact.x,
        "y_m": contact.y,
        "effect": effect,
    }
    if applied is not None:
        for felt in applied.targets:
            if felt.contact.key == contact.key:
                told |= {
                    "role": "target",
                    "level_db_sl": _finite(felt.level_db_sl),
                    "contrast_db": _finite(felt.contrast_db),
                }
        if any(quiet.key == contact.key for quiet in applied.quiet):
            # Of several quiet contacts only the loudest one's level is known.
            level = applied.pattern.quiet_level_db_sl if len(applied.quiet) == 1 else None
            told |= {"role": "quiet", "level_db_sl": _finite(level)}
    return ContactStatus.model_validate(told)


def pattern_event(applied: Applied, effect_of: Callable[[ContactKey], str | None]) -> PatternEvent:
    """A confirmed pattern."""
    return PatternEvent(
        contacts=[
            contact_status(contact, applied, effect=effect_of(contact.key))
            for contact in applied.contacts
        ],
        drive=_drive(applied),
        predicted_contrast_db=_finite(applied.pattern.contrast_db),
        robust_contrast_db=_finite(applied.pattern.robust_contrast_db),
        predicted_level_db_sl=_finite(applied.pattern.level_db_sl),
        latency_ms=1e3 * applied.latency,
    )


def silence_event(silenced: Silenced) -> SilenceEvent:
    """Silence, and why."""
    return SilenceEvent(
        contacts=[contact_status(contact, None) for contact in silenced.contacts],
        reason=silenced.reason,
        latency_ms=None if silenced.latency is None else 1e3 * silenced.latency,
    )


def amplifier_statuses(
    amplifiers: Mapping[str, Amplifier],
    backends: Mapping[str, RecordedBackend],
    urls: Mapping[str, str],
) -> list[AmplifierStatus]:
    """Every amplifier, as its last answer tells; nothing is asked for it.

    How one is that cannot be reached, nobody knows: its last answer is left out.
    """
    is_any_missing = any(backend.is_missing for backend in backends.values())
    return [
        _amplifier_status(
            name,
            amplifier,
            backends[name],
            urls[name],
            closed_with_lost=is_any_missing and not backends[name].is_missing,
        )
        for name, amplifier in amplifiers.items()
    ]


def _amplifier_status(
    name: str, amplifier: Amplifier, backend: RecordedBackend, url: str, *, closed_with_lost: bool
) -> AmplifierStatus:
    """closed_with_lost: whether that is why nothing is known of it, where nothing is."""
    status = (
        None if amplifier.is_lost else backend.status
    )  # None as well while it is being reopened
    heard = backend.heard_at
    seen = amplifier.statistics
    round_trip = seen.last_round_trip
    return AmplifierStatus(
        name=name,
        url=url,
        serial_number=serial_number(amplifier),
        state=status.state.name if status else None,
        fault=status.fault.name if status else None,
        levels=list(status.levels) if status else [],
        temperature_c=_finite(status.temperature) if status else None,
        high_voltage=status.high_voltage if status else None,
        high_voltage_v=_finite(status.voltage) if status else None,
        reply_age_s=None if heard is None else max(0.0, clock.now() - heard),
        lost=status is None and not closed_with_lost,
        closed_with_lost=status is None and closed_with_lost,
        statistics=LinkCounters(
            frames_out=seen.frames_out,
            frames_in=seen.frames_in,
            bad=seen.crc_errors,
            foreign=seen.unexpected_frames,
            events=seen.events,
            retries=seen.retries,
            timeouts=seen.timeouts,
            refusals=seen.refusals,
            round_trip_ms=None if round_trip is None else 1e3 * round_trip,
        ),
    )


def serial_number(amplifier: Amplifier) -> str | None:
    """Of the amplifier that answered; None before any has."""
    try:
        return amplifier.identity.serial_number
    except CommandError:
        return None


def _drive(applied: Applied) -> dict[str, PlayedTone]:
    return {
        era: PlayedTone(frequency_hz=tone.frequency, level=tone.level, phase_deg=tone.phase)
        for era, tone in applied.drive.items()
    }


def _finite(value: float | None) -> float | None:
    """A number that JSON has; None for infinity and what is no number."""
    return value if value is not None and abs(value) < float("inf") else None
