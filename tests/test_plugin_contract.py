"""What installed packages add, of every kind alike: found by name, blamed alone, never chosen."""

import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from controller.effects.kinds import effect_kind, effect_kinds
from controller.effects.timed import Buzz
from controller.sources.registry import open_source
from controller.sources.tuio import TuioSource
from drivers.backends.serial_line.backend import SerialBackend
from drivers.errors import CommandError
from drivers.registry import known_schemes, open_backend
from model.config.kinds import kind_called
from model.errors import InputError
from model.fem.elements import ELEMENTS, element_names, element_of
from model.rig.kind import RIG
from model.structure.materials import KNOWN_MATERIALS, known_material, material_names

INIT = """\
    def __init__(self, url):
        if url.endswith("nowhere"):
            raise Refused("there is no such place")
        if url.endswith("badly"):
            raise KeyError("thought of all but this")
"""


@dataclass(frozen=True)
class Kind:
    """What can be added.

    what: in words; works: the source of a module with THING, what an entry point named `fine` leads
    to; wanted: that in words; find: how it is asked for, by its name or by a URL of its name, its
    ending and a rest; own: the name of one of this project's, and what it is; names: of all, where
    these are told; error: what is raised.
    """

    group: str
    what: str
    works: str
    wanted: str
    find: Callable[[str], object]
    own: tuple[str, object]
    names: Callable[[], tuple[str, ...]] | None = None
    ending: str = ""
    rest: str = ""
    error: type[Exception] = InputError

    def ask(self, name: str) -> object:
        """The one of a name."""
        return self.find(name + self.ending + self.rest)


KINDS = [
    Kind(
        "materials",
        "material",
        "from era_haptics.plugins.materials import KnownMaterial, Material\n"
        "THING = KnownMaterial(Material('fine', 1e9, 900.0, 0.3), 'made up', 'none', '0.01')\n",
        "an instance of KnownMaterial",
        known_material,
        ("steel", KNOWN_MATERIALS["steel"]),
        material_names,
    ),
    Kind(
        "elements",
        "element",
        "from era_haptics.plugins.elements import Element\n"
        "THING = Element('fine', (-1.0, 1.0), lambda *_: None, lambda *_: None)\n",
        "an instance of Element",
        element_of,
        ("Q4", ELEMENTS["Q4"]),
        element_names,
    ),
    Kind(
        "effects",
        "kind of effect",
        "from era_haptics.plugins.effects import Effect\n"
        "class THING(Effect):\n"
        "    kind = 'fine'\n"
        "    def begin(self, contact, now, *, level_db_sl):\n"
        "        pass\n",
        "a class derived from Effect",
        effect_kind,
        ("buzz", Buzz),
        effect_kinds,
    ),
    Kind(
        "backends",
        "backend",
        "from era_haptics.plugins.backends import CommandError as Refused, WireBackend\n"
        "class THING(WireBackend):\n"
        f"{INIT}"
        "    async def open(self): pass\n"
        "    async def close(self): pass\n"
        "    async def exchange(self, request, *, timeout): pass\n",
        "a class derived from Backend",
        open_backend,
        ("rfc2217", SerialBackend),
        known_schemes,
        ending="://",
        rest="a:1",
        error=CommandError,
    ),
    Kind(
        "touch_sources",
        "touch source",
        "from era_haptics.plugins.touch_sources import InputError as Refused, TouchSource\n"
        "class THING(TouchSource):\n"
        f"{INIT}"
        "    async def run(self, deliver): pass\n",
        "a class derived from TouchSource",
        open_source,
        ("tuio", TuioSource),
        ending=":",
        rest="a:1",
    ),
    Kind(
        "config_kinds",
        "kind of configuration",
        "class Fine:\n    recognises = check = example = schema = print\nTHING = Fine()\n",
        "an instance of ConfigKind",
        kind_called,
        ("rig", RIG),
    ),
]

of_every_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.group)
made_of_urls = pytest.mark.parametrize(
    "kind", [kind for kind in KINDS if kind.ending], ids=lambda kind: kind.group
)
with_names_of_their_own = pytest.mark.parametrize(
    "kind",
    [kind for kind in KINDS if "'fine'" in kind.works],
    ids=lambda kind: kind.group,
)

