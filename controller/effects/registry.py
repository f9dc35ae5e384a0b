"""Kinds of effects by name: built in or from installed plug-ins."""

from operator import attrgetter

from controller.effects.effect import Effect
from model.errors import InputError
from registry.plugins import PluginRegistry

_KINDS: PluginRegistry[type[Effect]] = PluginRegistry(
    "kind of effect",
    "era_haptics.effects",
    Effect,
    error=InputError,
    called=attrgetter("kind"),
)


def effect_kinds() -> tuple[str, ...]:
    """Return the names of all installed kinds without loading any."""
    return _KINDS.names()


def effect_kind(name: str) -> type[Effect]:
    """Return the kind of a name; raises InputError if it is unknown or its plug-in fails."""
    return _KINDS.find(name)
