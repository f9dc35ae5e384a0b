"""Data types that messages of the API share; every number's key carries its unit."""

import ast
import inspect
import re
from itertools import pairwise
from typing import Annotated, Any, Literal, TypeAlias, cast

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from drivers.host.statuses import ReportKind

API_VERSION = "1.0"
"""major.minor: major versions are incompatible; a higher minor version only adds."""

PROMISED = (
    "felt contrast, target over loudest quiet finger: at least this on 90 % of plates within the "
    "rig's tolerances; null for a single finger"
)
"""Description of the promised contrast."""

MIN_LEASE = 1.0  # s
MAX_LEASE = 60.0  # s; without a client, nothing can stop the plate sooner
MAX_RADIUS = 1.0  # m; of a contact
MAX_RATE = 60.0  # Hz; of notifications: the refresh rate of a screen

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
"""State of the daemon: the states of CiA 402, and COMM_LOST."""

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
"""Label of each daemon or amplifier state, for display."""


def headline(state: DaemonStateName, cause: str) -> str:
    """Return a state and its cause as one line of text."""
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
        description="increases with every state change, stop, fault and loss; starts at random",
    ),
]


def one_line(text: str) -> str:
    """Return text of several lines on one line."""
    return " ".join(text.split())


class ApiMessage(BaseModel):
    """Part of a message: no unknown keys, no implicit conversion, no NaN.

    The text below a field is its description in the schema.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Return the schema with the descriptions of the fields."""
        reference = handler(core_schema)
        schema = handler.resolve_ref_schema(reference)
        for name, description in cls.descriptions().items():
            schema["properties"][name]["description"] = description
        return reference

    @classmethod
    def descriptions(cls) -> dict[str, str]:
        """Return the descriptions of the fields by name, read from the source of the class.

        pydantic can read them when it makes the class, but that would delay every command.
        """
        descriptions = {}
        messages = [base for base in cls.__mro__ if issubclass(base, ApiMessage)]
        for message in reversed(messages):
            definition = ast.parse(inspect.getsource(message)).body[0]
            for field, text in pairwise(cast(ast.ClassDef, definition).body):
                match field, text:
                    case (
                        ast.AnnAssign(target=ast.Name(id=name)),
                        ast.Expr(value=ast.Constant(value=str(description))),
                    ):
                        descriptions[name] = one_line(description)
        for name, info in cls.model_fields.items():
            if info.description is not None:
                descriptions[name] = info.description
        return descriptions


class Empty(ApiMessage):
    """An empty object: no parameters, or no result."""


class CauseAndRemedy(ApiMessage):
    """Cause of a state, and its remedy."""

    cause: str
    """cause of the state"""
    remedy: str | None
    """remedy; null if no action is needed"""


class EraPosition(ApiMessage):
    """Position of an ERA under the plate, from the south-west corner, and its wiring."""

    name: str
    x_m: float
    y_m: float
    amplifier: str
    channel: Count


class RigSummary(ApiMessage):
    """The data needed to draw the rig."""

    length_m: float
    width_m: float
    eras: list[EraPosition]
    simulated: bool
    """whether any of its amplifiers is simulated"""
    frequency_hz: list[float]
    """lowest and highest allowed by the rig"""


class TableSummary(ApiMessage):
    """The current localization table."""

    fingerprint: str
    """identifies the plate and ERAs it was built for"""
    mode: str
    """drive mode, such as phased"""
    frequencies_hz: list[float]
    cells_x: Count
    cells_y: Count


class TouchPoint(ApiMessage):
    """One finger of a touch frame."""

    id: Annotated[int, Field(ge=-(2**31), lt=2**31)]
    """chosen by the client, constant from touch-down to lift"""
    x_m: float
    """from the plate's south-west corner"""
    y_m: float
    """from the plate's south-west corner, upwards"""
    radius_m: Annotated[float, Field(ge=0, le=MAX_RADIUS)] | None = None
    """radius of the contact, if known; 12.5 mm or more is a resting hand"""


class TouchInputStatus(ApiMessage):
    """A configured touch input and whether it works."""

    name: str
    url: str
    state: Literal["open", "mute", "missing", "ended"]
    """mute: open, but silent although it should send; missing: not opened, or lost, and being
    retried; ended: a recording at its end"""
    problem: str | None = None
    """why it is mute or missing, and what to do; null if it is neither"""


