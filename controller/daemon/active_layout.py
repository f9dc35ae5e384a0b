"""The surface layout in force, replaceable while the control loop runs."""

import math
from collections.abc import Iterable

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import EffectsResult, PlayParams
from controller.api.schema import EffectDescription
from controller.effects.player import EffectPlayer
from controller.loop.table_query import MAX_DB_SL
from controller.sources.contacts import Contact

PLAY_RADIUS = 0.020
"""Largest distance [m] from the position of a requested effect to the finger that feels it."""


class ActiveLayout(EffectPlayer):
    """Plays the effects of a layout, and those that clients of the API request by name."""

    def effects(self) -> EffectsResult:
        """Describe the effects that can be requested by name."""
        return EffectsResult(
            effects=[
                EffectDescription(
                    name=name,
                    kind=effect.kind,
                    description=(type(effect).__doc__ or "").partition("\n")[0],
                    parameters=effect.model_dump(mode="json"),
                )
                for name, effect in sorted(self.layout.effects.items())
            ]
        )

    def play_nearest(
        self,
        params: PlayParams,
        contacts: Iterable[Contact],
        *,
        now: float,
    ) -> None:
        """Start an effect at the contact nearest to a position, at its own level or below.

        Raises RpcError for an unknown effect, a level above its own, and a position without a
        contact within `PLAY_RADIUS`.
        """
        effect = self.layout.effects.get(params.effect)
        if effect is None:
            known = ", ".join(sorted(self.layout.effects))
            raise RpcError(
                ErrorCode.REFUSED,
                f"unknown effect {params.effect!a}",
                where="effect",
                remedy=f"choose one of {known}",
            )
        level_max = MAX_DB_SL if effect.level_db_sl is None else effect.level_db_sl
        if params.level_db_sl is not None and params.level_db_sl > level_max:
            raise RpcError(
                ErrorCode.REFUSED,
                f"level of effect {params.effect!a} must be at most {level_max:g} dB SL, got "
                f"{params.level_db_sl:g}",
                where="level_db_sl",
                remedy="raise its level in the surface layout",
            )

        def distance(contact: Contact) -> float:
            return math.dist((contact.x, contact.y), (params.x_m, params.y_m))

        nearest = min(contacts, key=distance, default=None)
        if nearest is None or distance(nearest) > PLAY_RADIUS:
            raise RpcError(
                ErrorCode.REFUSED,
                f"no finger within {1e3 * PLAY_RADIUS:g} mm of ({params.x_m:g}, {params.y_m:g}) m",
                where="x_m",
                remedy="touch the plate there, or send a touch over the API",
            )
        self.play(params.effect, nearest, now, level_db_sl=params.level_db_sl)
