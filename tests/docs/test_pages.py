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

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from typer.core import TyperCommand, TyperGroup
from typer.testing import CliRunner

import constraints
import era_haptics
from controller.cli.config_cli import app as config_commands
from drivers.wires.wire import address_of
from era_haptics.command import command_modules, run_era
from model.cli import app
from model.study import overview
from packages import PACKAGES
from processes.typed_page import Reader, difference, read_steps
from registry.command_line import join_commands

ROOT = Path(__file__).parents[2]


def test_constraints_pin_every_dependency_within_its_bounds() -> None:
    """One tested version of each direct or indirect dependency of the extras for users."""
    lines = (ROOT / "constraints.txt").read_text("utf-8").splitlines()
    pinned = dict(line.split("==") for line in lines if not line.startswith("#"))

    assert constraints.closure("era-haptics", *constraints.EXTRAS).keys() == pinned.keys()
    for text in requires("era-haptics") or ():
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": "gateway"}):
            assert pinned[canonicalize_name(requirement.name)] in requirement.specifier, text


PAGES = ROOT / "docs" / "tutorials"


@pytest.mark.long
@pytest.mark.parametrize("page", sorted(path.stem for path in PAGES.glob("*.md")))
def test_tutorial_prints_the_output_that_it_shows(page: str, tmp_path: Path) -> None:
    """Each command is typed from an empty folder next to the examples."""
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


def test_first_tutorial_writes_the_rig_of_the_others() -> None:
    """A reader who skips it copies the same file from the examples."""
    steps = read_steps(PAGES / "own-plate.md")
    files = {step.name: step.text for step in steps if step.kind == "written"}

    assert files == {"my_rig.yaml": text_of("examples/tutorial_rig.yaml")}


def rows(page: str, head: str) -> list[list[str]]:
    """The cells of the table that begins with this head, one list a row."""
    text = (ROOT / "docs" / "reference" / page).read_text("utf-8")
    table = text[text.index(head) :].partition("\n\n")[0]
    return [[cell.strip() for cell in line[1:-1].split("|")] for line in table.splitlines()[2:]]


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


def option_names(command: TyperCommand) -> set[str]:
    """The long names of a command's visible options."""
    visible = [option for option in command.params if not getattr(option, "hidden", False)]
    names = {max(option.opts, key=len) for option in visible}
    return {name for name in names if name.startswith("--")} - {"--help"}


