"""Plug-ins of every kind: found by name, and attributed to their package when they fail."""

import asyncio
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from inspect import isabstract
from pathlib import Path
from typing import Any

import pytest

from controller.content.formats import Ahap, content_format, content_formats, read_content
from controller.content.reading import ContentFormat
from controller.effects.effect import Effect
from controller.effects.kinds import Buzz, effect_kind, effect_kinds
from controller.effects.layout import SurfaceLayout, load_layout
from controller.effects.player import EffectPlayer
from controller.sources.touch import TOUCH_SOURCES, Contact, ContactKey, TouchSource, open_source
from controller.sources.tuio import TuioSource
from drivers.errors import CommandError
from drivers.wires.serial_line import SerialAddress
from drivers.wires.wire import address_of
from era_haptics.command import run_era
from model.errors import InputError
from model.structure.material import KNOWN_MATERIALS, known_material, material_names
from registry.plugins import EXAMPLE_PREFIX, PluginRegistry, failure_text

URL_CLASS = """\
    def __init__(self, url):
        if url.endswith("refused"):
            raise Refused("refused")
        if url.endswith("broken"):
            raise KeyError("missing")
"""


@dataclass(frozen=True)
class Kind:
    """A kind of plug-in.

    what: its name in messages; works: the source of a module with THING, the value of an entry
    point named `fine`; fails: that of one that works until `use` uses it; wanted: the class in
    messages; find: looks one up by its name, or by a URL of its name, ending and rest; own: the
    name of one of this project's, and its value; names: lists all; error: the class raised.
    """

    group: str
    what: str
    works: str
    wanted: str
    find: Callable[[str], object]
    own: tuple[str, object]
    names: Callable[[], tuple[str, ...]] | None = None
    fails: str = ""
    use: Callable[[Any], object] = lambda found: None
    ending: str = ""
    rest: str = ""
    error: type[Exception] = InputError

    def look_up(self, name: str) -> object:
        """The one of a name."""
        return self.find(name + self.ending + self.rest)


def play_effect(kind: type[Effect]) -> None:
    """Touch a plate whose layout has this effect everywhere."""
    layout = SurfaceLayout((), effects={"it": kind()}, elsewhere="it")
    EffectPlayer(layout).intent([Contact(ContactKey("s", 1), 0.1, 0.1, 0.0)], 0.0)


