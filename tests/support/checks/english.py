"""Patterns of translated English in what people read: `make lint` lists their sentences and fails.

    python tests/support/checks/english.py            # compare all budgets
    python tests/support/checks/english.py FILE ...   # list all findings in some files

A budget is a number of patterns per 1000 words. Each page and each YAML file has its own; in each
package, texts (help, errors, log messages, descriptions) and docs (docstrings and comments) have
one each. `english.toml` has the budgets, exceptions with a reason, and allowed phrases: list a
phrase there if it is correct. A short file may have one pattern.

The patterns indicate a foreign sentence; rewrite the sentence, not the pattern. Pages, YAML files
and texts have American spelling, without exception; keys in backticks keep theirs.
"""

import ast
import math
import re
import sys
import tomllib
from bisect import bisect
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[3]
SETTINGS = Path(__file__).with_suffix(".toml")
PACKAGES = ("controller", "drivers", "era_haptics", "model", "registry", "sim")
PAGES = ("README.md", "CONTRIBUTING.md", "docs/**/*.md", "firmware/**/*.md")
YAML_FILES = ("examples/**/*.yaml", "examples/**/*.yml", "controller/**/*.yaml")


class Pattern(NamedTuple):
    """A pattern of translated English, and what to write instead."""

    words: str
    """Regular expression, in which a space matches any white space."""
    suggestion: str


QUANTIFIER = "".join(
    rf"(?<!{word}\s)"
    for word in (
        *("all", "any", "both", "each", "either", "half", "many", "more", "most", "much"),
        *("none", "one", "part", "some", "thirds", "two"),
    )
)
"""Not after a quantity: "half of it" and "one of these" are correct."""

PASSIVE = r"(?<!ed\s)"
"""Not after a participle: "limited by its power" is correct."""

PATTERNS = {
    "clause for a noun": Pattern(
        r"what (?:is|are|was|were|plays|lasts|comes|has|it|they|people|nobody|a|the|each|of|may"
        r"|one|else)",
        "name the thing: active layers, continuous events, fitted parameters",
    ),
    "pronoun for a noun": Pattern(
        r"(?:all that|that of|those of|those that|the one that|one that|ones that|that which)",
        "repeat the noun",
    ),
    "of it": Pattern(
        rf"{QUANTIFIER}of (?:it|them|these|those)|of (?:which|whom)"
        r"|of one(?= (?:of|that|which|who|at|in|on|with|is|are|has)|[,.;:)])",
        "use a possessive or a compound noun",
    ),
    "as of": Pattern(
        r"as (?:of|by)|as (?:in|at|with|on) (?:it|its|that|those|these)",
        "same as for, according to, for instance in",
    ),
    "by its": Pattern(
        rf"{PASSIVE}by (?:its|their|the rig|the board|it|them|which)|by (?:far|that)",
        "according to, from, in, per",
    ),
    "where for if": Pattern(
        r"where (?:it|they|there|none|nothing|no|one|that|both|this|all|only)", "if, when"
    ),
    "at once": Pattern(r"at once", "immediately, or simultaneously"),
    "beside": Pattern(r"besides?", "next to, in addition to, with ... present"),
    "nine of ten": Pattern(
        r"(?:nine|one|eight|seven|half) (?:of|in) (?:ten|twenty)", "90 %, the 10th percentile"
    ),
    "archaic": Pattern(
        r"(?:anew|hence|thus|whichever|whatever|wherever|whoever|nobody|somebody|thereof|therein"
        r"|aught|ere)",
        "again, so, any, no one",
    ),
    "thing that speaks": Pattern(
        r"(?:says|said|tells|told|asked|answered|knows|minds|ails)",
        "reports, prints, returns, rejects, computes",
    ),
    "deviate": Pattern(r"deviat\w+", "differ, vary; tolerances"),
    "is none": Pattern(
        r"(?<!there\s)(?:is|are|has|have) (?:(?-i:none)|no other|nothing)",
        "is missing, does not exist",
    ),
    "stands": Pattern(
        r"(?:stands?|stood|bears?|borne)|lies(?! (?:above|below|between|on|outside|within))", "is"
    ),
    "is to be": Pattern(
        r"(?:is|are) to (?:be|feel|play|have|do|get|give)|shall", "must, should, or the imperative"
    ),
    "trailing clause": Pattern(
        r", (?:of|by|for|in|on) (?:which|whom|those|these)", "start another sentence"
    ),
}


