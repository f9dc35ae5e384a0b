"""The methods of the API: what is asked, and what is answered.

One table, `METHODS`, says which parameters and which result belong to a method; the server, the
clients, the reference in docs/reference/api.md and the gateway's description all go by it.
"""

from typing import Annotated, Any, NamedTuple

from pydantic import Field

from controller.api.schema import (
    MAX_LEASE,
    MAX_RATE,
    MIN_LEASE,
    AmplifierStatus,
    ContactStatus,
    Count,
    DaemonStateName,
    EffectDescription,
    Empty,
    LatencySummary,
    Message,
    Name,
    PhaseName,
    PlayedTone,
    RigSummary,
    TableSummary,
    Topic,
    TouchPoint,
)

MAX_TOUCHES = 64  # of a frame; a panel reports ten, a forearm some more


class HelloParams(Message):
    """Who asks; for the log."""

    client: Name


class HelloResult(Message):
    """What the daemon drives; none of it changes while it runs, but for the layout."""

    api_version: str = Field(description="major.minor; another major cannot be talked to")
    software_version: str
    rig: RigSummary
    table: TableSummary
    rig_text: str = Field(description="the rig's file, from which fields can be computed")
    layout: dict[str, Any] | None = Field(description="the surface layout, null without one")


class StatusResult(Message):
    """How everything is at this moment."""

    time_s: float = Field(description="of this answer, on the daemon's CLOCK_MONOTONIC")
    unix_time_s: float = Field(description="the same moment on the wall clock")
    state: DaemonStateName
    cause: str = Field(description="why it is in this state")
    remedy: str | None = Field(description="what to do about it, where anything is to be done")
    phase: PhaseName
    assume_energised: bool = Field(
        description="whether amplifiers that were lost may still be playing"
    )
    lost_for_s: float | None = Field(description="how long a link has been lost; null if none is")
    watchdog_s: float = Field(
        description="an armed amplifier that hears nothing falls silent by itself after this time"
    )
    armed_by: str | None
    lease_left_s: float | None
    contacts: list[ContactStatus] = Field(description="in order of arrival, the newest last")
    drive: dict[str, PlayedTone] = Field(description="by ERA, silent ones left out")
    silent_because: str | None = Field(None, description="why nothing is played though armed")
    plain_because: str | None = Field(
        None, description="why touches begin along plain ramps though shaped onsets are possible"
    )
    predicted_contrast_db: float | None
    robust_contrast_db: float | None
    predicted_level_db_sl: float | None
    amplifiers: list[AmplifierStatus]
    latency_ms: LatencySummary
    rejected_touches: dict[str, Count] = Field(description="how many, by the reason")
    uptime_s: float


class ArmParams(Message):
    """High voltage on, for as long as the lease is renewed."""

    owner: Name
    lease_s: Annotated[float, Field(ge=MIN_LEASE, le=MAX_LEASE)]


class ArmResult(Message):
    """The lease: keep it, renew it within lease_s."""

    lease: str
    lease_s: float


class RenewParams(Message):
    """The lease that arm gave."""

    lease: Annotated[str, Field(min_length=1, max_length=80)]


class RenewResult(Message):
    """How long the lease lasts from now."""

    lease_s: float


class TouchParams(Message):
    """All fingers of this client under a source name; valid for 150 ms, so repeat it."""

    source: Name
    touches: Annotated[list[TouchPoint], Field(max_length=MAX_TOUCHES)]


class EffectsResult(Message):
    """The effects that play can be asked for."""

    effects: list[EffectDescription]


class PlayParams(Message):
    """Play an effect at the finger that is nearest to a place, once; it ends with the finger."""

    effect: Name
    x_m: float = Field(description="a finger must be within 20 mm of the place")
    y_m: float
    level_db_sl: float | None = Field(
        None, description="at most the effect's own, which it has if this is left out"
    )


class SubscribeParams(Message):
    """Topics to be told of; rate_hz is how often of what is measured all the time."""

    topics: Annotated[list[Topic], Field(min_length=1, max_length=16)]
    rate_hz: Annotated[float, Field(ge=1, le=MAX_RATE)] | None = Field(
        None, description="of amplifiers and latency; 10 if left out"
    )


class UnsubscribeParams(Message):
    """Topics not to be told of any more."""

    topics: Annotated[list[Topic], Field(min_length=1, max_length=16)]


class Method(NamedTuple):
    """Parameters, result and meaning of a method."""

    params: type[Message]
    result: type[Message]
    meaning: str


METHODS: dict[str, Method] = {
    "hello": Method(HelloParams, HelloResult, "who is there and what it drives"),
    "status": Method(Empty, StatusResult, "how everything is"),
    "arm": Method(ArmParams, ArmResult, "high voltage on; touches are felt while the lease lasts"),
    "renew": Method(RenewParams, RenewResult, "the owner of the lease is still there"),
    "disarm": Method(Empty, Empty, "silent along a short ramp, high voltage off; by anyone"),
    "stop": Method(
        Empty,
        Empty,
        "quick stop, latched until clear; by anyone, at any time; 1004 where an amplifier that is "
        "lost from then on did not hear it",
    ),
    "clear": Method(Empty, Empty, "acknowledge a stop, or a fault whose cause is gone"),
    "touch": Method(TouchParams, Empty, "all fingers of this client, as a touch source"),
    "effects": Method(Empty, EffectsResult, "which effects there are"),
    "play": Method(PlayParams, Empty, "play an effect at a finger; only while armed"),
    "subscribe": Method(SubscribeParams, Empty, "be told of topics from now on"),
    "unsubscribe": Method(UnsubscribeParams, Empty, "be told of them no more"),
}
"""Every method of the API, by name."""
