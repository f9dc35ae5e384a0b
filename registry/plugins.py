"""Things that go by a name: those that come with this project, and those of installed packages.

A plug-in is an entry point: its group says what it adds, its name which one. It is imported when
that name is asked for and never before, so one that is broken harms nobody else. Where several
packages claim a name none gets it: which would win depended on the order of files in a folder.
"""

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

from registry.suggestions import did_you_mean

_T = TypeVar("_T")
_Made = TypeVar("_Made")


@dataclass(frozen=True)
class Instance:
    """What an entry point leads to: an object of this class."""

    of: type

    def is_met_by(self, found: object) -> bool:
        """Whether it does."""
        return isinstance(found, self.of)

    def __str__(self) -> str:
        return f"an instance of {self.of.__name__}"


@dataclass(frozen=True)
class Derived:
    """What an entry point leads to: a class derived from this one."""

    of: type

    def is_met_by(self, found: object) -> bool:
        """Whether it does."""
        return isinstance(found, type) and issubclass(found, self.of)

    def __str__(self) -> str:
        return f"a class derived from {self.of.__name__}"


@dataclass(frozen=True)
class PluginRegistry(Generic[_T]):
    """What there is of one kind, by name.

    what: the kind in words, for errors; group: of its entry points; wanted: what these lead to;
    error: what is raised, in words for people; own: what comes with this project and is no entry
    point; called: the name that such a thing has itself, if it has one; otherwise: what is said
    last to whoever asked for a name that nobody knows. Of a kind that is made of URLs, ending: what
    stands behind its name there; example: such a URL.
    """

    what: str
    group: str
    wanted: Instance | Derived
    _: KW_ONLY
    error: type[Exception]
    own: Mapping[str, _T] = field(default_factory=dict)
    called: Callable[[_T], str] | None = None
    otherwise: str = ""
    ending: str = ""
    example: str = ""

    def names(self) -> tuple[str, ...]:
        """All of them, our own first; no plug-in is loaded."""
        return (*self.own, *sorted(_installed(self.group).keys() - self.own.keys()))

    def find(self, name: str, *, within: str = "") -> _T:
        """The one of this name; raises `error` for none, several, or a broken plug-in.

        within: the whole of what was written, where the name is a part of it.
        """
        points = _installed(self.group).get(name, ())
        packages = [*(["era-haptics"] if name in self.own else []), *map(_package, points)]
        if not packages:
            raise self.error(
                f"{_quoted(within)}unknown {self.what} {name[:40] + self.ending!r}; "
                f"{did_you_mean(name, self.names(), ending=self.ending)}{self._known()}"
            )
        if len(packages) > 1:
            raise self.error(
                f"{_quoted(within)}{self.what} {name}{self.ending} is claimed by several packages "
                f"({', '.join(packages)}); uninstall all but one, or give theirs another name"
            )
        return self.own[name] if name in self.own else self._loaded(points[0], within)

    def make(self: "PluginRegistry[Callable[[str], _Made]]", url: str) -> _Made:
        """What the class that the scheme of a URL names makes of it; raises as `find` does.

        The class may raise `error` too, for a URL that it refuses. Schemes are in small letters,
        however people write them.
        """
        scheme, ending, _ = url.partition(self.ending)
        if not ending:
            raise self.error(
                f"{url!r} does not begin with the scheme of a {self.what} and {self.ending}, "
                f"as {self.example} does; {self._known()}"
            )
        name = scheme.lower()
        maker = self.find(name, within=url)
        (point,) = _installed(self.group)[name]
        with self._blamed(point, url, but=(self.error,)):
            return maker(url)

    def _known(self) -> str:
        spelled = ", ".join(name + self.ending for name in self.names())
        return f"known are {spelled}{self.otherwise}"

    def _loaded(self, point: EntryPoint, within: str) -> _T:
        with self._blamed(point, within):
            loaded: _T = point.load()
        if not self.wanted.is_met_by(loaded):
            leads = loaded.__name__ if isinstance(loaded, type) else type(loaded).__name__
            raise self.error(
                f"{self._plug_in(point, within)} leads to {leads}, not to {self.wanted}; "
                "repair or remove that package"
            )
        with self._blamed(point, within):
            called = point.name if self.called is None else self.called(loaded)
        if called != point.name:
            raise self.error(
                f"{self._plug_in(point, within)} gives one that is called {called!r}; "
                "what it gives and its entry point need the same name"
            )
        return loaded

    @contextmanager
    def _blamed(
        self, point: EntryPoint, within: str, *, but: tuple[type[Exception], ...] = ()
    ) -> Iterator[None]:
        """Tell of whatever a plug-in raises by its package; but: what it may raise."""
        try:
            yield
        except but:
            raise
        except Exception as error:  # a plug-in may fail in any way
            raise self.error(
                f"{self._plug_in(point, within)} does not work ({type(error).__name__}: {error}); "
                "repair or remove that package"
            ) from error

    def _plug_in(self, point: EntryPoint, within: str) -> str:
        """Who needs which one of which package."""
        asked = f"{_quoted(within)}{self.what} {point.name}{self.ending}"
        return f"{asked}: the plug-in {point.value} of {_package(point)}"


def _quoted(within: str) -> str:
    return f"{within!r}: " if within else ""


def _installed(group: str) -> dict[str, tuple[EntryPoint, ...]]:
    """The entry points of a group by name, on the path of now: a notebook may add to it."""
    return _found(group, tuple(sys.path))


@cache
def _found(group: str, path: tuple[str, ...]) -> dict[str, tuple[EntryPoint, ...]]:
    """What leads to the same is found once, for one installation may lie on the path twice."""
    found: dict[str, dict[str, EntryPoint]] = {}
    for point in entry_points(group=group):
        found.setdefault(point.name, {}).setdefault(point.value, point)
    return {name: tuple(points.values()) for name, points in found.items()}


def _package(point: EntryPoint) -> str:
    return (point.dist and point.dist.name) or "an unknown package"
