"""The methods and topics of the API: their messages, and how requests and events are treated.

Each method is a row of `METHODS`, handled by the method of `ApiService` with the same name
(`controller/daemon/handlers.py`), whose docstring is the summary. `make pages` writes the methods
of the clients, `summaries.py` and docs/reference/api.md. Each topic is a row of `TOPICS`.
"""

from typing import Annotated, Any, Literal, NamedTuple

from pydantic import FailFast, Field

from controller.api.schema import (
    MAX_LEASE,
    MAX_RATE,
    MIN_LEASE,
    PROMISED,
    STATE_WORDS,
    AmplifierSilence,
    AmplifierStatus,
    ApiMessage,
    CauseAndRemedy,
    ContactStatus,
    Count,
    DaemonStateName,
    EffectDescription,
    Empty,
    Epoch,
    LatencySummary,
    Name,
    PatternFields,
    RigSummary,
    TableSummary,
    Topic,
    TouchInputStatus,
    TouchPoint,
)
from controller.content.points import MAX_GIVEN
from controller.effects.strengths import GainDb, SourceName

DEFAULT_LEASE = 10.0  # s
MAX_TOUCHES = 64  # per frame; a panel reports ten, a forearm some more

BY_PLACE = "by place"
"""Marks an optional parameter that the Python clients also accept by position."""


class HelloParams(ApiMessage):
    """Name of the client, for the log."""

    client: Name


class HelloResult(ApiMessage):
    """Rig, table and layout of the daemon; only the layout can change while it runs."""

    api_version: str
    """major.minor; major versions are incompatible"""
    software_version: str
    rig: RigSummary
    table: TableSummary
    rig_text: str
    """the rig file, from which vibration fields can be computed"""
    layout: dict[str, Any] | None
    """the surface layout; null without one"""
    readings: dict[str, tuple[str, str, Count]] = Field({})
    """label, unit and decimals of the amplifier readings to show, by key of the status"""


class StrengthResult(ApiMessage):
    """Strengths of all known touch sources, clients and regions."""

    strengths: dict[str, float] = Field({})
    """gain in dB by name (0 if not set), for configured inputs, sources that have had fingers,
    connected clients, regions of the current layout, and all other names with a gain"""


class StatusResult(StrengthResult, PatternFields, CauseAndRemedy):
    """State of the daemon, the amplifiers and the plate."""

    time_s: float
    """time of this response on CLOCK_MONOTONIC"""
    unix_time_s: float
    """the same time on the wall clock"""
    state: DaemonStateName
    word: str = Field(default_factory=lambda known: STATE_WORDS[known["state"]])
    """the state in plain words"""
    epoch: Epoch
    assume_energised: bool
    """whether lost amplifiers may still be playing"""
    lost_for_s: float | None
    """how long a link has been lost; null if all are up"""
    watchdog_s: float
    """time without heartbeats after which an armed amplifier silences itself"""
    armed_by: str | None
    lease_left_s: float | None
    silence_reason: str | None = None
    """why nothing plays while armed"""
    amplifiers: list[AmplifierStatus]
    latency_ms: LatencySummary
    """after a finger landed, moved or changed its pressure"""
    lift_latency_ms: LatencySummary | None = None
    """after a lift, or a change without a touch, such as the end of an effect"""
    rejected_touches: dict[str, Count]
    """number of rejected touches by reason, for all sources together"""
    rejected_examples: dict[str, str] = Field(default_factory=dict)
    """content and source of the newest rejected touch for each reason"""
    inputs: list[TouchInputStatus] = Field(default_factory=list)
    """configured touch inputs"""
    clicks_too_late: Count = 0
    """number of short vibrations that were too late to be felt; playback continues"""
    lost_events: dict[str, Count] = Field({})
    """notifications that clients were too slow to read, by topic"""
    layout: str | None = None
    """name of the current layout; null if there is none"""
    layouts: list[str] = Field([])
    """names that `layout` accepts"""
    slow_reason: str | None = None
    """why table queries take longer than necessary; null if they do not"""
    threshold: str | None = None
    """name of the rig's threshold set, to which levels in dB SL are relative"""
    uptime_s: float


