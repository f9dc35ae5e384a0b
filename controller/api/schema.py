"""Data types that messages of the API share; every number's key carries its unit."""

import re
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from drivers.host.clock import ReportKind

API_VERSION = "1.0"
"""major.minor: major versions are incompatible; a higher minor version only adds."""

PROMISED = (
    "felt contrast, target over loudest quiet finger, that nine of ten plates within the rig's "
    "uncertainty give; null for a single finger"
)
"""Description of the figure that is promised."""

MIN_LEASE = 1.0  # s
MAX_LEASE = 60.0  # s; a client that has gone away cannot stop anything meanwhile
MAX_RATE = 60.0  # Hz; of notifications, as fast as a screen shows them

DaemonStateName: TypeAlias = Literal[
    "NOT_READY",
    "SWITCH_ON_DISABLED",
    "READY_TO_SWITCH_ON",
    "SWITCHED_ON",
    "OPERATION_ENABLED",
    "QUICK_STOP_ACTIVE",
    "FAULT_REACTION_ACTIVE",
    "FAULT",
    "COMM_LOST",
]
"""State of the daemon: the names of CiA 402, and COMM_LOST."""

STATE_WORDS: dict[str | None, str] = {
    "NOT_READY": "not ready",
    "SWITCH_ON_DISABLED": "off",
    "READY_TO_SWITCH_ON": "ready",
    "SWITCHED_ON": "on",
    "OPERATION_ENABLED": "on",
    "QUICK_STOP_ACTIVE": "stopped",
    "FAULT_REACTION_ACTIVE": "fault",
    "FAULT": "fault",
    "COMM_LOST": "lost",
}
"""What people see of a state, of the daemon and of an amplifier."""


def headline(state: DaemonStateName, cause: str) -> str:
    """A state and its cause in one line for people."""
    word = STATE_WORDS[state]
    return cause if cause.startswith(word) else f"{word}: {cause}"


Topic: TypeAlias = Literal[
    "state",
    "contacts",
    "pattern",
    "silence",
    "amplifiers",
    "latency",
    "log",
    "link",
    "layout",
    "inputs",
    "strength",
]

_ONE_LINE = r"^[^\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]+$"


def _check_one_line(text: str) -> str:
    if not re.fullmatch(_ONE_LINE, text):
        raise ValueError("must be one line without control characters")
    return text


Name: TypeAlias = Annotated[
    str,
    Field(min_length=1, max_length=80, json_schema_extra={"pattern": _ONE_LINE}),
    AfterValidator(_check_one_line),
]
"""A short text on one line, without control characters."""

Count: TypeAlias = Annotated[int, Field(ge=0)]
Epoch: TypeAlias = Annotated[
    int,
    Field(
        ge=0,
        description="rises with every change of state, stop, fault and loss; begins by chance",
    ),
]


