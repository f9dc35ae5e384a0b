"""Registries of objects by name: this project's own, and plug-ins of installed packages.

A plug-in is an entry point of a group. It is imported only when its name is looked up, so that a
broken one affects nothing else. A name that several packages claim is refused. A name that is not
known gets a suggestion.
"""

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

_NEAR = 0.65
"""Minimum similarity of a suggestion; `unobtainium` is not similar to `aluminium`."""


def did_you_mean(name: str, known: Iterable[str], *, ending: str = "") -> str:
    """Return `did you mean SW? ` for a name similar to a known one, ignoring case, else "".

    Also for a word of known names: glass of soda-lime-glass, level of level_db_sl. ending: appended
    to suggestions.
    """
    from difflib import get_close_matches  # not loaded for --help

    word = name.lower()
    by_lower = {candidate.lower(): candidate for candidate in known}
    close = get_close_matches(word, by_lower, n=1, cutoff=_NEAR)
    if not close:
        close = [candidate for candidate in by_lower if word in re.split("[-_]", candidate)]
    if not close:
        return ""
    suggestions = [by_lower[candidate] + ending for candidate in close]
    return f"did you mean {' or '.join(suggestions)}? "


_T = TypeVar("_T")
_Object = TypeVar("_Object")

EXAMPLE_PREFIX = "example"
"""Prefix of the example plug-ins' names; the project's own names never begin with it."""
_OURS = "era-haptics"
_GROUP_PREFIX = "era_haptics."
_REMEDY = "repair or remove that package"


@dataclass(frozen=True)
class PluginRegistry(Generic[_T]):
    """Objects of a kind by name.

    what: the kind, for error messages; group: of its entry points; base: what these must be derived
    from, or, if is_instance, be an instance of; error: the class of errors raised; own: the objects
    of this project, each itself or, of a module that imports the registry or is above it, as
    "module:object"; called: returns the name of an object, if it has one; hint: the end of the
    message for an unknown name. If the name is the scheme of a URL, ending: what
    follows the scheme; example: such a URL.
    """

    what: str
    group: str
    base: type
    _: KW_ONLY
    error: type[Exception]
    is_instance: bool = False
    own: Mapping[str, _T | str] = field(default_factory=dict)
    called: Callable[[_T], str] | None = None
    hint: str = ""
    ending: str = ""
    example: str = ""

    def __post_init__(self) -> None:
        """Raise ValueError for a name that is reserved for the examples."""
        for name in self.own:
            if name.startswith(EXAMPLE_PREFIX):
                raise ValueError(
                    f"name of a built-in {self.what} must not begin with {EXAMPLE_PREFIX!r}, "
                    f"got {name!r}: such names belong to the examples"
                )

    def names(self) -> tuple[str, ...]:
        """All names, our own first; no plug-in is loaded."""
        return (*self.own, *sorted(plugins_of(self.group).keys() - self.own.keys()))

    def find(self, name: str, *, within: str = "") -> _T:
        """Look up a name; raises `error` for an unknown or ambiguous one, or a broken plug-in.

        within: the whole text that the name is a part of.
        """
        points = plugins_of(self.group).get(name, ())
        packages = dict.fromkeys([_OURS] * (name in self.own) + [*map(_package, points)])
        if not packages:
            raise self.error(
                f"{_quoted(within)}unknown {self.what} {name[:40] + self.ending!r}; "
                f"{did_you_mean(name, self.names(), ending=self.ending)}{self._known()}"
            )
        if len(packages) > 1:
            raise self.error(
                f"{_quoted(within)}{self.what} {name}{self.ending} is claimed by several packages "
                f"({', '.join(packages)}); uninstall all but one, or rename theirs"
            )
        own = self.own.get(name)
        if own is None:
            return self._loaded(points[0], within)
        return EntryPoint(name, own, self.group).load() if isinstance(own, str) else own

    def make(self: "PluginRegistry[Callable[[str], _Object]]", url: str) -> _Object:
        """Call the class named by the scheme of a URL with the URL; raises like `find`.

        The class may raise `error` for a URL that it refuses. Schemes are case-insensitive.
        """
        scheme, ending, rest = url.partition(self.ending)
        if not ending:
            raise self.error(
                f"{url!r} must begin with the scheme of a {self.what} and {self.ending}, "
                f"for example {self.example}; {self._known()}"
            )
        name = scheme.lower()
        maker = self.find(name, within=url)
        if name in self.own:
            return maker(name + ending + rest)
        (point,) = plugins_of(self.group)[name]
        with self._attributed(point, url, but=(self.error,)):
            return maker(name + ending + rest)

    def _known(self) -> str:
        spelled = ", ".join(name + self.ending for name in self.names())
        return (
            f"known: {spelled}{self.hint}; a plug-in needs an entry point in {self.group}, "
            "which is found once its package is installed"
        )

    def _loaded(self, point: EntryPoint, within: str) -> _T:
        with self._attributed(point, within):
            loaded: _T = point.load()
        leads = loaded if isinstance(loaded, type) else type(loaded)
        if isinstance(loaded, type) is self.is_instance or not issubclass(leads, self.base):
            kind = "an instance of" if self.is_instance else "a class derived from"
            expected = f"{kind} {self.base.__name__}"
            self._refuse(point, within, f"leads to {leads.__name__}, not to {expected}")
        with self._attributed(point, within):
            called = point.name if self.called is None else self.called(loaded)
        if called != point.name:
            self._refuse(point, within, f"is called {called!r}, unlike its entry point")
        return loaded

    @contextmanager
    def _attributed(
        self, point: EntryPoint, within: str, *, but: tuple[type[Exception], ...] = ()
    ) -> Iterator[None]:
        """Convert exceptions of a plug-in to `error` with its package; but: exceptions to keep."""
        try:
            yield
        except but:
            raise
        except Exception as error:  # a plug-in may fail in any way
            where = f"{_quoted(within)}{self.what} {point.name}{self.ending}: "
            raise self.error(where + _failed(point, error)) from error

    def _refuse(self, point: EntryPoint, within: str, problem: str) -> None:
        where = f"{_quoted(within)}{self.what} {point.name}{self.ending}: "
        raise self.error(f"{where}{_plugin(point)} {problem}; {_REMEDY}")


