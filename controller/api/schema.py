"""What several messages of the API are made of; every number's key carries its unit."""

import re
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

API_VERSION = "1.0"
"""Major and minor: another major cannot be talked to, a higher minor only has more to say."""

MIN_LEASE = 1.0  # s
MAX_LEASE = 60.0  # s; whoever is gone for longer cannot say stop
MAX_RATE = 60.0  # Hz; no screen shows more

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
"""The daemon's state, by the names of CiA 402, and COMM_LOST."""

PhaseName: TypeAlias = Literal["closed", "disarmed", "armed", "lost"]
"""How the amplifiers stand, all of them together."""

Topic: TypeAlias = Literal[
    "state", "contacts", "pattern", "silence", "amplifiers", "latency", "log", "link", "layout"
]

_ONE_LINE = r"^[^\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]+$"


def _on_one_line(text: str) -> str:
    if not re.fullmatch(_ONE_LINE, text):
        raise ValueError("must be one line, without characters that a terminal obeys")
    return text


Name: TypeAlias = Annotated[
    str,
    Field(min_length=1, max_length=80, json_schema_extra={"pattern": _ONE_LINE}),
    AfterValidator(_on_one_line),
]
"""A short text on one line, without what could garble a terminal."""

Count: TypeAlias = Annotated[int, Field(ge=0)]


class Message(BaseModel):
    """Part of a message: no unknown keys, nothing converted behind one's back, no NaN."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Empty(Message):
    """An empty object: no parameters, or nothing to say but that it was done."""


class EraPosition(Message):
    """Where an ERA stands under the plate, from its south-west corner, and how it is wired."""

    name: str
    x_m: float
    y_m: float
    amplifier: str
    channel: Count


class RigSummary(Message):
    """The rig, as far as a picture of it needs."""

    length_m: float
    width_m: float
    eras: list[EraPosition]
    simulated: bool = Field(description="whether any of its amplifiers is a simulated one")
    frequency_hz: list[float] = Field(description="lowest and highest that the rig allows")


class TableSummary(Message):
    """The localization table in use."""

    fingerprint: str = Field(description="of the plate on its ERAs that it was built for")
    mode: str = Field(description="switched, graded, signed or phased")
    frequencies_hz: list[float]
    cells_x: Count
    cells_y: Count


class TouchPoint(Message):
    """One finger of a touch frame."""

    id: Annotated[int, Field(ge=-(2**31), lt=2**31)] = Field(
        description="the client's own, the same from down to up"
    )
    x_m: float = Field(description="from the plate's south-west corner")
    y_m: float = Field(description="from the plate's south-west corner, upwards")


class ContactStatus(Message):
    """A finger on the plate, and what it is predicted to feel."""

    source: str
    id: int
    x_m: float
    y_m: float
    role: Literal["target", "quiet"] | None = Field(
        None, description="who shall feel it, and who nothing; null while nothing is decided"
    )
    level_db_sl: float | None = Field(
        None, description="predicted vibration above the threshold of feeling; null if unknown"
    )
    contrast_db: float | None = Field(
        None, description="predicted, from the target to the loudest quiet finger; null if alone"
    )
    effect: str | None = Field(None, description="the effect that plays for it, where one does")


class PlayedTone(Message):
    """What an amplifier really plays on one ERA."""

    frequency_hz: float
    level: float = Field(description="0 to 1 of the full stroke")
    phase_deg: float


class LinkCounters(Message):
    """How well the link to an amplifier does, since it was opened; see the wire protocol."""

    frames_out: Count
    frames_in: Count
    bad: Count = Field(description="damaged frames")
    foreign: Count = Field(description="good frames that nobody waited for")
    events: Count
    retries: Count
    timeouts: Count
    refusals: Count
    round_trip_ms: float | None = Field(description="of the last request")


class AmplifierStatus(Message):
    """One amplifier, as its last answer tells; what nobody knows of it is null."""

    name: str
    url: str
    serial_number: str | None
    state: str | None = Field(description="its own, by the names of CiA 402")
    fault: str | None
    levels: list[float] = Field(
        description="0 to 1 of the full stroke, by channel, as it reports; empty if nobody knows"
    )
    temperature_c: float | None
    high_voltage: bool | None
    high_voltage_v: float | None
    reply_age_s: float | None = Field(description="since its last answer")
    lost: bool = Field(description="whether it cannot be reached: nobody knows how it is")
    closed_with_lost: bool = Field(
        description="whether it answered to the last, but was closed with another that is lost"
    )
    statistics: LinkCounters


class LatencySummary(Message):
    """From a touch frame's arrival to the last byte of the command it led to, all in ms.

    Of the last patterns; median and percentiles are null before the first.
    """

    count: Count
    median: float | None
    p99: float | None
    p999: float | None
    histogram: list[tuple[float, int]] = Field(
        description="[upper edge in ms, how many up to it and above the edge before]; "
        "what is above the last edge counts there"
    )


class EffectDescription(Message):
    """An effect that can be played by its name."""

    name: str
    kind: str
    description: str
    parameters: dict[str, Any] = Field(description="by their names in a layout, in SI units")
