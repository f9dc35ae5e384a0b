"""Compare the pages with the code, and type their commands.

The tests compare generated parts, constants, schemes, commands and keys with the code. They type
the tutorials and the Python examples, run the notebooks, and check links and file names.
"""

import doctest
import json
import re
import shutil
import tempfile
import textwrap
from collections.abc import Iterator
from importlib import import_module
from importlib.metadata import requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from typer.core import TyperCommand, TyperGroup
from typer.testing import CliRunner

import constraints
import era_haptics
import notebooks
import pages
from controller.api.methods import StateEvent
from controller.api.schema import headline
from controller.cli.config_cli import app as config_commands
from controller.daemon.config import DaemonSection, LogSection, TouchSection
from controller.operation.operation_states import DaemonState
from drivers.by_hand.cli import amp
from drivers.by_hand.links import check_links
from drivers.errors import CommandError
from drivers.protocol.definition import BOOT_TIME
from drivers.wires.wire import address_of
from era_haptics.command import command_modules, run_era
from model.cli import app
from model.study import overview
from packages import PACKAGES
from processes.typed_page import Reader, difference, read_steps
from registry.command_line import join_commands
from registry.limits import GuardLimits

ROOT = Path(__file__).parents[2]


def test_whatever_says_that_it_is_written_is_among_the_pages() -> None:
    """A mark, or the name of a generator in the first lines of a file."""
    claimed = re.compile(
        r"<!-- begin: written by|\A.*\n?.*\n?.*(?:made|[Ww]ritten) by docs/generators"
    )
    found = {
        path.relative_to(pages.ROOT).as_posix()
        for folder in (
            *(".", "docs/reference", "docs/how-to", "controller/api", "firmware/core"),
            "examples/javascript",
        )
        for path in (pages.ROOT / folder).glob("*.*")
        if path.suffix in (".md", ".py", ".pyi", ".h", ".ts")
        and claimed.search(path.read_text("utf-8"))
    }
    assert len(found) > 6
    assert found <= set(pages.WRITTEN)


def test_constraints_pin_every_dependency_within_its_bounds() -> None:
    """One tested version of each that the extras for users require, directly or not."""
    lines = [
        line
        for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines()
        if not line.startswith("#")
    ]
    pinned = dict(line.split("==") for line in lines)
    assert constraints.closure("era-haptics", *constraints.EXTRAS).keys() == pinned.keys()
    for text in requires("era-haptics") or ():
        required = Requirement(text)
        if required.marker is None or required.marker.evaluate({"extra": "gateway"}):
            assert pinned[canonicalize_name(required.name)] in required.specifier


PAGES = ROOT / "docs" / "tutorials"


@pytest.mark.long
@pytest.mark.parametrize("page", sorted(path.stem for path in PAGES.glob("*.md")))
def test_a_reader_sees_what_the_page_shows(page: str, tmp_path: Path) -> None:
    """A tutorial typed from an empty folder beside the examples prints what it shows."""
    folder = tmp_path / "my_plate"
    folder.mkdir()
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    steps = read_steps(PAGES / f"{page}.md")
    assert sum(step.shown is not None for step in steps) >= 3
    # A short path: a Unix socket's has room for a hundred letters.
    with (
        tempfile.TemporaryDirectory(prefix="era") as home,
        Reader(folder, home=Path(home)) as reader,
    ):
        for step in steps:
            reader.follow(step)


def test_the_first_tutorial_writes_the_rig_of_the_others() -> None:
    """Who skipped it copies the same file from the examples."""
    written = [step for step in read_steps(PAGES / "own-plate.md") if step.kind == "written"]
    example = (ROOT / "examples" / "tutorial_rig.yaml").read_text("utf-8")
    assert [(step.name, step.text) for step in written] == [("my_rig.yaml", example)]


def rows(page: str, head: str) -> list[list[str]]:
    """The cells of the table that begins with this head, one list a row."""
    text = (ROOT / "docs" / "reference" / page).read_text("utf-8")
    table = text[text.index(head) :].partition("\n\n")[0]
    return [[cell.strip() for cell in line[1:-1].split("|")] for line in table.splitlines()[2:]]


