"""The topics of `event` notifications, and the data of each."""

from typing import Any, Literal, NamedTuple

from pydantic import Field

from controller.api.schema import (
    STATE_WORDS,
    AmplifierStatus,
    ContactStatus,
    Count,
    DaemonStateName,
    Epoch,
    Explained,
    LatencySummary,
    Message,
    PlateEvent,
    PlayedTone,
    Playing,
    Topic,
)


class StateEvent(Explained):
    """The daemon changed its state."""

    old: DaemonStateName
    new: DaemonStateName
    word: str = Field(
        default_factory=lambda known: STATE_WORDS[known["new"]],
        description="the new state in a word for people",
    )
    epoch: Epoch


class ContactsEvent(Message):
    """All contacts after a change, before a pattern is selected for them."""

    contacts: list[ContactStatus]


class PatternEvent(Playing):
    """A pattern that the amplifiers confirmed."""

    layers: dict[str, dict[str, PlayedTone]] = Field(
        default_factory=dict,
        description="what plays of each content, by layer, then as `drive`; they add up",
    )
    latency_ms: float | None = Field(
        description="from the touch to the last byte of the command; null if none was needed"
    )


class SilenceEvent(Message):
    """No channel is driven; if a link is lost (see the state), as far as known."""

    contacts: list[ContactStatus]
    reason: str
    latency_ms: float | None = Field(description="null if no command was needed")


class AmplifiersEvent(Message):
    """All amplifiers, at the subscribed rate."""

    amplifiers: list[AmplifierStatus]


class LatencyEvent(Message):
    """Latencies, at the subscribed rate."""

    latency_ms: LatencySummary


class LogEvent(Message):
    """A record of the daemon's log."""

    level: Literal["info", "warning", "error"]
    message: str
    cause: str | None
    remedy: str | None


class LinkEvent(Message):
    """The link to amplifiers was lost, could not be reopened, or was reopened.

    Degraded: an amplifier does not reply but may still play; nothing new is played until it replies
    (restored) or is lost.
    """

    event: Literal["degraded", "restored", "lost", "retry", "reopened"]
    amplifier: str | None = Field(description="its name, if known")
    message: str
    remedy: str | None


class LayoutEvent(Message):
    """The surface layout was replaced; `effects` may have changed with it."""

    layout: dict[str, Any] | None = Field(description="the surface layout; null without one")


class TopicData(NamedTuple):
    """A topic: its data, its summary, and when it is sent.

    At every change; or the newest of several changes, at most 60 times per second; or at the rate
    that a client has subscribed with.
    """

    data: type[Message]
    summary: str
    sent: Literal["always", "newest", "periodically"] = "always"


TOPICS: dict[Topic, TopicData] = {
    "state": TopicData(StateEvent, "every change of state or epoch, with its cause"),
    "contacts": TopicData(ContactsEvent, "fingers touched, moved or lifted", "newest"),
    "pattern": TopicData(PatternEvent, "what plays now, as the amplifiers confirmed it", "newest"),
    "silence": TopicData(SilenceEvent, "nothing plays now, and why", "newest"),
    "amplifiers": TopicData(
        AmplifiersEvent, "status of the amplifiers, at rate_hz", "periodically"
    ),
    "latency": TopicData(LatencyEvent, "latency from touch to command, at rate_hz", "periodically"),
    "log": TopicData(LogEvent, "log records from level info, without those of `state` and `link`"),
    "link": TopicData(LinkEvent, "links to amplifiers that were degraded, lost or reopened"),
    "layout": TopicData(LayoutEvent, "the surface layout was replaced"),
    "plate": TopicData(PlateEvent, "the plate has changed, or is followed otherwise"),
}
"""Every topic, by name."""


class EventParams(Message):
    """Parameters of an `event` notification."""

    topic: Topic
    time_s: float = Field(description="on CLOCK_MONOTONIC")
    lost: Count = Field(
        description="notifications dropped before this one because the client reads too slowly"
    )
    data: dict[str, object]
