"""Kinds of effects by name, our own and those of installed plug-ins alike."""

from functools import cache
from importlib.metadata import entry_points

from controller.effects.effect import Effect
from model.errors import InputError

GROUP = "era_haptics.effects"


def effect_kinds() -> list[str]:
    """Names of all installed kinds, without loading any."""
    return sorted({point.name for point in entry_points(group=GROUP)})


@cache
def effect_kind(name: str) -> type[Effect]:
    """The kind of a name; raises InputError if there is none, or its plug-in does not work."""
    for point in entry_points(group=GROUP, name=name):
        package = point.dist.name if point.dist else "an unknown package"
        try:
            kind = point.load()
        except Exception as error:
            raise InputError(
                f"effect kind {name}: the plug-in {point.value} of {package} does not work "
                f"({type(error).__name__}: {error}); repair or remove that package"
            ) from error
        if not (isinstance(kind, type) and issubclass(kind, Effect)):
            raise InputError(f"effect kind {name}: the plug-in {point.value} is no Effect")
        return kind
    raise InputError(f"{name[:40]!r} is no kind of effect; known are {', '.join(effect_kinds())}")