def test_people_see_the_word_that_the_page_has_for_each_state() -> None:
    """In the status, in the event of a change, and in a line unless the cause begins with it."""
    shown = {row[0]: row[1].strip("*") for row in rows("daemon.md", "| state | shown as |")}
    assert list(shown) == [state.value for state in DaemonState]
    for state, word in shown.items():
        event = StateEvent(old="FAULT", new=state, cause="a cable was cut", remedy=None, epoch=1)
        assert event.model_dump()["word"] == word
        assert headline(state, event.cause) == f"{word}: a cable was cut"
        assert headline(state, f"{word} by 'era'") == f"{word} by 'era'"


def test_every_key_of_the_daemons_file_is_in_its_table() -> None:
    """As the configuration's model has them, and no others; a section's keys in its row."""
    told = {row[0].strip("`"): row[1] for row in rows("daemon.md", "| key | meaning | default |")}
    assert sorted(told) == sorted(DaemonSection.model_fields)
    for key, section in {"touch": TouchSection, "log": LogSection}.items():
        (listed,) = re.findall(r"`\{(.*?)\}`", told[key])[:1]
        assert listed.split(", ") == list(section.model_fields)


PAGE = (ROOT / "docs" / "reference" / "commands.md").read_text("utf-8")
RIG = str(ROOT / "examples" / "paper_plate.yaml")
COARSE = ["--frequencies", "100:200:50", "--grid", "4x3", "--mesh", "12x9"]


def commands(group: TyperGroup, name: str = "era") -> Iterator[tuple[str, TyperCommand]]:
    """Every command by its full name."""
    for command in group.commands.values():
        full = f"{name} {command.name}"
        if isinstance(command, TyperGroup):
            yield from commands(command, full)
        else:
            yield full, command


def test_page_lists_every_command_with_its_options() -> None:
    """The names on the page are those of the program; what it says once, it says above them."""
    parts = re.split(r"^### ", PAGE, flags=re.MULTILINE)[1:]
    listed = {part.splitlines()[0]: part for part in parts}
    known = dict(commands(join_commands(command_modules())[0]))
    common = set(re.findall(r"^- `(--[a-z-]+)", parts[0], re.MULTILINE))
    assert {name for name in listed if name.startswith("era ")} == set(known)
    for name, command in known.items():
        own = re.findall(r"^- `(?:-\w, )?(--[a-z-]+)", listed[name], re.MULTILINE)
        also = re.findall(
            r"`(--[a-z-]+)", listed[name].lower().partition("also with ")[2].split("\n")[0]
        )
        assert set(also) <= common, name
        named = {*own, *also}
        shown = [each for each in command.params if not getattr(each, "hidden", False)]
        names = {max(option.opts, key=len) for option in shown}
        assert named == {name for name in names if name.startswith("--")} - {"--help"}, name


