"""Registries of objects by name: built-in objects, and plug-ins of installed packages.

A plug-in is an entry point of a group. It is imported when its name is looked up, so a broken
plug-in affects nothing else. A name that several packages claim is rejected. For an unknown name,
the error message suggests a similar name.
"""

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

_MIN_SIMILARITY = 0.65
"""Minimum similarity of a suggestion; `unobtainium` is not similar to `aluminium`."""


def did_you_mean(name: str, known: Iterable[str], *, ending: str = "") -> str:
    """Return `did you mean SW? ` if a known name is similar, or else "". Case is ignored.

    A word of a known name suggests that name: glass suggests soda-lime-glass, level level_db_sl.
    ending: appended to each suggestion.
    """
    from difflib import get_close_matches  # not loaded for --help

    word = name.lower()
    by_lower = {candidate.lower(): candidate for candidate in known}
    close = get_close_matches(word, by_lower, n=1, cutoff=_MIN_SIMILARITY)
    if not close:
        close = [candidate for candidate in by_lower if word in re.split("[-_]", candidate)]
    if not close:
        return ""
    suggestions = [by_lower[candidate] + ending for candidate in close]
    return f"did you mean {' or '.join(suggestions)}? "


_T = TypeVar("_T")
_Object = TypeVar("_Object")

EXAMPLE_PREFIX = "example"
"""Prefix reserved for the names of example plug-ins; no built-in name begins with it."""
_OURS = "era-haptics"
_GROUP_PREFIX = "era_haptics."
_REMEDY = "repair or remove that package"


@dataclass(frozen=True)
class PluginRegistry(Generic[_T]):
    """Objects of a kind by name; names can be URL schemes."""

    what: str
    """The kind of object, for error messages."""
    group: str
    """Group of the plug-ins' entry points."""
    base: type
    """Base class of the plug-ins."""
    _: KW_ONLY
    error: type[Exception]
    """Class of the exceptions that look-ups raise."""
    is_instance: bool = False
    """Whether plug-ins are instances of the base class, rather than classes derived from it."""
    own: Mapping[str, _T | str] = field(default_factory=dict)
    """Built-in objects; "module:object" for an object that is imported when it is looked up."""
    called: Callable[[_T], str] | None = None
    """Function that returns the name of an object, if objects have names."""
    hint: str = ""
    """End of the error message for an unknown name."""
    ending: str = ""
    """For URL schemes: the characters after the scheme, such as `://`."""
    example: str = ""
    """For URL schemes: an example of a URL, for error messages."""

    def __post_init__(self) -> None:
        """Raise ValueError for a built-in name that is reserved for the examples."""
        for name in self.own:
            if name.startswith(EXAMPLE_PREFIX):
                raise ValueError(
                    f"name of a built-in {self.what} must not begin with {EXAMPLE_PREFIX!r}, "
                    f"got {name!r}: such names belong to the examples"
                )

    def names(self) -> tuple[str, ...]:
        """Return all names, built-in ones first; no plug-in is imported."""
        return (*self.own, *sorted(plugins_of(self.group).keys() - self.own.keys()))

    def find(self, name: str, *, within: str = "") -> _T:
        """Look up a name; raises `error` if it is unknown or ambiguous, or its plug-in is broken.

        within: the text that contains the name, such as a URL, for error messages.
        """
        points = plugins_of(self.group).get(name, ())
        packages = [_package(point) for point in points]
        if name in self.own:
            packages.insert(0, _OURS)
        packages = list(dict.fromkeys(packages))
        if not packages:
            suggestion = did_you_mean(name, self.names(), ending=self.ending)
            raise self.error(
                f"{_quoted(within)}unknown {self.what} {name[:40] + self.ending!r}; "
                f"{suggestion}{self._known()}"
            )
        if len(packages) > 1:
            raise self.error(
                f"{_quoted(within)}{self.what} {name}{self.ending} is claimed by several packages "
                f"({', '.join(packages)}); uninstall all but one, or rename theirs"
            )
        if name in self.own:
            return self._built_in(name)
        return self._plugin(points[0], within)

    def make(self: "PluginRegistry[Callable[[str], _Object]]", url: str) -> _Object:
        """Construct the object for a URL: call the class of its scheme with the URL.

        Schemes are case-insensitive. Raises `error` like `find`, and for a URL that the class
        rejects.
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
        """Return the part of an error message that lists all names."""
        spelled = ", ".join(name + self.ending for name in self.names())
        return (
            f"known: {spelled}{self.hint}; a plug-in needs an entry point in {self.group}, "
            "which is found once its package is installed"
        )

    def _built_in(self, name: str) -> _T:
        """Return a built-in object; import it if it is given as "module:object"."""
        built_in = self.own[name]
        if isinstance(built_in, str):
            imported: _T = EntryPoint(name, built_in, self.group).load()
            return imported
        return built_in

    def _plugin(self, point: EntryPoint, within: str) -> _T:
        """Import a plug-in and check its type and its name; raises `error`."""
        with self._attributed(point, within):
            plugin: _T = point.load()
        is_class = isinstance(plugin, type)
        plugin_class = plugin if isinstance(plugin, type) else type(plugin)
        if is_class is self.is_instance or not issubclass(plugin_class, self.base):
            kind = "an instance of" if self.is_instance else "a class derived from"
            expected = f"{kind} {self.base.__name__}"
            self._reject(point, within, f"leads to {plugin_class.__name__}, not to {expected}")
        if self.called is not None:
            with self._attributed(point, within):
                name = self.called(plugin)
            if name != point.name:
                self._reject(point, within, f"is called {name!r}, unlike its entry point")
        return plugin

    @contextmanager
    def _attributed(
        self, point: EntryPoint, within: str, *, but: tuple[type[Exception], ...] = ()
    ) -> Iterator[None]:
        """Convert a plug-in's exceptions to `error`, which names its package.

        but: exceptions that pass unchanged.
        """
        try:
            yield
        except but:
            raise
        except Exception as error:  # a plug-in can fail in any way
            raise self.error(self._location(point, within) + _failed(point, error)) from error

    def _reject(self, point: EntryPoint, within: str, problem: str) -> None:
        """Raise `error` for a plug-in that breaks a rule."""
        location = self._location(point, within)
        raise self.error(f"{location}{_description(point)} {problem}; {_REMEDY}")

    def _location(self, point: EntryPoint, within: str) -> str:
        """Return the beginning of an error message: the text with the name, and the name."""
        return f"{_quoted(within)}{self.what} {point.name}{self.ending}: "


class WrongResultError(TypeError):
    """A method of a plug-in returned a value of the wrong type."""

    def __init__(self, plugin: object, result: object, required: type) -> None:
        """plugin: the object whose method returned the result; required: the type it must have."""
        self.module = type(plugin).__module__
        returned = type(result).__name__
        super().__init__(
            f"{type(plugin).__name__} returned {returned}, must be {required.__name__}"
        )


def failure_text(error: BaseException) -> str:
    """Return the text of an unexpected error, with the package if a plug-in's code raised it."""
    point = failed_plugin(error)
    return f"{type(error).__name__}: {error}" if point is None else _failed(point, error)


