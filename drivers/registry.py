"""Which backend speaks to an amplifier: found by the scheme of its URL.

Backends are the entry points of the group `era_haptics.backends`, named by scheme; each is a
`Backend` that is made with the URL. One is imported only when a URL asks for it, so a broken one
harms nobody else.
"""

import difflib
from importlib.metadata import EntryPoint, entry_points

from drivers.backend import Backend
from drivers.errors import CommandError

_GROUP = "era_haptics.backends"


def known_schemes() -> tuple[str, ...]:
    """The URL schemes that are installed, sorted."""
    return tuple(sorted({entry.name for entry in entry_points(group=_GROUP)}))


def open_backend(url: str) -> Backend:
    """A backend for this URL, not yet open; CommandError for a URL that no backend understands."""
    scheme, separator, _ = url.partition("://")
    if not separator:
        raise CommandError(
            f"{url!r} is no amplifier URL; it needs a scheme and ://, as in "
            f"serial:///dev/ttyUSB0?baud=921600. Known schemes: {', '.join(known_schemes())}"
        )
    backend = _load(_find(scheme.lower(), url))
    return backend(url)


def _find(scheme: str, url: str) -> EntryPoint:
    found = {entry.value: entry for entry in entry_points(group=_GROUP, name=scheme)}
    if not found:
        near = difflib.get_close_matches(scheme, known_schemes(), n=1)
        hint = f" Did you mean {near[0]}://?" if near else ""
        raise CommandError(
            f"{url!r}: no backend for {scheme}:// is installed.{hint} Known schemes: "
            f"{', '.join(known_schemes())}"
        )
    if len(found) > 1:
        raise CommandError(
            f"{url!r}: {scheme}:// is claimed by several installed backends "
            f"({', '.join(sorted(found))}); uninstall all but one"
        )
    return next(iter(found.values()))


def _load(entry: EntryPoint) -> type[Backend]:
    try:
        backend = entry.load()
    except Exception as problem:  # a plug-in may fail in any way while it is imported
        origin = entry.dist.name if entry.dist else entry.value
        raise CommandError(
            f"the backend for {entry.name}:// (from {origin}) cannot be loaded: "
            f"{type(problem).__name__}: {problem}. Reinstall {origin} or use another wire"
        ) from problem
    if not (isinstance(backend, type) and issubclass(backend, Backend)):
        raise CommandError(
            f"{entry.value}, registered for {entry.name}://, is not a class derived from "
            "era_haptics.plugins.backends.Backend; report this to whoever made it"
        )
    return backend