def test_every_command_with_json_tells_its_keys() -> None:
    """A command that has the option is in the table of keys."""
    table = PAGE.partition("## What `--json` prints")[2].partition("## All commands")[0]
    listed = " ".join(re.findall(r"^\| (`era .*?) \|", table, re.MULTILINE))
    parts = re.split(r"^### era ", PAGE, flags=re.MULTILINE)[1:]
    with_json = [
        part.splitlines()[0] for part in parts if re.search(r"[Aa]lso with .*`--json`", part)
    ]
    assert len(with_json) > 30
    for name in with_json:
        assert f"`era {name}`" in listed or f"`{name.split()[-1]}`" in listed, name


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small table."""
    folder = tmp_path_factory.mktemp("built")
    arguments = ["table", "build", RIG, "-o", str(folder / "table.npz"), *COARSE]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    return folder


@pytest.mark.parametrize(
    "arguments",
    [
        ["config", "check", RIG],
        ["plate", "modes", RIG, "--mesh", "12x9"],
        ["plate", "map", RIG, "--mesh", "12x9", "--drive", "SW=110"],
        ["plate", "show", RIG],
        ["plate", "materials"],
        pytest.param(["plate", "template", RIG, "-o", "template.svg"], marks=pytest.mark.long),
        ["table", "build", RIG, "-o", "another.npz", *COARSE],
        ["table", "show", "table.npz"],
        ["table", "query", "table.npz", "--target", "0.06,0.05", "--quiet", "0.2,0.1"],
        pytest.param(
            ["table", "export", "table.npz", "--format", "csv", "-o", "table.csv"],
            marks=pytest.mark.long,
        ),
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_the_keys_are_those_that_are_printed(
    arguments: list[str], built: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table names the keys at the top of what `--json` prints, and no others."""
    monkeypatch.chdir(built)
    monkeypatch.setattr(overview, "CONTACT_SETS", 12)
    commands = config_commands if arguments[0] == "config" else app
    result = CliRunner().invoke(commands, [*arguments, "--json"])
    assert result.exit_code == 0, result.output
    name = " ".join(["era", *arguments[:2]])
    (row,) = re.findall(rf"^\| .*`{name}`.* \| (.*) \|$", PAGE, re.MULTILINE)
    row = re.sub(r"\(.*?\)", "", row)
    keys = set(re.findall(r"`(\w+)`", row))
    for key in [key for key in keys if "_N_" in key]:
        keys = keys - {key} | {key.replace("N", number) for number in "123"}
    assert keys == set(json.loads(result.stdout))


@pytest.mark.long
def test_readme_shows_what_the_demonstration_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its scale, the rows of three people and the summary, which virtual time makes repeatable."""
    readme = text_of("README.md")
    ((command, shown),) = re.findall(
        r"^    \$ \.venv/bin/era (demo .*)\n((?:    .*\n)+)", readme, re.MULTILINE
    )
    assert shown.count("of 3 vibrations") == 3
    monkeypatch.chdir(ROOT)
    assert run_era([*command.split(), "--out", str(tmp_path)]) == 0
    what = difference(textwrap.dedent(shown), capsys.readouterr().out)
    assert what is None, what


FIRST_COMMANDS = re.findall(r"`\.venv/bin/era ([^`]+)`", (ROOT / "README.md").read_text("utf-8"))


@pytest.mark.long
@pytest.mark.parametrize("command", FIRST_COMMANDS)
def test_first_command_of_each_reader_succeeds(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The commands in the README's table end with status 0; `--dashboard` would wait: its help."""
    monkeypatch.chdir(ROOT)
    arguments = command.replace("--dashboard", "--help").split()
    if arguments[0] == "demo":
        arguments += ["--out", str(tmp_path)]
    assert run_era(arguments) == 0


FACT_PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(ROOT / "docs").rglob("*.md"),
]


def text_of(page: str) -> str:
    """A page's text; its name is relative to the root."""
    return (ROOT / page).read_text("utf-8")


UNITS = {"dB": 1.0, "%": 0.01, "ms": 1e-3, "s": 1.0}
STATED_CONSTANT = re.compile(r"(\d+) (dB|%|ms|s)<!-- ([\w.]+)\.([A-Z_]+) -->")
"""A number on a page, its unit, and the constant that it states, in a comment after it."""


def test_pages_state_the_constants_of_the_code() -> None:
    """A number that is followed by the name of a constant has its value."""
    stated = [
        (page.name, name, float(number) * UNITS[unit], getattr(import_module(module), name))
        for page in FACT_PAGES
        for number, unit, module, name in STATED_CONSTANT.findall(page.read_text("utf-8"))
    ]
    assert len(stated) > 10
    wrong = [row for row in stated if row[2] != pytest.approx(row[3])]
    assert wrong == []


@pytest.mark.parametrize("page", ["README.md", "docs/concepts/localization.md"])
def test_page_states_how_many_fingers_kept_the_promise(page: str) -> None:
    """The share and number of fingers of the main run; clicks are counted by runs of their own."""
    figures, _, _ = text_of("docs/measured/promise.md").partition("<!-- end figures -->")
    rows = re.findall(r"(\d+) % of (\d+) \|", figures)
    counts = [int(count) for _, count in rows]
    kept = sum(int(share) * int(count) for share, count in rows) / sum(counts)
    ((share, count),) = re.findall(r"(\d+) % of\s+(\d+) fingers", text_of(page))
    assert int(count) == sum(counts)
    assert float(share) == pytest.approx(kept, abs=1)


