"""What clients ask of a daemon, method by method: the one list that both clients have."""

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, ParamSpec, TypeVar, cast, get_args

from pydantic import ValidationError

from controller.api.client_protocol import result_of
from controller.api.methods import (
    ArmParams,
    ArmResult,
    EffectsResult,
    HelloParams,
    HelloResult,
    PlayParams,
    RenewParams,
    RenewResult,
    StatusResult,
    SubscribeParams,
    TouchParams,
    UnsubscribeParams,
)
from controller.api.schema import Empty, Message, Topic, TouchPoint
from model.arguments import shown
from model.errors import InputError, first_problem

DEFAULT_LEASE = 10.0  # s

_P = ParamSpec("_P")
_MessageT = TypeVar("_MessageT", bound=Message)
_ResultT = TypeVar("_ResultT")


@dataclass(frozen=True)
class Call(Generic[_ResultT]):
    """A request, and how its answer is read; that raises RpcError or Unreachable."""

    method: str
    params: Message
    read: Callable[[Mapping[str, Any]], _ResultT]


def as_message(model: type[_MessageT]) -> Callable[[Mapping[str, Any]], _MessageT]:
    """Reads an answer as a message."""
    return lambda said: result_of(said, model)


def greeting(name: str) -> HelloParams:
    """What a client begins with; raises InputError for a name that cannot be sent."""
    try:
        return HelloParams(client=name)
    except ValidationError as error:
        _, said = first_problem(error)
        raise InputError(f"name is {shown(name)}; it {said}") from None


def hello(client: str) -> Call[HelloResult]:
    """Say who one is; what the daemon drives."""
    return Call("hello", HelloParams(client=client), as_message(HelloResult))


def status() -> Call[StatusResult]:
    """How everything is."""
    return Call("status", Empty(), as_message(StatusResult))


def arm(owner: str, *, lease_s: float = DEFAULT_LEASE) -> Call[ArmResult]:
    """High voltage on until the lease is over; `armed` renews it by itself."""
    return Call("arm", ArmParams(owner=owner, lease_s=lease_s), as_message(ArmResult))


def renew(lease: str) -> Call[RenewResult]:
    """Keep the lease for as long again."""
    return Call("renew", RenewParams(lease=lease), as_message(RenewResult))


def disarm() -> Call[None]:
    """Silent along a short ramp, high voltage off."""
    return Call("disarm", Empty(), _done)


def stop() -> Call[None]:
    """Quick stop, latched until `clear`."""
    return Call("stop", Empty(), _done)


def clear() -> Call[None]:
    """Acknowledge a stop, or a fault whose cause is gone."""
    return Call("clear", Empty(), _done)


def touch(places: Sequence[tuple[float, float]], *, source: str = "python") -> Call[None]:
    """All fingers of a source, at x, y [m]: for 150 ms, so repeat it while they are down."""
    if not isinstance(places, Iterable):
        raise InputError(f"places is {shown(places)}; give a list of x, y in metres")
    at = [_place(place) for place in places]
    touches = [TouchPoint(id=id, x_m=x, y_m=y) for id, (x, y) in enumerate(at, start=1)]
    return Call("touch", TouchParams(source=source, touches=touches), _done)


def effects() -> Call[EffectsResult]:
    """The effects that can be played."""
    return Call("effects", Empty(), as_message(EffectsResult))


def play(
    effect: str, place: tuple[float, float], *, level_db_sl: float | None = None
) -> Call[None]:
    """Play an effect at x, y [m]."""
    x, y = _place(place)
    params = PlayParams(effect=effect, x_m=x, y_m=y, level_db_sl=level_db_sl)
    return Call("play", params, _done)


def subscribe(*topics: Topic, rate_hz: float | None = None) -> Call[None]:
    """Be told of topics; see `events`."""
    return Call("subscribe", SubscribeParams(topics=list(topics), rate_hz=rate_hz), _done)


def unsubscribe(*topics: Topic) -> Call[None]:
    """Be told of them no more."""
    return Call("unsubscribe", UnsubscribeParams(topics=list(topics)), _done)


def in_words(make: Callable[_P, Call[_ResultT]]) -> Callable[_P, Call[_ResultT]]:
    """The same call; what cannot be sent is an InputError that names the value."""

    def checked(*args: _P.args, **kwargs: _P.kwargs) -> Call[_ResultT]:
        try:
            return make(*args, **kwargs)
        except ValidationError as error:
            where, said = first_problem(error)
            raise InputError(f"{make.__name__}: {where} {said}") from None

    return checked


def name_after(make: Callable[..., Call[Any]], method: Callable[..., Any]) -> None:
    """Let a client's method have the name, the description and the signature of its call."""
    own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
    asked = inspect.signature(make)
    (answer,) = get_args(asked.return_annotation)
    method.__name__, method.__doc__ = make.__name__, make.__doc__
    method.__signature__ = asked.replace(  # type: ignore[attr-defined]
        parameters=[own, *asked.parameters.values()], return_annotation=answer
    )


def _place(given: object) -> tuple[float, float]:
    """One finger's place [m]."""
    try:
        x, y = (float(each) for each in cast("Iterable[float]", given))
    except (TypeError, ValueError):
        raise InputError(
            f"{shown(given)} is no place; a finger is at x, y in metres from the corner SW, such "
            "as (0.10, 0.05), and fingers are a list of such"
        ) from None
    return x, y


def _done(said: Mapping[str, Any]) -> None:
    result_of(said, Empty)