def failed_plugin(error: BaseException) -> EntryPoint | None:
    """Return the plug-in whose code raised an error; None for code of this project."""
    modules = [error.module] if isinstance(error, WrongResultError) else []
    trace = error.__traceback__
    while trace is not None:
        modules.append(trace.tb_frame.f_globals.get("__name__", ""))
        trace = trace.tb_next
    plugins = _of_others(tuple(sys.path))
    for module in reversed(modules):  # the innermost call first
        package = module.partition(".")[0]
        if package in plugins:
            return plugins[package]
    return None


def _failed(point: EntryPoint, error: BaseException) -> str:
    return f"{_description(point)} failed ({type(error).__name__}: {error}); {_REMEDY}"


def _description(point: EntryPoint) -> str:
    return f"plug-in {point.value} of package {_package(point)}"


def _quoted(within: str) -> str:
    return f"{within!r}: " if within else ""


def plugins_of(group: str) -> dict[str, tuple[EntryPoint, ...]]:
    """Return the entry points of a group by name, on the current path."""
    return _entry_points(group, tuple(sys.path))


@cache
def _entry_points(group: str, path: tuple[str, ...]) -> dict[str, tuple[EntryPoint, ...]]:
    """Return entry points by name; equal ones count once, as an installation can be on the path
    twice."""
    by_name: dict[str, dict[str, EntryPoint]] = {}
    for point in entry_points(group=group):
        by_name.setdefault(point.name, {}).setdefault(point.value, point)
    return {name: tuple(points.values()) for name, points in by_name.items()}


@cache
def _of_others(path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Return one plug-in of each other package, by top-level module."""
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