def test_files_that_pages_name_are_there() -> None:
    """Every file named on a page exists; tests are named without their folder."""
    tests = {path.name for path in (ROOT / "tests").rglob("test_*.py")}
    folders = "|".join(path.name for path in ROOT.iterdir() if path.is_dir())
    named = re.compile(rf"`((?:{folders})/[\w./-]+\.(?:py|md|yaml|c|h|js|toml|json|html))`")
    gone = {
        name
        for page in FACT_PAGES
        for name in named.findall(page.read_text("utf-8"))
        if not (ROOT / name).exists() and not name.startswith(("dist/", "tests/faults/AREA"))
    }
    pages = [page.read_text("utf-8") for page in FACT_PAGES]
    assert gone == set()
    assert {name for page in pages for name in re.findall(r"`(test_\w+\.py)`", page)} <= tests


URLS_PAGE = (ROOT / "docs" / "reference" / "urls.md").read_text("utf-8")
EXAMPLES = re.findall(r"^\| `(\S+)` \| `(\S+)` \| (\d+) \|$", URLS_PAGE, re.MULTILINE)


@pytest.mark.parametrize(("url", "line", "number"), EXAMPLES)
def test_example_is_the_amplifier_that_the_page_says(url: str, line: str, number: str) -> None:
    """Its line, and its number there."""
    address = address_of(url)
    assert (address.line, address.number) == (line, int(number))