def read_file(kind: type[ContentFormat]) -> None:
    """Read a file of this format."""
    with tempfile.NamedTemporaryFile(suffix=f".{kind.ending}") as file:
        read_content(Path(file.name))


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
        fails="from era_haptics.plugins.materials import KnownMaterial, Material\n"
        "THING = KnownMaterial(Material('fine', '1e9', 900.0, 0.3), '', '', '')\n",
    ),
    Kind(
        "effects",
        "kind of effect",
        "from era_haptics.plugins.effects import Effect\n"
        "class THING(Effect):\n"
        "    kind = 'fine'\n"
        "    def start(self, contact, now, *, level_db_sl):\n"
        "        pass\n",
        "a class derived from Effect",
        effect_kind,
        ("buzz", Buzz),
        effect_kinds,
        fails="from era_haptics.plugins.effects import Effect\n"
        "class THING(Effect):\n"
        "    kind = 'fine'\n"
        "    is_for_motion = False\n"
        "    def start(self, contact, now, *, level_db_sl):\n"
        "        return 7\n",
        use=play_effect,
    ),
    Kind(
        "content_formats",
        "format of content",
        "from era_haptics.plugins.content_formats import ContentFormat\n"
        "class THING(ContentFormat):\n"
        "    ending = 'fine'\n"
        "    def read(self, content, source, channel):\n"
        "        pass\n",
        "a class derived from ContentFormat",
        content_format,
        ("ahap", Ahap),
        content_formats,
        fails="from era_haptics.plugins.content_formats import ContentFormat\n"
        "class THING(ContentFormat):\n"
        "    ending = 'fine'\n"
        "    def read(self, content, source, channel):\n"
        "        return 7\n",
        use=read_file,
    ),
    Kind(
        "wires",
        "wire",
        "from era_haptics.plugins.wires import CommandError as Refused, WireAddress\n"
        "class THING(WireAddress):\n"
        f"{URL_CLASS}"
        "    def make_wire(self): pass\n"
        "    async def open_port(self, on_data, on_loss): pass\n",
        "a class derived from WireAddress",
        address_of,
        ("serial+tcp", SerialAddress),
        fails="from era_haptics.plugins.wires import WireAddress\n"
        "class THING(WireAddress):\n"
        "    def __init__(self, url): self.line, self.number, self.settings = url, 1, {}\n"
        "    def make_wire(self): pass\n"
        "    async def open_port(self, on_data, on_loss): raise KeyError('open')\n",
        use=lambda found: asyncio.run(found.open_port(None, None)),
        ending="://",
        rest="a:1",
        error=CommandError,
    ),
    Kind(
        "touch_sources",
        "touch source",
        "from era_haptics.plugins.touch_sources import InputError as Refused, TouchSource\n"
        "class THING(TouchSource):\n"
        f"{URL_CLASS}"
        "    async def run(self, deliver): pass\n",
        "a class derived from TouchSource",
        open_source,
        ("tuio", TuioSource),
        fails="from era_haptics.plugins.touch_sources import TouchSource\n"
        "class THING(TouchSource):\n"
        "    def __init__(self, url): pass\n"
        "    async def run(self, deliver): deliver()\n",
        use=lambda found: asyncio.run(found.run(lambda frame: None)),
        ending=":",
        rest="a:1",
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
"""install(package, kind, name, source) -> the name of the plug-in's module."""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Installs packages as pip leaves them, each in a folder of the search path of its own."""

    def install(
        package: str, kind: Kind, name: str, source: str | None, *, module: str = ""
    ) -> str:
        folder = tmp_path / package
        info = folder / f"{package}-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n", "utf-8"
        )
        module = module or f"era_try_{package}"
        (info / "entry_points.txt").write_text(
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
    """Whether an object is `thing`, or an instance of it."""
    return found is thing or type(found) is thing


@of_every_kind
def test_plugin_is_imported_only_when_looked_up(kind: Kind, install: Install) -> None:
    """Listing names and looking up another one import nothing."""
    ours, what_it_is = kind.own
    fine = install("good", kind, "fine", kind.works)
    other = install("other", kind, "unused", "raise RuntimeError('imported')\n")
    if kind.names is not None:
        assert {"fine", "unused", ours} <= set(kind.names())
    assert is_made_by(kind.look_up(ours), what_it_is)
    assert not {fine, other} & sys.modules.keys()
    assert is_made_by(kind.look_up("fine"), sys.modules[fine].THING)
    assert other not in sys.modules


@of_every_kind
@pytest.mark.parametrize(
    "source",
    [
        "raise RuntimeError('half installed')\n",
        "THINGS = None\n",
        None,
        "THING = 7\n",
        "class THING:\n    pass\n",
        "def THING(*_):\n    return None\n",
    ],
)
def test_broken_plugin_is_attributed_to_its_package(
    kind: Kind, source: str | None, install: Install
) -> None:
    """Whether it fails on import or has the wrong type; others work, and there is a remedy."""
    module = install("bad", kind, "broken", source)
    install("good", kind, "fine", kind.works)
    with pytest.raises(kind.error) as caught:
        kind.look_up("broken")
    message = str(caught.value)
    assert f"{kind.what} broken{kind.ending}: plug-in {module}:THING of package bad " in message
    assert message.endswith("; repair or remove that package")
    assert kind.look_up("fine")
    assert kind.look_up(kind.own[0])


@pytest.mark.parametrize(
    "kind", [kind for kind in KINDS if kind.fails], ids=lambda kind: kind.group
)
def test_plugin_that_fails_in_use_is_attributed_to_its_package(
    kind: Kind, install: Install
) -> None:
    """The error that its code raised, or that its result led to, names the package."""
    module = install("bad", kind, "fine", kind.fails)
    try:
        kind.use(kind.look_up("fine"))
    except kind.error as error:
        text = str(error)
    except Exception as error:
        text = failure_text(error)
    assert f"plug-in {module}:THING of package bad" in text
    assert text.endswith("; repair or remove that package")


def test_command_attributes_the_failure_of_a_plugin(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    """Bad input (2), not a bug of this project (70)."""
    kind = next(kind for kind in KINDS if kind.group == "wires")
    module = install("bad", kind, "fine", kind.fails)
    assert run_era(["amp", "stop", "fine://a:1"]) == 2
    error = capsys.readouterr().err
    assert f"plug-in {module}:THING of package bad" in error
    assert "bug" not in error


@of_every_kind
def test_name_claimed_by_several_packages_is_refused(kind: Kind, install: Install) -> None:
    """Ours included; the error names the packages, and other names work."""
    install("one", kind, "fine", kind.works)
    install("two", kind, "fine", kind.works)
    ours, _ = kind.own
    install("three", kind, ours, kind.works)
    for name, claimants in (("fine", {"one", "two"}), (ours, {"era-haptics", "three"})):
        with pytest.raises(kind.error) as caught:
            kind.look_up(name)
        named = str(caught.value).split("packages (")[1].split(");")[0]
        assert set(named.split(", ")) == claimants
    install("four", kind, "other", kind.works.replace("'fine'", "'other'"))
    assert kind.look_up("other")


def test_layout_names_the_packages_that_claim_a_kind(install: Install, tmp_path: Path) -> None:
    """Of an effect whose name is its kind, which needs none beside it."""
    install("one", KINDS[1], "buzz", KINDS[1].works)
    (layout := tmp_path / "layout.yaml").write_text("effects: {buzz: {}}\n", "utf-8")
    with pytest.raises(InputError, match=r"effects\.buzz: kind of effect buzz is claimed by"):
        load_layout(layout, None)


@of_every_kind
def test_example_name_cannot_collide_with_a_built_in_one(kind: Kind) -> None:
    """Names of example plug-ins have a prefix, which a registry rejects for names of its own."""
    names: list[str] = []
    for file in (Path(__file__).parents[1] / "examples" / "plugins").glob("*/pyproject.toml"):
        points = tomllib.loads(file.read_text("utf-8"))["project"]["entry-points"]
        names += points.get(f"era_haptics.{kind.group}", ())
    assert names
    assert [name for name in names if not name.startswith(EXAMPLE_PREFIX)] == []
    for name in names:
        with pytest.raises(ValueError, match=rf"must not begin with 'example', got '{name}'"):
            PluginRegistry(kind.what, kind.group, object, error=InputError, own={name: object()})


OWN_URLS = ("tuio:", "TUIO:4000", "evdev:/dev/input/event5"), ("sim://rig.yaml", "SIM://rig.yaml")


def test_parts_of_the_project_need_no_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new one is known at once, without installing the project anew; by a scheme in any case."""
    monkeypatch.setattr("registry.plugins.plugins_of", lambda group: {})
    for kind in KINDS:
        assert is_made_by(kind.look_up(kind.own[0]), kind.own[1])
    for urls, open_url in zip(OWN_URLS, (open_source, address_of), strict=True):
        made = {type(open_url(url)).__name__ for url in urls}
        assert made <= {"TuioSource", "EvdevSource", "SimulatedAddress"}
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8"))
    assert "entry-points" not in project["project"]


def test_every_touch_source_of_the_project_is_registered() -> None:
    """Each class of controller/sources that can run, under a scheme."""
    for path in (Path(__file__).parents[1] / "controller" / "sources").glob("*.py"):
        import_module(f"controller.sources.{path.stem}")
    sources, bases = [], [*TouchSource.__subclasses__()]
    for base in bases:
        bases += base.__subclasses__()
        if base.__module__.startswith("controller.sources") and not isabstract(base):
            sources.append(f"{base.__module__}:{base.__name__}")
    assert sorted(sources) == sorted(TOUCH_SOURCES.own.values()), (
        "add it to controller/sources/touch.py"
    )


@with_names_of_their_own
def test_plugin_has_the_name_of_its_entry_point(kind: Kind, install: Install) -> None:
    """Otherwise a table would have another name than the rig."""
    install("good", kind, "finer", kind.works)
    with pytest.raises(kind.error, match=r"of package good .*'fine'"):
        kind.look_up("finer")


@made_of_urls
def test_plugin_made_of_a_url_may_refuse_it(kind: Kind, install: Install) -> None:
    """By the kind's own class of errors; anything else is attributed to its package."""
    install("good", kind, "fine", kind.works)
    with pytest.raises(kind.error, match=r"^refused$"):
        kind.find(f"fine{kind.ending}refused")
    with pytest.raises(kind.error, match=r"of package good .*KeyError"):
        kind.find(f"fine{kind.ending}broken")


@made_of_urls
def test_scheme_is_case_insensitive_and_required(kind: Kind, install: Install) -> None:
    """A bare device or file name is refused with an example of a URL."""
    module = install("good", kind, "fine", kind.works)
    assert is_made_by(kind.look_up("FINE"), sys.modules[module].THING)
    for url in ("", "fine", "/dev/fine"):
        with pytest.raises(kind.error, match=rf"{kind.ending}.*known: .*fine:"):
            kind.find(url)
