"""Kinds of effects by name, our own and those of installed plug-ins alike."""

from operator import attrgetter

from controller.effects.effect import Effect
from model.errors import InputError
from registry.plugins import Derived, PluginRegistry

_KINDS: PluginRegistry[type[Effect]] = PluginRegistry(
    "kind of effect",
    "era_haptics.effects",
    Derived(Effect),
    error=InputError,
    called=attrgetter("kind"),
)


def effect_kinds() -> tuple[str, ...]:
    """Names of all installed kinds, without loading any."""
    return _KINDS.names()


def effect_kind(name: str) -> type[Effect]:
    """The kind of a name; raises InputError if there is none, or its plug-in does not work."""
    return _KINDS.find(name)