class ArmParams(ApiMessage):
    """Who arms, and the duration of the lease without renewal."""

    owner: Name
    lease_s: Annotated[float, Field(ge=MIN_LEASE, le=MAX_LEASE)] = DEFAULT_LEASE


class RenewParams(ApiMessage):
    """The lease that `arm` returned."""

    lease: Annotated[str, Field(min_length=1, max_length=80)]


class RenewResult(ApiMessage):
    """Time until the lease expires."""

    lease_s: float


class ArmResult(RenewResult):
    """The lease; renew it within lease_s."""

    lease: str


class RequestedBy(ApiMessage):
    """Client to name in the log, if the connection belongs to another one."""

    client: Name | None = None


class DisarmParams(RequestedBy):
    """Whose lease to end."""

    lease: Annotated[str, Field(min_length=1, max_length=80)] | None = None
    """disarm only if this lease is current; null: under any lease"""


class StopResult(ApiMessage):
    """Every amplifier is confirmed silent."""

    epoch: Epoch
    amplifiers: dict[str, AmplifierSilence] = Field({})
    """by name"""


class ClearParams(RequestedBy):
    """The epoch up to which to acknowledge; a later stop, fault or loss stays latched."""

    epoch: Epoch | None = None
    """as last received in a status, stop or state event; null: the current one"""


class TouchParams(ApiMessage):
    """All fingers of a touch source; valid for 150 ms, so repeat it."""

    source: Name
    touches: Annotated[list[TouchPoint], Field(max_length=MAX_TOUCHES), FailFast()]


class LayoutParams(ApiMessage):
    """The layout to use."""

    name: Name
    """one of `layouts` in the status"""


class LayoutResult(ApiMessage):
    """The current layout, and all available ones."""

    layout: str
    layouts: list[str]


class ReloadResult(ApiMessage):
    """Result of reading the daemon's files again."""

    reloaded: bool
    """whether the new files are in use; if not, nothing changed"""
    reasons: list[str]
    """the changes, or the reasons for rejection"""


class EffectsResult(ApiMessage):
    """The effects that `play` accepts."""

    effects: list[EffectDescription]


_Point = Annotated[list[float], Field(min_length=3, max_length=3)]
_Points = Annotated[list[_Point], Field(max_length=MAX_GIVEN), FailFast()]


class PlayParams(ApiMessage):
    """Play an effect, or points, at the finger nearest to a position; they end when it lifts."""

    effect: Name | None = None
    """an effect of the layout or a built-in content; null with points or taps"""
    x_m: float
    """a finger must be within 20 mm of the position"""
    y_m: float
    level_db_sl: float | None = None
    """-20 or more. For an effect, default and maximum are its own level; for points, the default is
    20 and the maximum is the layout's `max_level_db_sl`"""
    points: _Points = Field([])
    """continuous event: `[time_s, intensity, sharpness]` in order of time; 0 to 60 s, 0 to 1, 0 to
    1"""
    taps: _Points = Field([])
    """transients, in the same format"""
    loop: bool = False
    """whether points or a file repeat from the start"""


class OtherFinger(ApiMessage):
    """Another finger on the plate, and the vibrations of others that reach it."""

    source: str
    id: int
    x_m: float
    y_m: float
    foreign_level_db_sl: float | None
    """as in the status: not exceeded on 90 % of plates, relative to the most sensitive published
    thresholds; null if unknown or without vibrations of others"""
    rig_foreign_level_db_sl: float | None
    """the same level relative to the rig's threshold set"""