class ApiMessage(BaseModel):
    """Part of a message: no unknown keys, no implicit conversion, no NaN."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Empty(ApiMessage):
    """An empty object: no parameters, or no result."""


class CauseAndRemedy(ApiMessage):
    """A state, and why."""

    cause: str = Field(description="why it is so")
    remedy: str | None = Field(description="what to do about it; null if nothing")


class EraPosition(ApiMessage):
    """Position of an ERA under the plate, from the south-west corner, and its wiring."""

    name: str
    x_m: float
    y_m: float
    amplifier: str
    channel: Count


class RigSummary(ApiMessage):
    """The rig, as far as drawing it needs."""

    length_m: float
    width_m: float
    eras: list[EraPosition]
    simulated: bool = Field(description="whether any of its amplifiers is simulated")
    frequency_hz: list[float] = Field(description="lowest and highest that the rig allows")


class TableSummary(ApiMessage):
    """The localization table in use."""

    fingerprint: str = Field(description="of the plate and ERAs that it was built for")
    mode: str = Field(description="switched or phased")
    frequencies_hz: list[float]
    cells_x: Count
    cells_y: Count


class TouchPoint(ApiMessage):
    """One finger of a touch frame."""

    id: Annotated[int, Field(ge=-(2**31), lt=2**31)] = Field(
        description="chosen by the client, constant from touch-down to lift"
    )
    x_m: float = Field(description="from the plate's south-west corner")
    y_m: float = Field(description="from the plate's south-west corner, upwards")
    radius_m: float | None = Field(
        None, description="of the contact, where it is known; a hand rests from 12.5 mm on"
    )


class TouchInputStatus(ApiMessage):
    """A touch input of the configuration: whether touches can come from it."""

    name: str
    url: str
    state: Literal["open", "mute", "missing", "ended"] = Field(
        description="mute: open, but nothing comes although it should; missing: not opened, or "
        "lost, and tried again; ended: a recording at its end"
    )
    problem: str | None = Field(
        None, description="why it is mute or missing, and what to do; null if it is neither"
    )


class ContactStatus(ApiMessage):
    """A finger on the plate and its predicted sensation."""

    source: str
    id: int
    x_m: float
    y_m: float
    role: Literal["target", "quiet", "hand", "surplus"] | None = Field(
        None,
        description="whether it is to feel the pattern, or only its load counts: of a hand that "
        "rests, or of a finger beyond max_fingers; null before the first decision",
    )
    level_db_sl: float | None = Field(
        None,
        description="predicted level of a target relative to the rig's threshold set (`threshold` "
        "of `status`); null if unknown",
    )
    promised_contrast_db: float | None = Field(None, description=PROMISED)
    contrast_db: float | None = Field(
        None, description="predicted, target over loudest quiet finger; null for a single finger"
    )
    effect: str | None = Field(None, description="what it is to feel: an effect, if any")
    feels: str | None = Field(
        None, description="the effect that it feels: its own, or that of another finger"
    )
    verdict: Literal["own", "mixed", "shared", "held back"] | None = Field(
        None,
        description="what a target feels: its own, mixed with the contents of others (promised "
        "contrast below 12 dB, or these are felt beside one that pauses), the content of another "
        "finger, or none",
    )
    frequency_hz: float | None = Field(
        None,
        description="of what it feels, as asked for, which amplifiers may round; null for several",
    )
    foreign_level_db_sl: float | None = Field(
        None,
        description="of the contents of others there, which nine of ten plates do not exceed, by "
        "the most sensitive thresholds: not to be compared with level_db_sl; null where there are "
        "none",
    )
    rig_foreign_level_db_sl: float | None = Field(
        None,
        description="the same level relative to the rig's threshold set, as level_db_sl is",
    )
    is_foreign_felt: bool = Field(
        False,
        description="whether the contents of others may be felt there: foreign_level_db_sl is "
        "above 0; beside a verdict own these are weaker by 12 dB or more",
    )
    leak_db_sl: float | None = Field(
        None,
        description="of the contents of others where it is now, on the nominal plate, relative "
        "to the rig's threshold set: more than promised while it moves; in the status only, null "
        "where there are none",
    )
    held_back: str | None = Field(
        None,
        description="why it does not feel an effect of its own, or not its click over what lasts; "
        "null if it does",
    )
    load: float = Field(
        1.0,
        description="on the plate, relative to the rig's fingertip; 1 where none is reported",
    )


class PlayedTone(ApiMessage):
    """Tone of one ERA as confirmed by its amplifier."""

    frequency_hz: float
    level: float = Field(description="0 to 1 of the full stroke")
    phase_deg: float


class PatternFields(ApiMessage):
    """The contacts, and what plays for them."""

    contacts: list[ContactStatus] = Field(description="in order of arrival, newest last")
    drive: dict[str, PlayedTone] = Field(
        description="of the newest content, by ERA, without silent ones"
    )
    layers: dict[str, dict[str, PlayedTone]] = Field(
        default_factory=dict,
        description="what plays of each content, by layer, then as `drive`; they add up",
    )
    promised_contrast_db: float | None = Field(None, description=PROMISED)
    predicted_contrast_db: float | None = Field(None, description="the same, nominal")
    predicted_level_db_sl: float | None


class LinkCounters(ApiMessage):
    """Counters of the link to an amplifier since it was opened; see the wire protocol."""

    frames_out: Count
    frames_in: Count
    invalid_frames: Count = Field(
        description="frames with a wrong checksum, length, form or version"
    )
    unexpected_frames: Count = Field(description="valid but unexpected frames")
    events: Count
    retries: Count
    timeouts: Count
    refusals: Count
    round_trip_ms: float | None = Field(description="of the last request")


class AmplifierSilence(ApiMessage):
    """What an amplifier may play, after a stop or where it does not reply."""

    silence: Literal["confirmed_silent", "may_play", "watchdog_elapsed"] = Field(
        description="confirmed by its status after a stop; may play; or unconfirmed, but its "
        "watchdog must have silenced it"
    )
    may_play_for_s: float | None = Field(
        description="time until its watchdog must have silenced it; null if that is not known to "
        "happen, or if silence is confirmed"
    )
    cause: str

    @property
    def words(self) -> str:
        """For people."""
        match self.silence, self.may_play_for_s:
            case "confirmed_silent", _:
                return "confirmed silent"
            case "may_play", float(left):
                return f"may play for {left:.2f} s more"
            case "may_play", _:
                return "may play until it is switched off"
        return "unconfirmed, its watchdog has elapsed"


class AmplifierReport(CauseAndRemedy):
    """What an amplifier reports beside a fault, and who feels it; it plays on."""

    kind: ReportKind


class AmplifierStatus(ApiMessage):
    """One amplifier according to its last reply; null where unknown."""

    name: str
    url: str
    serial_number: str | None
    state: str | None = Field(description="its own state, by the names of CiA 402")
    word: str | None = Field(
        default_factory=lambda known: STATE_WORDS.get(known["state"]),
        description="the state in a word for people",
    )
    fault: str | None
    levels: list[float] = Field(
        description="0 to 1 of the full stroke, by channel, as it reports; empty if unknown"
    )
    high_voltage: bool | None
    reply_age_s: float | None = Field(description="time since its last reply")
    clock_skew_us: float | None = Field(
        None,
        description="rms error of its clock against those of the others, as the host sees it; null "
        "for one alone, and where it is not held to them",
    )
    degraded: bool = Field(
        False, description="whether it does not reply but may still play, so that nothing new plays"
    )
    lost: bool = Field(description="whether the link to it is lost")
    closed_with_lost: bool = Field(
        description="whether it still replied but was closed because another one is lost"
    )
    reports: list[AmplifierReport] = Field(
        [], description="what it has reported within the last 10 s"
    )
    silence: AmplifierSilence | None = Field(
        None, description="what it may play while it does not reply; null while it does"
    )
    statistics: LinkCounters

    # begin: written by docs/generators/client_stub.py readings

    temperature_c: float | None = Field(description="of the amplifier")
    high_voltage_v: float | None = Field(description="of the supply; 0: not measured")

    # end


class LatencySummary(ApiMessage):
    """Latency from a touch frame's arrival to the last byte of the resulting command, all in ms.

    Over the last patterns; median and percentiles are null before the first.
    """

    count: Count
    median: float | None
    p99: float | None
    p999: float | None
    histogram: list[tuple[float, int]] = Field(
        description="[upper edge in ms, number above the previous edge and up to this one]; "
        "values above the last edge are counted in the last"
    )


class EffectDescription(ApiMessage):
    """An effect that `play` accepts."""

    name: str
    kind: str
    description: str
    parameters: dict[str, Any] = Field(description="by their names in a layout, in SI units")