BRITISH = re.compile(
    r"\b(?:un|re)?(?:"
    r"analys(?:e|ed|ing)|artefacts?|behaviours?|catalogue[ds]?|centr(?:e|ed|es)"
    r"|colou(?:r|red|ring|rs)|favour\w*|grey\w*|honour\w*|label(?:led|ling)|licences?"
    r"|(?:centi|kilo|milli)?metres?|modell(?:ed|ing)|neighbour\w*|towards"
    r"|(?:discret|energ|factor|initial|linear|maxim|minim|normal|optim|organ|quant|real|recogn"
    r"|summar|synchron)is(?:e|ed|er|ers|es|ing|ation|ations)"
    r")\b",
    re.IGNORECASE,
)
"""British spellings of common words."""

BRITISH_SPELLING = "British spelling"

NAMES = tuple(PATTERNS)
ALTERNATIVES = "|".join(f"({pattern.words})" for pattern in PATTERNS.values())
ANY = re.compile(rf"(?:\b|(?=,))(?:{ALTERNATIVES})\b".replace(" ", r"\s+"), re.IGNORECASE)
"""Any pattern as whole words; the number of its group is that of its name."""


class Finding(NamedTuple):
    """A pattern in a sentence."""

    file: str
    line: int
    pattern: str
    sentence: str

    def __str__(self) -> str:
        suggestion = "the American spelling"
        if self.pattern != BRITISH_SPELLING:
            suggestion = PATTERNS[self.pattern].suggestion
        return f"{self.file}:{self.line}: {self.pattern}: {self.sentence!r}; write {suggestion}"


@dataclass
class Prose:
    """Prose with a common budget."""

    words: int = 0
    findings: list[Finding] = field(default_factory=list)
    british: list[Finding] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Patterns per 1000 words."""
        return 1000 * len(self.findings) / max(self.words, 1)

    def is_within(self, budget: float) -> bool:
        """Whether it has at most the patterns of its budget, rounded up."""
        return len(self.findings) <= math.ceil(budget * self.words / 1000)

    def add(self, file: str, text: str, allowed: Iterable[str]) -> None:
        """Count the words of a file, and find its patterns; text: prose at its place, else NUL."""
        self.words += len(WORD.findall(text))
        for phrase in allowed:
            text = text.replace(phrase, "")
        for match in ANY.finditer(text):
            assert match.lastindex is not None
            name = NAMES[match.lastindex - 1]
            self.findings.append(finding_at(file, name, text, match.start()))
        for match in BRITISH.finditer(text):
            self.british.append(finding_at(file, BRITISH_SPELLING, text, match.start()))


def finding_at(file: str, pattern: str, text: str, position: int) -> Finding:
    """Return the finding of a pattern at a position of a file's prose."""
    line = text.count("\n", 0, position) + 1
    return Finding(file, line, pattern, sentence_at(text, position))


WORD = re.compile(r"[^\W\d_][^\s\0]*")
LONGEST = 400  # characters before a pattern in its sentence
BREAK = re.compile(r"[.;:!?|](?=\s)|\0|\n\s*\n")


def sentence_at(text: str, position: int) -> str:
    """Return the sentence around a position, on one line."""
    first = max(0, position - LONGEST)
    start = max((match.end() for match in BREAK.finditer(text, first, position)), default=first)
    end = BREAK.search(text, position)
    sentence = text[start : end.start() if end else len(text)]
    return " ".join(sentence.split())[:160]


def blank(text: str) -> str:
    """Return a NUL character for each line of a text, and its line breaks."""
    return re.sub(r"[^\n]+", "\0", text)


NO_PROSE = re.compile(
    r"^```.*?^```|<!--.*?-->|`[^`\n]*`|\]\([^)\n]*\)|^(?: {4}|\t)[^\n]*$", re.MULTILINE | re.DOTALL
)
"""Code, comments and addresses on a page."""


def prose_of_page(text: str) -> str:
    """Return a page of Markdown with everything else blanked."""
    return NO_PROSE.sub(lambda match: blank(match[0]), text)


QUOTED = re.compile(r"`[^`\n]*`")
COMMENT = re.compile(r"(?:^|(?<=\s))#[^\n]*", re.MULTILINE)


def prose_of_yaml(text: str) -> str:
    """Return the comments of a YAML file, with everything else blanked."""
    comments = keep(text, [match.span() for match in COMMENT.finditer(text)])
    return QUOTED.sub(lambda match: blank(match[0]), comments)


def keep(text: str, spans: Iterable[tuple[int, int]]) -> str:
    """Return a text with everything outside these spans blanked; consecutive comments join."""
    parts, end = [], 0
    for start, stop in sorted(spans):
        between = text[end:start]
        parts += [blank(between) if between.strip() else between, text[start:stop]]
        end = stop
    parts.append(blank(text[end:]))
    return "".join(parts).replace("#", " ")