class ContactStatus(ApiMessage):
    """A finger on the plate and its predicted sensation."""

    source: str
    id: int
    x_m: float
    y_m: float
    role: Literal["target", "quiet", "hand", "surplus"] | None = None
    """target: feels the pattern; quiet: kept quiet; hand: a resting hand, and surplus: a finger
    beyond max_fingers, which count only as loads; null before the first decision"""
    level_db_sl: float | None = None
    """level of a target relative to the rig's threshold set (`threshold` of `status`): at least
    this if its vibration continues, on the nominal plate if it is short; null if unknown"""
    promised_level_db_sl: float | None = None
    """at least this level on 90 % of plates within the rig's tolerances"""
    promised_contrast_db: float | None = Field(None, description=PROMISED)
    contrast_db: float | None = None
    """predicted felt contrast, target over loudest quiet finger; null for a single finger"""
    effect: str | None = None
    """the effect selected for it, if any"""
    feels: str | None = None
    """the effect that the finger feels: its own, or another finger's"""
    verdict: Literal["own", "mixed", "shared", "held back"] | None = None
    """how a target feels its vibration. own: separately; mixed: together with other vibrations
    (promised contrast below 12 dB, or others are felt during its pauses); shared: it feels another
    finger's vibration instead; held back: not at all"""
    frequency_hz: float | None = None
    """requested frequency of its vibration, before rounding; null if it has several frequencies"""
    foreign_level_db_sl: float | None = None
    """crosstalk level of others' vibrations here, not exceeded on 90 % of plates, relative to the
    most sensitive published thresholds (not comparable with level_db_sl); null if there are no
    other vibrations"""
    rig_foreign_level_db_sl: float | None = None
    """the same level relative to the rig's threshold set, like level_db_sl"""
    is_foreign_felt: bool = False
    """whether other vibrations can be felt here (foreign_level_db_sl above 0); with verdict own
    they are at least 12 dB weaker"""
    leak_db_sl: float | None = None
    """crosstalk level at the finger's current position on the nominal plate, relative to the rig's
    threshold set; can exceed the promise while the finger moves; sent only in the status; null if
    there are no other vibrations"""
    held_back: str | None = None
    """why its own effect, or a click over its continuous effect, is not played; null if it is"""
    load: float = 1.0
    """load on the plate relative to the rig's fingertip; 1 if not reported"""


class PlayedTone(ApiMessage):
    """An ERA's tone, confirmed by the amplifier."""

    frequency_hz: float
    level: float
    """0 to 1 of the full stroke"""
    phase_deg: float


class PatternFields(ApiMessage):
    """The contacts, and the tones played for them."""

    contacts: list[ContactStatus]
    """in order of arrival, newest last"""
    drive: dict[str, PlayedTone]
    """tones of the newest vibration by ERA; silent ERAs are omitted"""
    layers: dict[str, dict[str, PlayedTone]] = Field(default_factory=dict)
    """tones of each vibration by layer, then by ERA, in the format of `drive`; an ERA plays the sum
    of its layers"""
    promised_contrast_db: float | None = Field(None, description=PROMISED)
    predicted_contrast_db: float | None = None
    """the same on the nominal plate"""
    predicted_level_db_sl: float | None


class LinkCounters(ApiMessage):
    """Counters of the link to an amplifier since it was opened; see the wire protocol."""

    frames_out: Count
    frames_in: Count
    invalid_frames: Count
    """frames with a wrong checksum, length, format or version"""
    unexpected_frames: Count
    """valid but unexpected frames"""
    events: Count
    retries: Count
    timeouts: Count
    refusals: Count
    round_trip_ms: float | None
    """of the last request"""


class AmplifierSilence(ApiMessage):
    """Whether an amplifier is silent, after a stop or while it does not reply."""

    silence: Literal["confirmed_silent", "may_play", "watchdog_elapsed"]
    """confirmed_silent: confirmed by a status after the stop; watchdog_elapsed: unconfirmed, but
    the watchdog should have silenced it by now"""
    may_play_for_s: float | None
    """time until its watchdog should have silenced it; null if its watchdog is unknown or silence
    is confirmed"""
    cause: str

    @property
    def words(self) -> str:
        """Return the silence as text."""
        match self.silence, self.may_play_for_s:
            case "confirmed_silent", _:
                return "confirmed silent"
            case "may_play", float(left):
                return f"may play for {left:.2f} s more"
            case "may_play", _:
                return "may play until it is switched off"
        return "unconfirmed, its watchdog has elapsed"


class AmplifierReport(CauseAndRemedy):
    """A condition other than a fault that an amplifier reports while it continues to play."""

    kind: ReportKind


class AmplifierStatus(ApiMessage):
    """An amplifier's state from the last reply; unknown values are null."""

    name: str
    url: str
    serial_number: str | None
    state: str | None
    """CiA 402 name of the amplifier's own state"""
    word: str | None = Field(default_factory=lambda known: STATE_WORDS.get(known["state"]))
    """the state in plain words"""
    fault: str | None
    levels: list[float]
    """reported level of each channel, 0 to 1 of the full stroke; empty if unknown"""
    high_voltage: bool | None
    reply_age_s: float | None
    """time since its last reply"""
    clock_skew_us: float | None = None
    """RMS error of its clock relative to the others, estimated by the host; null for a single or
    unsynchronized amplifier"""
    degraded: bool = False
    """whether the amplifier does not reply but may still play; no new vibration starts meanwhile"""
    lost: bool
    """whether the link to it is lost"""
    closed_with_lost: bool
    """whether its link was closed, although it replied, because another amplifier is lost"""
    reports: list[AmplifierReport] = Field([])
    """reports from the last 10 s"""
    silence: AmplifierSilence | None = None
    """while it does not reply: whether it is silent; null while it replies"""
    statistics: LinkCounters

    # begin: written by docs/generators/client_stub.py readings

    temperature_c: float | None
    """of the amplifier"""
    high_voltage_v: float | None
    """of the supply; 0: not measured"""

    # end


class LatencySummary(ApiMessage):
    """Latency from the arrival of a touch frame to the last byte of its command, in ms.

    Computed from the latest patterns; median and percentiles are null before the first pattern.
    """

    count: Count
    median: float | None
    p99: float | None
    p999: float | None
    histogram: list[tuple[float, int]]
    """[upper edge in ms, number above the previous edge and up to this one]; values above the last
    edge are counted in the last"""


class EffectDescription(ApiMessage):
    """An effect that `play` accepts."""

    name: str
    kind: str
    description: str
    parameters: dict[str, Any]
    """parameters by name in a layout file, in SI units"""
