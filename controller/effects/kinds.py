"""Kinds of effects by name: those of the project, and those of installed packages."""

from operator import attrgetter

from controller.effects.buzz import Buzz
from controller.effects.click import Click
from controller.effects.detents import Detents
from controller.effects.dial import Dial
from controller.effects.effect import Effect
from controller.effects.file import File
from controller.effects.ramp import Ramp
from controller.effects.texture import Texture
from model.errors import InputError
from registry.plugins import PluginRegistry

BUILT_IN: tuple[type[Effect], ...] = (Buzz, Click, Detents, Dial, File, Ramp, Texture)
"""The kinds of the project itself."""

_KINDS: PluginRegistry[type[Effect]] = PluginRegistry(
    "kind of effect",
    "era_haptics.effects",
    Effect,
    error=InputError,
    own={each.kind: each for each in BUILT_IN},
    called=attrgetter("kind"),
)


def effect_kinds() -> tuple[str, ...]:
    """Return the names of all kinds, those of the project first, without loading any plug-in."""
    return _KINDS.names()


def effect_kind(name: str) -> type[Effect]:
    """Return the kind of a name; raises InputError if it is unknown or its plug-in fails."""
    return _KINDS.find(name)
