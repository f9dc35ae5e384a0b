"""The effect that a client requests by `play`: one of the layout, or its own points and taps."""

from typing import NamedTuple

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import PlayParams
from controller.content.points import pattern_of_points
from controller.effects.effect import MIN_DB_SL, Effect
from controller.effects.file_effect import File
from controller.effects.layout import SurfaceLayout
from controller.play.intent import MAX_DB_SL
from model.errors import InputError
from model.finger import STRONG_DB_SL


class RequestedEffect(NamedTuple):
    """An effect that a client wants to play."""

    name: str
    effect: Effect
    max_db_sl: float
    """Highest level that the client can request [dB SL]."""

    def check_level(self, level: float, *, is_named: bool) -> None:
        """Raise RpcError for a level [dB SL] out of range; is_named: whether a layout names it."""
        if not MIN_DB_SL <= level <= self.max_db_sl:
            owner = f" of effect {self.name!a}" if is_named else ""
            raise RpcError(
                ErrorCode.REFUSED,
                f"level{owner} must be from {MIN_DB_SL:g} to {self.max_db_sl:g} dB SL, got "
                f"{level:g}",
                where="level_db_sl",
                remedy="choose a level in this range, or change the level in the surface layout",
            )


def requested_effect(params: PlayParams, layout: SurfaceLayout) -> RequestedEffect:
    """Return the effect to play; raises RpcError."""
    has_points = bool(params.points or params.taps)
    if (params.effect is None) != has_points:
        raise RpcError(
            ErrorCode.INVALID_PARAMS,
            "play must have either an effect, or points and taps, got both or neither",
            where="effect",
            remedy="leave one of them out",
        )
    if params.effect is None:
        return _effect_of_points(params, layout)
    return _effect_of_layout(params.effect, layout, loop=params.loop)


def _effect_of_points(params: PlayParams, layout: SurfaceLayout) -> RequestedEffect:
    """Return the effect of the points and taps of a request; raises RpcError."""
    try:
        pattern = pattern_of_points(params.points, params.taps)
    except InputError as error:
        raise RpcError(ErrorCode.INVALID_PARAMS, f"{error}", where="points") from error
    max_db_sl = min(layout.max_db_sl, MAX_DB_SL)
    level = min(STRONG_DB_SL, max_db_sl)
    effect = File.of(pattern, name="points", level_db_sl=level, loop=params.loop)
    return RequestedEffect("points", effect, max_db_sl)


def _effect_of_layout(name: str, layout: SurfaceLayout, *, loop: bool) -> RequestedEffect:
    """Return the effect of a layout with a name, repeated on request; raises RpcError."""
    effect = layout.effects.get(name)
    if effect is None:
        raise RpcError(
            ErrorCode.REFUSED,
            f"unknown effect {name!a}",
            where="effect",
            remedy=f"choose one of {', '.join(sorted(layout.effects))}",
        )
    max_db_sl = MAX_DB_SL if effect.level_db_sl is None else effect.level_db_sl
    if not loop:
        return RequestedEffect(name, effect, max_db_sl)
    if not isinstance(effect, File):
        raise RpcError(
            ErrorCode.REFUSED,
            f"loop must be left out for effect {name!a}, which is not a file",
            where="loop",
        )
    return RequestedEffect(name, effect.model_copy(update={"loop": True}), max_db_sl)