class PlayResult(ApiMessage):
    """Outcome of a request to play, once the amplifiers have confirmed it or it was given up."""

    outcome: Literal["played", "late", "held back", "pending"]
    """played: confirmed by the amplifiers; late: it was over, or had lost its touch, before they
    could play it; held back: not played, for a reason; pending: not yet, because it begins with a
    pause, waits for a movement, or was not decided within 2 s"""
    reason: str | None = None
    """why it is not played, or why the finger shares another vibration; null otherwise"""
    start_s: float | None = None
    """when the amplifiers start it, on CLOCK_MONOTONIC; the following values are null if it is not
    played"""
    frequency_hz: float | None = None
    """null if it has several frequencies"""
    level_db_sl: float | None = None
    """predicted level on the nominal plate, relative to the rig's threshold set; over the duration
    of a short vibration, onset included"""
    promised_level_db_sl: float | None = None
    """at least this level on 90 % of plates within the rig's tolerances"""
    promised_contrast_db: float | None = Field(None, description=PROMISED)
    verdict: Literal["own", "mixed", "shared"] | None = None
    """as in the status"""
    other_fingers: list[OtherFinger] = Field([])
    """all other fingers, in order of arrival"""


class StrengthParams(ApiMessage):
    """A touch source, client or region and its gain; without a gain, nothing changes."""

    name: SourceName
    """name of an input, sender, source, client or region"""
    gain_db: Annotated[GainDb | None, BY_PLACE] = None
    """applied to all its effects; 0 is the level that layout and limits allow"""


class UnsubscribeParams(ApiMessage):
    """Topics to unsubscribe from."""

    topics: Annotated[list[Topic], Field(min_length=1, max_length=16)]


class SubscribeParams(UnsubscribeParams):
    """Topics to subscribe to, and the rate of the periodic ones."""

    rate_hz: Annotated[float, Field(ge=1, le=MAX_RATE)] | None = None
    """rate of the periodic topics; default 10"""


class StateEvent(CauseAndRemedy):
    """The daemon changed state."""

    old: DaemonStateName
    new: DaemonStateName
    word: str = Field(default_factory=lambda known: STATE_WORDS[known["new"]])
    """the new state in plain words"""
    epoch: Epoch


class ContactsEvent(ApiMessage):
    """All contacts after a change, before a pattern is selected for them."""

    contacts: list[ContactStatus]


class PatternEvent(PatternFields):
    """A pattern that the amplifiers confirmed."""

    latency_ms: float | None
    """from the touch to the last byte of the command; null if none was needed"""


class SilenceEvent(ApiMessage):
    """No channel is driven; if a link is lost (see the state), as far as is known."""

    contacts: list[ContactStatus]
    reason: str
    latency_ms: float | None
    """null if no command was needed"""


class AmplifiersEvent(ApiMessage):
    """All amplifiers, at the subscribed rate."""

    amplifiers: list[AmplifierStatus]


class LatencyEvent(ApiMessage):
    """Latencies, at the subscribed rate."""

    latency_ms: LatencySummary


class LogEvent(ApiMessage):
    """A record of the daemon's log."""

    level: Literal["info", "warning", "error"]
    message: str
    cause: str | None
    remedy: str | None


class LinkEvent(ApiMessage):
    """The link to amplifiers was lost, could not be reopened, or was reopened.

    Degraded: an amplifier does not reply but may still play; nothing new is played until it replies
    (restored) or is lost.
    """

    event: Literal["degraded", "restored", "lost", "retry", "reopened"]
    amplifier: str | None
    """name of the amplifier, if known"""
    message: str
    remedy: str | None


class LayoutEvent(ApiMessage):
    """The layout was changed or replaced; its effects can differ."""

    name: str | None = None
    """name of the current layout; null if there is none"""
    layout: dict[str, Any] | None
    """the surface layout; null without one"""


class InputsEvent(ApiMessage):
    """A touch input was opened, fell silent or was lost, or touches were rejected."""

    inputs: list[TouchInputStatus]
    """all configured inputs"""
    rejected_touches: dict[str, Count]
    """number of rejected touches by reason, for all sources together"""


