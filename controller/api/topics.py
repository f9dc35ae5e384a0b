"""What the daemon tells subscribers unasked: notifications of the method `event`, by topic."""

from typing import Any, Literal, NamedTuple

from pydantic import Field

from controller.api.schema import (
    AmplifierStatus,
    ContactStatus,
    Count,
    DaemonStateName,
    LatencySummary,
    Message,
    PlayedTone,
    Topic,
)


class StateEvent(Message):
    """The daemon's state is another now."""

    old: DaemonStateName
    new: DaemonStateName
    cause: str
    remedy: str | None = Field(description="what to do about it, where anything is to be done")


class ContactsEvent(Message):
    """The contacts changed; all of them, before anything is decided about them."""

    contacts: list[ContactStatus]


class PatternEvent(Message):
    """A pattern that the amplifiers have confirmed."""

    contacts: list[ContactStatus]
    drive: dict[str, PlayedTone] = Field(description="by ERA, silent ones left out")
    predicted_contrast_db: float | None
    robust_contrast_db: float | None
    predicted_level_db_sl: float | None
    latency_ms: float = Field(description="from the touch to the last byte of the command")


class SilenceEvent(Message):
    """All channels are brought to zero, or stay there, or cannot be reached: the state tells."""

    contacts: list[ContactStatus]
    reason: str
    latency_ms: float | None = Field(description="null where silence needed no command")


class AmplifiersEvent(Message):
    """All amplifiers, at the rate that was subscribed to."""

    amplifiers: list[AmplifierStatus]


class LatencyEvent(Message):
    """LatencyStatistics, at the rate that was subscribed to."""

    latency_ms: LatencySummary
    plain_because: str | None = Field(
        description="why touches begin along plain ramps though shaped onsets are possible"
    )


class LogEvent(Message):
    """A line of the daemon's log."""

    level: Literal["info", "warning", "error"]
    message: str
    cause: str | None
    remedy: str | None


class LinkEvent(Message):
    """A link to amplifiers was lost, could not be reopened, or is back."""

    event: Literal["lost", "retry", "reopened"]
    amplifier: str | None = Field(description="which one, where that is known")
    message: str
    remedy: str | None


class LayoutEvent(Message):
    """What touches mean is another now: the layout as `hello` tells it; `effects` may be others."""

    layout: dict[str, Any] | None = Field(description="the surface layout, null without one")


class TopicData(NamedTuple):
    """Data and meaning of a topic."""

    data: type[Message]
    meaning: str


TOPICS: dict[Topic, TopicData] = {
    "state": TopicData(StateEvent, "every change of state, with its cause"),
    "contacts": TopicData(ContactsEvent, "fingers came, moved or went"),
    "pattern": TopicData(PatternEvent, "what is played now, confirmed by the amplifiers"),
    "silence": TopicData(SilenceEvent, "nothing is played now, and why"),
    "amplifiers": TopicData(AmplifiersEvent, "how the amplifiers are, at rate_hz"),
    "latency": TopicData(LatencyEvent, "how fast touches become commands, at rate_hz"),
    "log": TopicData(
        LogEvent,
        "what the daemon logs, from info upwards, but for what `state` and `link` tell",
    ),
    "link": TopicData(LinkEvent, "links to amplifiers that are lost or come back"),
    "layout": TopicData(LayoutEvent, "touches mean something else from now on, and what"),
}
"""Every topic, by name."""


class EventParams(Message):
    """The parameters of an `event` notification; data is the topic's."""

    topic: Topic
    time_s: float = Field(description="on the daemon's CLOCK_MONOTONIC")
    lost: Count = Field(description="notifications lost since the last, for this client is slow")
    data: dict[str, object]