Install = Callable[..., str]
"""install(package, kind, name, source): an installed package; gives the module of its plug-in."""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Installs packages as pip leaves them, each in a folder of the search path of its own."""

    def install(
        package: str, kind: Kind, name: str, source: str | None, *, module: str = ""
    ) -> str:
        folder = tmp_path / package
        told = folder / f"{package}-1.0.dist-info"
        told.mkdir(parents=True)
        (told / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n", "utf-8"
        )
        module = module or f"era_try_{package}"
        (told / "entry_points.txt").write_text(
            f"[era_haptics.{kind.group}]\n{name} = {module}:THING\n", "utf-8"
        )
        if source is not None:
            (folder / f"{module}.py").write_text(source, "utf-8")
        monkeypatch.syspath_prepend(folder)
        return module

    yield install
    for module in [name for name in sys.modules if name.startswith("era_try_")]:
        del sys.modules[module]


def is_made_by(found: object, thing: object) -> bool:
    """Whether what was found is a thing, or what a class makes of a URL."""
    return found is thing or type(found) is thing


@of_every_kind
def test_one_is_imported_when_its_name_is_asked_for_and_never_before(
    kind: Kind, install: Install
) -> None:
    """Neither for the names of all nor for another one, and then no other with it."""
    ours, what_it_is = kind.own
    fine = install("good", kind, "fine", kind.works)
    other = install("other", kind, "unasked", "raise RuntimeError('nobody asked')\n")
    if kind.names is not None:
        assert {"fine", "unasked", ours} <= set(kind.names())
    assert is_made_by(kind.ask(ours), what_it_is)
    assert not {fine, other} & sys.modules.keys()
    assert is_made_by(kind.ask("fine"), sys.modules[fine].THING)
    assert other not in sys.modules


@of_every_kind
@pytest.mark.parametrize(
    ("source", "what"),
    [
        ("raise RuntimeError('half installed')\n", "does not work (RuntimeError: half installed)"),
        ("THINGS = None\n", "does not work (AttributeError: "),
        (None, "does not work (ModuleNotFoundError: "),
        ("THING = 7\n", "leads to int, not to {wanted}"),
        ("class THING:\n    pass\n", "leads to THING, not to {wanted}"),
        ("def THING(*_):\n    return None\n", "leads to function, not to {wanted}"),
    ],
)
def test_one_that_is_broken_is_blamed_and_harms_no_other(
    kind: Kind, source: str | None, what: str, install: Install
) -> None:
    """Whatever it does when it is imported, or gives; its package is named, others work."""
    module = install("bad", kind, "broken", source)
    install("good", kind, "fine", kind.works)
    with pytest.raises(kind.error) as told:
        kind.ask("broken")
    said = str(told.value)
    assert f"{kind.what} broken{kind.ending}: the plug-in {module}:THING of bad " in said
    assert what.format(wanted=kind.wanted) in said
    assert said.endswith("; repair or remove that package")
    assert kind.ask("fine")
    assert kind.ask(kind.own[0])


@of_every_kind
def test_a_name_that_several_packages_claim_is_given_to_none(kind: Kind, install: Install) -> None:
    """Nor to us, if ours is claimed: the error names who claims it, and other names work."""
    install("one", kind, "fine", kind.works)
    install("two", kind, "fine", kind.works)
    ours, _ = kind.own
    install("three", kind, ours, kind.works)
    for name, claimants in (("fine", {"one", "two"}), (ours, {"era-haptics", "three"})):
        with pytest.raises(kind.error, match="is claimed by several packages") as told:
            kind.ask(name)
        named = str(told.value).split("packages (")[1].split(");")[0]
        assert f"{kind.what} {name}{kind.ending} is claimed" in str(told.value)
        assert set(named.split(", ")) == claimants
    install("four", kind, "other", kind.works.replace("'fine'", "'other'"))
    assert kind.ask("other")


@of_every_kind
def test_one_that_is_found_twice_is_one(kind: Kind, install: Install) -> None:
    """The same place in the same module, as where an old folder has been left on the path."""
    module = install("good", kind, "fine", kind.works)
    install("left", kind, "fine", kind.works, module=module)
    assert is_made_by(kind.ask("fine"), sys.modules[module].THING)


@of_every_kind
def test_an_unknown_name_is_told_with_what_may_be_meant(kind: Kind, install: Install) -> None:
    """A package's name is meant as well as one of ours, and all that are known are told."""
    install("good", kind, "pigeonry", kind.works)
    with pytest.raises(kind.error) as told:
        kind.ask("pigeonri")
    unknown, _, known = str(told.value).partition("? known are ")
    ending = kind.ending
    meant = f"unknown {kind.what} 'pigeonri{ending}'; did you mean pigeonry{ending}"
    assert unknown.endswith(meant)
    assert {f"pigeonry{ending}", f"{kind.own[0]}{ending}"} <= set(re.split("[,;] ", known))
    with pytest.raises(kind.error, match=f"unknown {kind.what} 'x{{40}}{ending}'; known are "):
        kind.ask("x" * 500)


@with_names_of_their_own
def test_a_thing_with_a_name_has_that_of_its_entry_point(kind: Kind, install: Install) -> None:
    """Or a table would say another one than the rig, and a client another one than the layout."""
    install("good", kind, "finer", kind.works)
    with pytest.raises(kind.error, match=r"of good gives one that is called 'fine'; what it gives"):
        kind.ask("finer")


@made_of_urls
def test_what_a_class_makes_of_a_url_is_its_own(kind: Kind, install: Install) -> None:
    """It may refuse one in its own words; whatever else it raises is blamed on its package."""
    install("good", kind, "fine", kind.works)
    with pytest.raises(kind.error, match=r"^there is no such place$"):
        kind.find(f"fine{kind.ending}nowhere")
    with pytest.raises(kind.error, match=r"fine:.* of good does not work \(KeyError"):
        kind.find(f"fine{kind.ending}badly")


@made_of_urls
def test_a_scheme_may_be_in_capitals_and_must_be_there(kind: Kind, install: Install) -> None:
    """A bare name of a device or a file is answered with how to write it."""
    module = install("good", kind, "fine", kind.works)
    assert is_made_by(kind.ask("FINE"), sys.modules[module].THING)
    for url in ("", "fine", "/dev/fine"):
        with pytest.raises(kind.error, match=rf"{kind.ending}, as \w+:.* does; known are .*fine:"):
            kind.find(url)
