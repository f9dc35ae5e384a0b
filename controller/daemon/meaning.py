"""What touches mean at the moment, exchangeable while the control loop runs."""

import math
from collections.abc import Iterable, Sequence

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import EffectsResult, PlayParams
from controller.api.schema import EffectDescription
from controller.effects.layout import Layout
from controller.effects.player import EffectPlayer
from controller.loop.intent import HapticIntent
from controller.loop.selection import MOST_DB_SL
from controller.sources.contacts import Contact, ContactKey

REACH = 0.020
"""An effect that is asked for at a place is felt by a finger within this distance [m]."""


class Meaning:
    """Plays the effects of a layout, and those that are asked for by name."""

    def __init__(self, layout: Layout) -> None:
        self._player = EffectPlayer(layout)

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """As `IntentSource`."""
        return self._player.intent(contacts, now)

    def exchange(self, layout: Layout) -> None:
        """From now on touches mean this; nothing that is over in a moment is felt again."""
        self._player = EffectPlayer(layout, known=self._player.fingers)

    def effect_of(self, key: ContactKey) -> str | None:
        """The effect that plays for a finger, None for none."""
        return self._player.effect_of(key)

    def effects(self) -> EffectsResult:
        """What can be asked for."""
        return EffectsResult(
            effects=[
                EffectDescription(
                    name=name,
                    kind=effect.kind,
                    description=(type(effect).__doc__ or "").partition("\n")[0],
                    parameters=effect.model_dump(mode="json"),
                )
                for name, effect in sorted(self._player.layout.effects.items())
            ]
        )

    def play(self, params: PlayParams, contacts: Iterable[Contact], *, now: float) -> None:
        """Begin an effect at the finger nearest to its place, at its own level or below.

        Raises RpcError where there is no such effect, or no finger: nothing vibrates that nobody
        touches.
        """
        effect = self._player.layout.effects.get(params.effect)
        if effect is None:
            known = ", ".join(sorted(self._player.layout.effects))
            raise RpcError(
                ErrorCode.REFUSED,
                f"there is no effect {params.effect!a}",
                where="effect",
                remedy=f"known are {known}",
            )
        highest = MOST_DB_SL if effect.level_db_sl is None else effect.level_db_sl
        if params.level_db_sl is not None and params.level_db_sl > highest:
            raise RpcError(
                ErrorCode.REFUSED,
                f"the effect {params.effect!a} has {highest:g} dB SL, and may be asked for at that "
                f"or below, not at {params.level_db_sl:g}",
                where="level_db_sl",
                remedy="raise it in the surface layout if that is wanted",
            )

        def distance(contact: Contact) -> float:
            return math.dist((contact.x, contact.y), (params.x_m, params.y_m))

        nearest = min(contacts, key=distance, default=None)
        if nearest is None or distance(nearest) > REACH:
            raise RpcError(
                ErrorCode.REFUSED,
                f"no finger is within {1e3 * REACH:g} mm of ({params.x_m:g}, {params.y_m:g}) m",
                where="x_m",
                remedy="touch the plate there, or over the API with touch",
            )
        self._player.play(params.effect, nearest, now, level_db_sl=params.level_db_sl)