def test_slowest_line_is_that_of_the_page() -> None:
    """As the check has it; the next slower speed is refused."""
    baud, bitrate = map(int, re.findall(r"at least (\d+) baud, or (\d+) kbit/s", URLS_PAGE)[0])
    slow = {
        "a": "serial:///dev/a?baud={}",
        "b": "modbus+rtu:///dev/b?baud={}",
        "c": "can+slcan:///c?bitrate={}",
    }
    for factor, refused in ((1, []), (2, [*slow])):
        speeds = {"a": baud // factor, "b": baud // factor, "c": bitrate * 1000 // factor}
        urls = {name: url.format(speeds[name]) for name, url in slow.items()}
        errors, _ = check_links(urls, channels={}, limits=GuardLimits(40.0, 250.0, 1.0))
        assert [*errors] == refused


def test_page_has_every_scheme_and_the_time_of_a_board() -> None:
    """Those that an unknown one is answered with, in the first table and the help."""
    with pytest.raises(CommandError) as unknown:
        address_of("carrier+pigeon://roof")
    named = set(re.findall(r"([\w+-]+)://[,;\s]", f"{unknown.value} ")) - {"carrier+pigeon"}
    on_page = set(re.findall(r"^\| `([\w+-]+)://", URLS_PAGE, re.MULTILINE))
    assert on_page == named, "run make pages"
    in_help = set(re.findall(r"^  ([\w+-]+)://", str(amp.info.epilog), re.MULTILINE))
    assert in_help == named, "run make pages"
    assert f"for {BOOT_TIME:g} s" in URLS_PAGE


def test_every_page_can_be_found() -> None:
    """Each page stands in the side bar, or its folder's index, which stands there, links to it."""
    docs = ROOT / "docs"
    index = (docs / "index.md").read_text("utf-8")
    listed = set(re.findall(r"^(?:.* <)?([a-z-]+(?:/[\w-]+)?)>?$", index, re.MULTILINE))
    for name in ("measured/figures", "gallery"):
        assert name in listed
        folder, links = Path(name).parent, (docs / f"{name}.md").read_text("utf-8")
        listed |= {str(folder / page) for page in re.findall(r"\(([\w/-]+)\.md\)", links)}
    pages = {path.relative_to(docs) for path in docs.rglob("*.md")}
    names = {page.with_suffix("").as_posix() for page in pages if page.parts[0] != "_build"}
    assert names - listed == {"index"}


def test_the_version_is_the_same_wherever_it_is_stated() -> None:
    """The newest release of the changelog, the citation and the packages have one version."""
    stated = {
        "pyproject.toml": r'^version = "(.+)"',
        "CITATION.cff": r"^version: (.+)",
        "CHANGELOG.md": r"^## \[(.+)\] - \d{4}-\d\d-\d\d$",
        "examples/javascript/package.json": r'^  "version": "(.+)"',
    }
    texts = {name: (ROOT / name).read_text("utf-8") for name in stated}
    versions = {name: re.findall(stated[name], texts[name], re.MULTILINE)[0] for name in stated}
    assert len(set(versions.values())) == 1, versions


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"])
def test_links_beside_the_docs_lead_somewhere(name: str) -> None:
    """What a link to a file of the project names is there."""
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", (ROOT / name).read_text("utf-8"))
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_pages_that_are_named_in_code_are_there() -> None:
    """Messages, docstrings and the changelog name pages by their path."""
    files = [
        path
        for name in (*PACKAGES, "benchmarks", "examples")
        for path in (ROOT / name).rglob("*.py")
    ]
    files += [
        ROOT / "CHANGELOG.md",
        ROOT / "Makefile",
        ROOT / "SECURITY.md",
    ]
    named = {
        (page, path.name)
        for path in files
        for page in re.findall(r"\bdocs/[a-z][\w/-]+\.md\b", path.read_text("utf-8"))
    }
    assert len(named) > 10
    assert {(page, path) for page, path in named if not (ROOT / page).is_file()} == set()


PYTHON_EXAMPLES_PAGE = (ROOT / "docs" / "reference" / "python-api.md").read_text("utf-8")


def test_every_function_has_an_example() -> None:
    """Each entry of a function is followed by a session; methods may do without."""
    entries = re.findall(r"^- `(\w+)\(.*\n((?:  .*\n)*)", PYTHON_EXAMPLES_PAGE, re.MULTILINE)
    shown = {name: ">>> " in text for name, text in entries if hasattr(era_haptics, name)}
    assert len(shown) > 15
    assert [name for name, has_example in shown.items() if not has_example] == []


@pytest.mark.long
def test_examples_print_what_the_page_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the order of the page, from a folder beside the examples."""
    shutil.copytree(
        ROOT / "examples",
        tmp_path / "examples",
        ignore=shutil.ignore_patterns("*.c", "node_modules"),
    )
    monkeypatch.chdir(tmp_path)
    sessions = "\n".join(
        re.findall(r"^ *```pycon\n(.*?)^ *```$", PYTHON_EXAMPLES_PAGE, re.MULTILINE | re.DOTALL)
    )
    test = doctest.DocTestParser().get_doctest(sessions, {"era": era_haptics}, "page", None, 0)
    printed: list[str] = []
    doctest.DocTestRunner().run(test, out=printed.append)
    assert len(test.examples) > 25
    assert "".join(printed) == ""


NOTEBOOK = '''# %% [markdown]
"""
# A title
"""

# %%
from matplotlib.figure import Figure
print("seen")

# %%
Figure()
'''


def test_a_notebook_is_shown_with_what_it_prints_and_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Text as text, a cell with its output, and a figure that ends a cell as a picture."""
    monkeypatch.setattr(notebooks, "ROOT", tmp_path)
    pictures = tmp_path / "docs"
    pictures.mkdir()
    (tmp_path / "small.py").write_text(NOTEBOOK, "utf-8")
    shown = notebooks.as_markdown(tmp_path / "small.py", pictures)
    title, code, printed, figure, picture = shown.split("\n\n")
    assert title == "# A title"
    assert 'print("seen")' in code
    assert printed == "````text\nseen\n````"
    assert "Figure()" in figure
    assert picture == "![The figure of this cell](/small-2.png)"
    assert (pictures / "small-2.png").read_bytes().startswith(b"\x89PNG")