def prose_of_python(text: str) -> dict[str, str]:
    """Return texts and docs of a module, each with everything else blanked."""
    lines = text.splitlines(keepends=True)
    starts = [0, *accumulate(map(len, lines))]

    def position(line: int, column: int) -> int:
        """Return the index of a character, from its line and the bytes before it."""
        line_bytes = lines[line - 1].encode()[:column] if not lines[line - 1].isascii() else None
        return starts[line - 1] + (column if line_bytes is None else len(line_bytes.decode()))

    spans: dict[str, list[tuple[int, int]]] = {"texts": [], "docs": []}
    for node, kind in string_nodes(ast.parse(text)):
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start = position(node.lineno, node.col_offset)
        spans[kind].append((start, position(node.end_lineno, node.end_col_offset)))
    strings = sorted(spans["texts"] + spans["docs"])
    for comment in COMMENT.finditer(text):
        before = bisect(strings, comment.span())
        if before == 0 or strings[before - 1][1] <= comment.start():
            spans["docs"].append(comment.span())
    return {kind: without_syntax(keep(text, found)) for kind, found in spans.items()}


def string_nodes(tree: ast.AST) -> Iterator[tuple[ast.expr, str]]:
    """Yield the strings of a module with spaces, and whether they belong to texts or docs."""
    docs: set[int] = set()
    pending: list[Any] = [tree]
    while pending:
        node = pending.pop()
        body = getattr(node, "body", None)
        if isinstance(body, list):
            is_help = any(map(is_command, getattr(node, "decorator_list", ())))
            docs |= {id(each.value) for each in body[is_help:] if isinstance(each, ast.Expr)}
        is_string = isinstance(node, ast.Constant) and isinstance(node.value, str)
        if isinstance(node, ast.JoinedStr) or (is_string and " " in node.value.strip()):
            yield node, "docs" if id(node) in docs else "texts"
        else:
            pending.extend(ast.iter_child_nodes(node))


def is_command(decorator: ast.expr) -> bool:
    """Whether a decorator makes a function a command, whose docstring is its help."""
    called = decorator.func if isinstance(decorator, ast.Call) else decorator
    return isinstance(called, ast.Attribute) and called.attr in ("command", "callback")


SYNTAX = re.compile(r"\b[rbfuRBFU]{1,2}(?=[\"'])|\"+|(?<!\w)'+|'+(?!\w)|\\n")
PLACEHOLDER = re.compile(r"\{[^{}\n]*\}")


def without_syntax(text: str) -> str:
    """Blank quotes, so that adjacent strings join, and values that strings have inserted."""
    for _ in range(2):  # one in the format of another
        text = PLACEHOLDER.sub(lambda match: blank(match[0]), text)
    return SYNTAX.sub(lambda match: " " * len(match[0]), text)


def read(root: Path, allowed: Iterable[str], only: Iterable[str] = ()) -> dict[str, Prose]:
    """Return the prose of a checkout, by file or by package and kind; only: of some files."""
    prose: dict[str, Prose] = {}
    kinds: list[tuple[Iterable[str], Callable[[str], str]]] = [
        (PAGES, prose_of_page),
        (YAML_FILES, prose_of_yaml),
    ]
    for patterns, prose_of in kinds:
        for file, text in files(root, patterns, only):
            prose.setdefault(file, Prose()).add(file, prose_of(text), allowed)
    for package in PACKAGES:
        for file, text in files(root, [f"{package}/**/*.py"], only):
            for kind, part in prose_of_python(text).items():
                prose.setdefault(f"{package}: {kind}", Prose()).add(file, part, allowed)
    return prose


def files(root: Path, patterns: Iterable[str], only: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield path and text of each file of some patterns."""
    paths = {path for pattern in patterns for path in root.glob(pattern) if path.is_file()}
    for path in sorted(paths):
        file = path.relative_to(root).as_posix()
        if not only or file in only:
            yield file, path.read_text("utf-8")


def over_budget(prose: dict[str, Prose], settings: dict[str, Any]) -> Iterator[str]:
    """Yield a heading for each budget that is exceeded, and all of its findings."""
    for name, part in prose.items():
        default = settings["budgets"]["docs" if name.endswith(": docs") else "default"]
        budget = settings["exceptions"].get(name, {"budget": default})["budget"]
        if not part.is_within(budget):
            yield f"{name}: {part.rate:.1f} patterns per 1000 words, at most {budget} are allowed:"
            yield from map(str, part.findings)
        if not name.endswith(": docs"):
            yield from map(str, part.british)


def main(arguments: list[str]) -> str:
    """Return the problems of a checkout, or all findings in some files."""
    settings = tomllib.loads(SETTINGS.read_text("utf-8"))
    allowed = settings["allowed"]
    only = [Path(name).resolve().relative_to(ROOT).as_posix() for name in arguments]
    prose = read(ROOT, allowed, only)
    if only:
        return "\n".join(str(finding) for part in prose.values() for finding in part.findings)
    return "\n".join(over_budget(prose, settings))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]) or None)