class WrongResultError(TypeError):
    """A plug-in's function that returned a value of the wrong type."""

    def __init__(self, plugin: object, result: object, required: type) -> None:
        """plugin: the object whose method returned the result."""
        self.module = type(plugin).__module__
        returned = type(result).__name__
        super().__init__(
            f"{type(plugin).__name__} returned {returned}, must be {required.__name__}"
        )


def failure_text(error: BaseException) -> str:
    """Text of an unexpected error; attributed to a plug-in's package if its code was running."""
    point = failed_plugin(error)
    return f"{type(error).__name__}: {error}" if point is None else _failed(point, error)


def failed_plugin(error: BaseException) -> EntryPoint | None:
    """Return the plug-in of another package whose code raised an error; None for our own code."""
    modules = [error.module] if isinstance(error, WrongResultError) else []
    trace = error.__traceback__
    while trace is not None:
        modules.append(trace.tb_frame.f_globals.get("__name__", ""))
        trace = trace.tb_next
    plugins = _of_others(tuple(sys.path))
    tops = [module.partition(".")[0] for module in reversed(modules)]
    return next((plugins[top] for top in tops if top in plugins), None)


def _failed(point: EntryPoint, error: BaseException) -> str:
    return f"{_plugin(point)} failed ({type(error).__name__}: {error}); {_REMEDY}"


def _plugin(point: EntryPoint) -> str:
    return f"plug-in {point.value} of package {_package(point)}"


def _quoted(within: str) -> str:
    return f"{within!r}: " if within else ""


def plugins_of(group: str) -> dict[str, tuple[EntryPoint, ...]]:
    """Return the entry points of a group by name, on the current path: a notebook may add to it."""
    return _entry_points(group, tuple(sys.path))


@cache
def _entry_points(group: str, path: tuple[str, ...]) -> dict[str, tuple[EntryPoint, ...]]:
    """Equal entry points count once: an installation may be on the path twice."""
    by_name: dict[str, dict[str, EntryPoint]] = {}
    for point in entry_points(group=group):
        by_name.setdefault(point.name, {}).setdefault(point.value, point)
    return {name: tuple(points.values()) for name, points in by_name.items()}


@cache
def _of_others(path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Return one plug-in per other package, by top-level module."""
    by_module: dict[str, EntryPoint] = {}
    for group in entry_points().groups:
        if not group.startswith(_GROUP_PREFIX):
            continue
        for point in entry_points(group=group):
            if _package(point) != _OURS:
                by_module[point.module.partition(".")[0]] = point
    return by_module


def _package(point: EntryPoint) -> str:
    return (point.dist and point.dist.name) or "unknown"
