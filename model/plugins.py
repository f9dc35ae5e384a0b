"""Things that go by a name: those that come with this package, and those of installed plug-ins.

A plug-in is an entry point: its group says what it adds, its name which one. It is imported when
that name is asked for and never before, so one that is broken harms nobody else.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

from model.errors import InputError, did_you_mean

_T = TypeVar("_T")


@dataclass(frozen=True)
class Catalogue(Generic[_T]):
    """What there is of one kind, by name.

    what: the kind in words, for errors; group: of its entry points; otherwise: what an error says
    last to whoever asked for a name that nobody knows.
    """

    what: str
    kind: type[_T]
    own: Mapping[str, _T]
    group: str
    otherwise: str = ""

    def names(self) -> tuple[str, ...]:
        """All of them, our own first; no plug-in is loaded."""
        return (*self.own, *sorted(_installed(self.group).keys() - self.own.keys()))

    def find(self, name: str) -> _T:
        """The one of this name; raises InputError for none, several, or a broken plug-in."""
        found = _installed(self.group).get(name, ())
        if name in self.own and not found:
            return self.own[name]
        if not found:
            meant = did_you_mean(name, self.names())
            raise InputError(
                f"unknown {self.what} {name[:40]!r}; {meant}known are: {', '.join(self.names())}"
                f"{self.otherwise}"
            )
        if len(found) > 1 or name in self.own:
            packages = [*(["era-haptics"] if name in self.own else []), *map(_package, found)]
            raise InputError(
                f"{self.what} {name} is claimed by several packages ({', '.join(packages)}); "
                "uninstall all but one, or give theirs another name"
            )
        return self._load(found[0])

    def _load(self, point: EntryPoint) -> _T:
        asker = f"{self.what} {point.name}"
        with blamed(point, asker):
            loaded = point.load()
        if not isinstance(loaded, self.kind):
            raise InputError(
                f"{asker}: the plug-in {point.value} of {_package(point)} leads to "
                f"{type(loaded).__name__}, not to {self.kind.__name__}; repair or remove that "
                "package"
            )
        return loaded


@contextmanager
def blamed(
    point: EntryPoint, asker: str, *, but: tuple[type[Exception], ...] = ()
) -> Iterator[None]:
    """Tell of whatever a plug-in raises as InputError that names its package.

    asker: what needs the plug-in, in words; but: what the plug-in may raise, and is passed on.
    """
    try:
        yield
    except but:
        raise
    except Exception as error:  # a plug-in may fail in any way
        raise InputError(
            f"{asker}: the plug-in {point.value} of {_package(point)} does not work "
            f"({type(error).__name__}: {error}); repair or remove that package"
        ) from error


@cache
def _installed(group: str) -> dict[str, tuple[EntryPoint, ...]]:
    """The entry points of a group by name; what is found twice in one installation counts once."""
    found: dict[str, dict[str, EntryPoint]] = {}
    for point in entry_points(group=group):
        found.setdefault(point.name, {}).setdefault(point.value, point)
    return {name: tuple(points.values()) for name, points in found.items()}


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist else "an unknown package"
