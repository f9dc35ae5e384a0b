"""Kinds of effects by name, our own and those of installed plug-ins alike."""

from functools import cache
from importlib.metadata import entry_points

from controller.effects.effect import Effect
from model.errors import InputError
from model.plugins import blamed

GROUP = "era_haptics.effects"


def effect_kinds() -> list[str]:
    """Names of all installed kinds, without loading any."""
    return sorted({point.name for point in entry_points(group=GROUP)})


@cache
def effect_kind(name: str) -> type[Effect]:
    """The kind of a name; raises InputError if there is none, or its plug-in does not work."""
    for point in entry_points(group=GROUP, name=name):
        with blamed(point, f"effect kind {name}"):
            kind = point.load()
        if not (isinstance(kind, type) and issubclass(kind, Effect)):
            raise InputError(f"effect kind {name}: the plug-in {point.value} is no Effect")
        return kind
    raise InputError(f"{name[:40]!r} is no kind of effect; known are {', '.join(effect_kinds())}")