def test_page_lists_every_command_with_its_options() -> None:
    """Options of many commands are described once, above the commands that refer to them."""
    parts = re.split(r"^### ", PAGE, flags=re.MULTILINE)[1:]
    sections = {part.splitlines()[0]: part for part in parts}
    program = dict(commands(join_commands(command_modules())[0]))
    common = set(re.findall(r"^- `(--[a-z-]+)", parts[0], re.MULTILINE))

    assert {name for name in sections if name.startswith("era ")} == set(program)
    for name, command in program.items():
        section = sections[name]
        described = re.findall(r"^- `(?:-\w, )?(--[a-z-]+)", section, re.MULTILINE)
        reference = section.lower().partition("also with ")[2].split("\n")[0]
        referenced = re.findall(r"`(--[a-z-]+)", reference)
        assert set(referenced) - common == set(), name
        assert {*described, *referenced} == option_names(command), name


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
def test_page_lists_the_keys_that_a_command_prints(
    arguments: list[str], built: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table names the keys at the top of what `--json` prints, and no others."""
    monkeypatch.chdir(built)
    monkeypatch.setattr(overview, "CONTACT_SETS", 12)
    program = config_commands if arguments[0] == "config" else app
    name = " ".join(["era", *arguments[:2]])

    result = CliRunner().invoke(program, [*arguments, "--json"])

    assert result.exit_code == 0, result.output
    (row,) = re.findall(rf"^\| .*`{name}`.* \| (.*) \|$", PAGE, re.MULTILINE)
    listed = re.findall(r"`(\w+)`", re.sub(r"\(.*?\)", "", row))
    keys = set()
    for key in listed:
        numbers = "123" if "_N_" in key else "1"
        keys |= {key.replace("_N_", f"_{number}_") for number in numbers}
    assert keys == set(json.loads(result.stdout))


@pytest.mark.long
def test_readme_shows_what_the_demonstration_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its scale, the rows of three people and the summary, which virtual time makes repeatable."""
    session = re.compile(r"^    \$ \.venv/bin/era (demo .*)\n((?:    .*\n)+)", re.MULTILINE)
    ((command, output),) = session.findall(text_of("README.md"))
    assert output.count("of 3 vibrations") == 3
    monkeypatch.chdir(ROOT)

    assert run_era([*command.split(), "--out", str(tmp_path)]) == 0

    first_difference = difference(textwrap.dedent(output), capsys.readouterr().out)
    assert first_difference is None, first_difference


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
    statements, values = {}, {}
    for page in FACT_PAGES:
        for number, unit, module, name in STATED_CONSTANT.findall(page.read_text("utf-8")):
            statements[page.name, name] = float(number) * UNITS[unit]
            values[page.name, name] = getattr(import_module(module), name)

    assert len(statements) > 10
    assert statements == pytest.approx(values)


@pytest.mark.parametrize("page", ["README.md", "docs/concepts/localization.md"])
def test_page_states_how_many_fingers_kept_the_promise(page: str) -> None:
    """The share and number of fingers of the main run; clicks are counted by runs of their own."""
    figures, _, _ = text_of("docs/measured/promise.md").partition("<!-- end figures -->")
    cells = re.findall(r"(\d+) % of (\d+) \|", figures)
    shares, counts = np.array(cells, dtype=int).T
    ((share, count),) = re.findall(r"(\d+) % of\s+(\d+) fingers", text_of(page))

    assert int(count) == counts.sum()
    assert float(share) == pytest.approx(np.average(shares, weights=counts), abs=1)


MADE_BY_COMMANDS = ("dist/", "out/")


def test_files_that_pages_name_exist() -> None:
    """Every file named on a page exists; tests are named without their folder."""
    tests = {path.name for path in (ROOT / "tests").rglob("test_*.py")}
    folders = "|".join(path.name for path in ROOT.iterdir() if path.is_dir())
    file_name = re.compile(rf"`((?:{folders})/[\w./-]+\.(?:py|md|yaml|c|h|js|toml|json|html))`")

    for page in FACT_PAGES:
        text = page.read_text("utf-8")
        names = file_name.findall(text)
        sources = [name for name in names if not name.startswith(MADE_BY_COMMANDS)]
        missing = [name for name in sources if not (ROOT / name).exists()]
        assert set(missing) <= {"tests/faults/AREA.yaml"}, page
        assert set(re.findall(r"`(test_\w+\.py)`", text)) - tests == set(), page


URLS_PAGE = (ROOT / "docs" / "reference" / "urls.md").read_text("utf-8")
EXAMPLES = re.findall(r"^\| `(\S+)` \| `(\S+)` \| (\d+) \|$", URLS_PAGE, re.MULTILINE)


@pytest.mark.parametrize(("url", "line", "number"), EXAMPLES)
def test_example_url_is_the_amplifier_that_the_page_states(
    url: str, line: str, number: str
) -> None:
    """Its line, and its number on the line."""
    address = address_of(url)
    assert (address.line, address.number) == (line, int(number))


def test_every_page_can_be_found() -> None:
    """Each page is in the side bar, or a page of figures or pictures there links to it."""
    docs = ROOT / "docs"
    entry = re.compile(r"^(?:.* <)?([a-z-]+(?:/[\w-]+)?)>?$", re.MULTILINE)
    linked = set(entry.findall(text_of("docs/index.md")))
    for name in ("measured/figures", "gallery"):
        assert name in linked
        folder = Path(name).parent
        links = re.findall(r"\(([\w/-]+)\.md\)", text_of(f"docs/{name}.md"))
        linked |= {str(folder / link) for link in links}
    page_names = set()
    for path in docs.rglob("*.md"):
        page = path.relative_to(docs)
        if page.parts[0] != "_build":
            page_names.add(page.with_suffix("").as_posix())

    assert page_names - linked == {"index"}


def test_version_is_the_same_wherever_it_is_stated() -> None:
    """The newest release of the changelog, the citation and the packages have one version."""
    patterns = {
        "pyproject.toml": r'^version = "(.+)"',
        "CITATION.cff": r"^version: (.+)",
        "CHANGELOG.md": r"^## \[(.+)\] - \d{4}-\d\d-\d\d$",
        "examples/javascript/package.json": r'^  "version": "(.+)"',
    }
    versions = {}
    for name, pattern in patterns.items():
        match = re.search(pattern, text_of(name), re.MULTILINE)
        assert match, name
        versions[name] = match[1]

    assert len(set(versions.values())) == 1, versions


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"])
def test_links_of_top_level_pages_exist(name: str) -> None:
    """A link to a file of the project names an existing file."""
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", text_of(name))

    assert [link for link in links if not (ROOT / link).exists()] == []


def test_pages_that_are_named_in_code_exist() -> None:
    """Messages, docstrings and the changelog name pages by their path."""
    files = [ROOT / "CHANGELOG.md", ROOT / "Makefile", ROOT / "SECURITY.md"]
    for folder in (*PACKAGES, "benchmarks", "examples"):
        files += (ROOT / folder).rglob("*.py")
    page_name = re.compile(r"\bdocs/[a-z][\w/-]+\.md\b")
    mentions = {path: page_name.findall(path.read_text("utf-8")) for path in files}

    assert sum(map(len, mentions.values())) > 10
    for path, names in mentions.items():
        assert [name for name in names if not (ROOT / name).is_file()] == [], path


PYTHON_EXAMPLES_PAGE = (ROOT / "docs" / "reference" / "python-api.md").read_text("utf-8")


def test_every_function_has_an_example() -> None:
    """Each entry of a function is followed by a session; methods may do without."""
    entry = re.compile(r"^- `(\w+)\(.*\n((?:  .*\n)*)", re.MULTILINE)
    entries = dict(entry.findall(PYTHON_EXAMPLES_PAGE))
    functions = [name for name in entries if hasattr(era_haptics, name)]

    assert len(functions) > 15
    assert [name for name in functions if ">>> " not in entries[name]] == []


@pytest.mark.long
def test_python_examples_print_the_output_of_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the order of the page, from a folder next to the examples."""
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