class TopicData(NamedTuple):
    """A topic of notifications."""

    data: type[ApiMessage]
    summary: str
    sent: Literal["always", "newest", "periodically"] = "always"
    """After every change; or only the newest change, at most 60 times per second; or periodically,
    at the rate of the subscription."""


TOPICS: dict[Topic, TopicData] = {
    "state": TopicData(StateEvent, "every change of state or epoch, with its cause"),
    "contacts": TopicData(ContactsEvent, "fingers touched, moved or lifted", "newest"),
    "pattern": TopicData(
        PatternEvent, "the current playback, as confirmed by the amplifiers", "newest"
    ),
    "silence": TopicData(SilenceEvent, "playback has ended, and why", "newest"),
    "amplifiers": TopicData(
        AmplifiersEvent, "status of the amplifiers, at rate_hz", "periodically"
    ),
    "latency": TopicData(LatencyEvent, "latency from touch to command, at rate_hz", "periodically"),
    "log": TopicData(
        LogEvent, "log records of level info and above, except state and link changes"
    ),
    "link": TopicData(LinkEvent, "an amplifier link was degraded, lost or reopened"),
    "layout": TopicData(LayoutEvent, "the surface layout was changed or replaced"),
    "inputs": TopicData(
        InputsEvent,
        "changes of touch inputs (lost, mute, restored) and rejected touches, every second",
    ),
    "strength": TopicData(
        StrengthResult, "strengths of sources, clients and regions, at rate_hz", "periodically"
    ),
}
"""Every topic, by name."""


class EventParams(ApiMessage):
    """Parameters of an `event` notification."""

    topic: Topic
    time_s: float
    """on CLOCK_MONOTONIC"""
    lost: Count
    """notifications dropped before this one because the client reads too slowly"""
    data: dict[str, object]


class Method(NamedTuple):
    """A method of the API, and how its requests are treated."""

    params: type[ApiMessage]
    result: type[ApiMessage]
    is_limited: bool = True
    """Whether requests count toward a client's rate limit."""
    silences: bool = False
    """Whether the method silences the plate."""
    in_reserve: bool = False
    """Whether reserve connections can use the method."""
    needs_reply: bool = False
    """Whether a request is carried out only for a client that receives the reply."""
    is_repeated: bool = True
    """Whether clients repeat the request after a lost connection, which can carry it out twice."""
    over_http: bool = True
    """Whether the method works without a persistent connection."""


METHODS: dict[str, Method] = {
    "hello": Method(HelloParams, HelloResult, in_reserve=True),
    "status": Method(Empty, StatusResult, in_reserve=True),
    "arm": Method(ArmParams, ArmResult, needs_reply=True, is_repeated=False),
    "renew": Method(RenewParams, RenewResult),
    "disarm": Method(DisarmParams, Empty, is_limited=False, silences=True, in_reserve=True),
    "stop": Method(RequestedBy, StopResult, is_limited=False, silences=True, in_reserve=True),
    # A repetition would acknowledge a stop that came meanwhile.
    "clear": Method(ClearParams, Empty, is_repeated=False),
    # Only the newest frame counts, so frames never queue up.
    "touch": Method(TouchParams, Empty, is_limited=False),
    "layout": Method(LayoutParams, LayoutResult),
    "reload": Method(Empty, ReloadResult),
    "effects": Method(Empty, EffectsResult),
    "play": Method(PlayParams, PlayResult, is_repeated=False),
    "strength": Method(StrengthParams, StrengthResult),
    "subscribe": Method(SubscribeParams, Empty, over_http=False),
    "unsubscribe": Method(UnsubscribeParams, Empty, over_http=False),
}
"""Every method, by name."""

SILENCING = frozenset(name for name, method in METHODS.items() if method.silences)
"""Names of the methods that silence the plate."""
