"""What requests of the control socket must hold; other keys are ignored unless a form says so."""

from typing import Annotated, Any, Self, TypeAlias, TypeVar

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from model.errors import InputError
from registry.wording import first_problem

Request: TypeAlias = dict[str, Any]

_MAX_STEP = 3600.0  # s of virtual time in one request
_MAX_TONES = 64
_MAX_KEY = 60  # characters of a key in an error
_At = Annotated[tuple[FiniteFloat, FiniteFloat], Field(strict=False)]  # [x, y] in m
_Positive = Annotated[FiniteFloat, Field(gt=0)]
_Mass = Annotated[tuple[FiniteFloat, FiniteFloat, _Positive], Field(strict=False)]


class _Form(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True)


_T = TypeVar("_T", bound=_Form)


def read(form: type[_T], request: Request) -> _T:
    """Read a request by its form; raises InputError with the key."""
    try:
        return form.model_validate(request)
    except ValidationError as error:
        key, problem = first_problem(error)
        raise InputError(f"{key[:_MAX_KEY]}: {problem}".removeprefix(": ")) from None


class Fingers(_Form):
    """All fingers: positions, those without weight, and loads times that of the rig's fingertip."""

    fingers: dict[str, _At]
    observers: list[str] = []
    loads: dict[str, FiniteFloat] = {}

    @model_validator(mode="after")
    def _are_of_fingers(self) -> Self:
        if not {*self.observers, *self.loads} <= self.fingers.keys():
            raise ValueError("observers and loads must be of these fingers")
        return self


class Finger(_Form):
    """One finger by its id."""

    finger: Annotated[str, Field(min_length=1, max_length=40)]


class Touch(Finger):
    """One finger, where it is, and its load if it has another one."""

    at_m: _At
    load: FiniteFloat | None = None


class Window(_Form):
    """A window of time [s]."""

    since_s: FiniteFloat
    until_s: FiniteFloat

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if self.since_s >= self.until_s:
            raise ValueError("since_s must be less than until_s")
        return self


class Tones(Window):
    """Frequencies [Hz] within a window."""

    frequencies_hz: Annotated[list[_Positive], Field(min_length=1, max_length=_MAX_TONES)]


class Sensor(_Form):
    """A place, and fields of an `Accelerometer`; nothing else."""

    model_config = ConfigDict(extra="forbid")

    at_m: _At
    noise_density: FiniteFloat = Field(0.0, alias="noise_m_s2_rthz")
    reach: FiniteFloat = Field(0.0, alias="reach_m_s2")
    resolution: FiniteFloat = Field(0.0, alias="resolution_m_s2")
    scale: FiniteFloat = 1.0


class Sensors(_Form):
    """All sensors by name."""

    sensors: dict[str, Sensor]


class File(_Form):
    """A file to record to."""

    file: Annotated[str, Field(min_length=1)]


class PlateChange(_Form):
    """Factors of the plate as it was at first, and masses [x, y, kg]; nothing else."""

    model_config = ConfigDict(extra="forbid")

    op: str
    modulus: _Positive = 1.0
    stiffness: dict[str, _Positive] = {}
    masses: list[_Mass] = []


class Step(_Form):
    """Virtual time to go on by [s]."""

    seconds: Annotated[_Positive, Field(le=_MAX_STEP)]
