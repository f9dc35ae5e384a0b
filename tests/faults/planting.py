"""Locate the code that a planted fault changes, by syntax, and change it.

A pattern (`find`) is an expression or some statements of Python. It matches code of the same syntax
tree, whatever the layout and the comments. `...` in a pattern stands for any code: any number of
statements, one expression, or all arguments of a call that the pattern does not name; in an index
it means itself. In the replacement (`replace`), the first `...` stands for the code that the first
one of the pattern matched, and so on.

If no code has exactly the names of the pattern, names may differ: first private names (with a
leading underscore), then local variables as well. A name of the pattern always stands for the same
name of the code, and the replacement gets the names of the code. A pattern must match exactly once
in its file, or in the class or function that `of` names.

Other languages (C, JavaScript) are compared token by token, without whitespace and comments.
"""

import ast
import builtins
import contextlib
import re
from collections.abc import Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import lru_cache
from typing import Any, NamedTuple

_HOLE = "..."
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_DEFINITIONS = (*_FUNCTIONS, ast.ClassDef)
_BLOCKS = ("body", "orelse", "finalbody")
_BUILTIN_NAMES = frozenset(dir(builtins))


class StaleEdit(ValueError):
    """An edit does not fit its file any more."""


@dataclass(frozen=True)
class Edit:
    """A change of one file.

    scope: class, function or method that contains the code, such as `Group.stop`; empty for the
    whole file.
    """

    file: str
    scope: str
    find: str
    replace: str


def planted(edit: Edit, source: str) -> str:
    """Return the source text with an edit applied; raise StaleEdit if it does not match once."""
    if edit.file.endswith(".py"):
        return _plant_python(edit, source)
    return _plant_tokens(edit, source)


@dataclass(frozen=True)
class _Binding:
    """What a pattern has matched so far: a name of the code for each name, and code for each hole.

    names: by kind (private, name, attribute) and name of the pattern.
    """

    names: dict[tuple[str, str], str] = field(default_factory=dict)
    holes: tuple[Any, ...] = ()


class _Freedom(NamedTuple):
    """Which names of the code may differ from those of a pattern."""

    private: bool = False
    local: bool = False


_FREEDOMS = (_Freedom(), _Freedom(private=True), _Freedom(private=True, local=True))
"""Tried in this order, until one of them matches."""


def is_private(name: str) -> bool:
    """Return whether a name has a leading underscore and is not special (`__init__`) or `_`."""
    return name.startswith("_") and not name.endswith("__") and name != "_"


def _kind(owner: ast.AST, name: str) -> str:
    if is_private(name):
        return "private"
    return "attribute" if isinstance(owner, ast.Attribute | ast.keyword) else "name"


class _Matcher:
    """Compares a pattern with code.

    function: the outermost function around the code, or None; its variables and parameters are the
        local names.
    global_names: names that cannot be local variables of a pattern.
    """

    def __init__(
        self, freedom: _Freedom, function: ast.AST | None, global_names: frozenset[str]
    ) -> None:
        self._freedom = freedom
        self._function = function
        self._global_names = global_names

    def match(self, pattern: Any, code: Any, binding: _Binding) -> Iterator[_Binding]:
        """Yield each way in which a pattern (a node, a list of nodes, a constant) fits code."""
        if _is_hole(pattern):
            yield replace(binding, holes=(*binding.holes, code))
        elif isinstance(pattern, list):
            yield from self._match_list(pattern, code, binding)
        elif not isinstance(pattern, ast.AST):
            if type(pattern) is type(code) and pattern == code:
                yield binding
        elif type(pattern) is type(code):
            is_call = isinstance(pattern, ast.Call)
            if is_call and any(_is_hole(argument) for argument in pattern.args):
                yield from self._match_call(pattern, code, binding)
            else:
                matcher = self._within(code)
                yield from matcher._match_fields(pattern, pattern._fields, code, binding)

    def _within(self, code: ast.AST) -> "_Matcher":
        """Return the matcher for code in a function if this one is not in a function yet."""
        if self._function or not isinstance(code, _FUNCTIONS):
            return self
        return _Matcher(self._freedom, code, self._global_names)

    def match_start(
        self, pattern: Sequence[ast.stmt], code: Sequence[ast.stmt], binding: _Binding
    ) -> Iterator[tuple[_Binding, int]]:
        """Compare statements with the first ones of a block; yield how many they are."""
        if not pattern:
            yield binding, 0
            return
        first, following = pattern[0], pattern[1:]
        if _is_hole_statement(first):
            counts = range(len(code) + 1) if following else [len(code)]
            for count in counts:
                with_hole = replace(binding, holes=(*binding.holes, code[:count]))
                for bound, following_count in self.match_start(following, code[count:], with_hole):
                    yield bound, count + following_count
        elif code:
            for bound_first in self.match(first, code[0], binding):
                for bound, following_count in self.match_start(following, code[1:], bound_first):
                    yield bound, 1 + following_count

    def _match_list(self, pattern: list[Any], code: Any, binding: _Binding) -> Iterator[_Binding]:
        if any(_is_hole_statement(item) for item in pattern):
            for bound, count in self.match_start(pattern, code, binding):
                if count == len(code):
                    yield bound
        elif len(pattern) == len(code):
            yield from self._match_all([*zip(pattern, code, strict=True)], binding)

    def _match_all(self, pairs: Sequence[tuple[Any, Any]], binding: _Binding) -> Iterator[_Binding]:
        """Compare pairs of pattern and code, one after the other."""
        if not pairs:
            yield binding
            return
        for bound in self.match(*pairs[0], binding):
            yield from self._match_all(pairs[1:], bound)

    def _match_fields(
        self, pattern: ast.AST, names: Sequence[str], code: ast.AST, binding: _Binding
    ) -> Iterator[_Binding]:
        if not names:
            yield binding
            return
        name, *following = names
        value, in_code = getattr(pattern, name), getattr(code, name)
        is_name = isinstance(value, str) and not isinstance(pattern, ast.Constant)
        if name in ("ctx", "kind", "type_comment"):
            matched: Iterable[_Binding] = [binding]
        elif is_name and isinstance(in_code, str):
            matched = self._match_name(_kind(pattern, value), value, in_code, binding)
        else:
            matched = self.match(value, in_code, binding)
        for bound in matched:
            yield from self._match_fields(pattern, following, code, bound)

    def _match_call(
        self, pattern: ast.Call, call: ast.Call, binding: _Binding
    ) -> Iterator[_Binding]:
        """Compare a call with `...` among its arguments."""
        first = [argument for argument in pattern.args if not _is_hole(argument)]
        named = {keyword.arg for keyword in pattern.keywords}
        same_keywords = [keyword for keyword in call.keywords if keyword.arg in named]
        other_keywords = [keyword for keyword in call.keywords if keyword.arg not in named]
        unnamed = (call.args[len(first) :], other_keywords)
        pairs = [(pattern.func, call.func), (first, call.args[: len(first)])]
        for bound in self._match_all(pairs, binding):
            with_hole = replace(bound, holes=(*bound.holes, unnamed))
            yield from self.match(pattern.keywords, same_keywords, with_hole)

    def _match_name(
        self, kind: str, name: str, in_code: str, binding: _Binding
    ) -> Iterator[_Binding]:
        bound_name = binding.names.get((kind, name))
        bound_names = {value for (key, _), value in binding.names.items() if key == kind}
        if bound_name is not None:
            if bound_name == in_code:
                yield binding
        elif in_code not in bound_names and (
            name == in_code or self._may_differ(kind, name, in_code)
        ):
            yield replace(binding, names={**binding.names, (kind, name): in_code})

    def _may_differ(self, kind: str, name: str, in_code: str) -> bool:
        if kind == "private":
            return self._freedom.private and is_private(in_code)
        if kind != "name" or not self._freedom.local or self._function is None:
            return False
        return in_code in _variables(self._function) and name not in self._global_names


def _is_hole(node: Any) -> bool:
    return isinstance(node, ast.Name) and node.id == _HOLE


def _is_hole_statement(node: Any) -> bool:
    return isinstance(node, ast.Expr) and _is_hole(node.value)


class _Holes(ast.NodeTransformer):
    """Marks every `...` of a pattern except in an index."""

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        return ast.Name(_HOLE, ast.Load()) if node.value is Ellipsis else node

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        node.value = self.visit(node.value)
        return node


def _parsed(text: str, key: str) -> list[ast.stmt]:
    try:
        tree = ast.parse(text)
    except SyntaxError as error:
        raise StaleEdit(f"`{key}` must be Python, got {error}: {text.strip()}") from None
    statements: list[ast.stmt] = _Holes().visit(tree).body
    return statements


class _Place(NamedTuple):
    """A node of a tree, the node that holds it, and the outermost function around it."""

    node: ast.AST
    owner: ast.AST | None
    function: ast.AST | None


class _Source:
    """A parsed file: its lines, its global names, and the places of its nodes."""

    def __init__(self, text: str) -> None:
        self.lines = text.split("\n")
        self.tree = ast.parse(text)
        self.global_names = _BUILTIN_NAMES | _global_names(self.tree)
        self.whole = _Place(self.tree, None, None)
        self._places: dict[ast.AST, list[_Place]] = {}

    def places_in(self, scope: _Place) -> Sequence[_Place]:
        """Return the places of a scope and of all nodes below it."""
        if scope.node not in self._places:
            self._places[scope.node] = [*_places(scope)]
        return self._places[scope.node]

    def text_with(self, statement: ast.stmt) -> str:
        """Return the text with a statement of the module as it is now in the tree."""
        numbers = _lines_of(statement)
        lines = list(self.lines)
        lines[numbers.start - 1 : numbers.stop - 1] = [ast.unparse(statement)]
        return "\n".join(lines)


_parsed_source = lru_cache(maxsize=8)(_Source)
"""The last sources: many faults change the same file."""


def _plant_python(edit: Edit, source_text: str) -> str:
    source = _parsed_source(source_text)
    pattern = _parsed(edit.find, "find")
    replacement = _parsed(edit.replace, "replace")
    _check_private_names(pattern, replacement)
    scopes = _scopes(source, edit.scope)
    candidates = _candidates(source, scopes, pattern, replacement)
    for freedom in _FREEDOMS:
        matches = _matches(source, candidates, pattern, freedom)
        if len(matches) > 1:
            lines = ", ".join(map(str, sorted(match.line for match in matches)))
            where = f" of {edit.scope}" if edit.scope else ""
            raise StaleEdit(f"matches in lines {lines}{where}, must match once: {edit.find}")
        if matches:
            return _text_with_replacement(source, matches[0], replacement)
    raise StaleEdit(_nothing_matches(edit, pattern, [scope.node for scope in scopes]))


@dataclass(frozen=True)
class _Candidate:
    """Code that a pattern can match: an expression, or statements of a block from `start` on."""

    owner: ast.AST
    function: ast.AST | None
    expression: ast.expr | None = None
    block: list[ast.stmt] = field(default_factory=list)
    start: int = 0


def _candidates(
    source: _Source,
    scopes: Sequence[_Place],
    pattern: list[ast.stmt],
    replacement: list[ast.stmt],
) -> list[_Candidate]:
    """Return the code in scopes that begins with a node of the same type as a pattern."""
    first = pattern[0]
    if _is_expression(pattern) and _is_expression(replacement):
        assert isinstance(first, ast.Expr)
        wanted = ast.expr if _is_hole(first.value) else type(first.value)
        candidate_at = _expression_at
    else:
        wanted = ast.stmt if _is_hole_statement(first) else type(first)
        candidate_at = _statements_at
    return [
        candidate_at(place)
        for scope in scopes
        for place in source.places_in(scope)
        if isinstance(place.node, wanted) and place.owner is not None
    ]


def _expression_at(place: _Place) -> _Candidate:
    assert isinstance(place.node, ast.expr)
    assert place.owner is not None
    return _Candidate(place.owner, place.function, expression=place.node)


def _statements_at(place: _Place) -> _Candidate:
    assert place.owner is not None
    for name in _BLOCKS:
        block = getattr(place.owner, name, None)
        if isinstance(block, list) and place.node in block:
            start = block.index(place.node)
            return _Candidate(place.owner, place.function, block=block, start=start)
    raise AssertionError(f"{ast.dump(place.node)} is not in a block of {ast.dump(place.owner)}")


@dataclass(frozen=True)
class _Match:
    """A candidate that a pattern matches; of a block, `count` statements."""

    binding: _Binding
    candidate: _Candidate
    count: int = 0

    @property
    def line(self) -> int:
        """The first line of the matched code."""
        if self.candidate.expression is not None:
            return self.candidate.expression.lineno
        return self.candidate.block[self.candidate.start].lineno


def _matches(
    source: _Source, candidates: Sequence[_Candidate], pattern: list[ast.stmt], freedom: _Freedom
) -> list[_Match]:
    matches: list[_Match] = []
    for candidate in candidates:
        matcher = _Matcher(freedom, candidate.function, source.global_names)
        matches += _matches_of(candidate, pattern, matcher)
    return matches


def _check_private_names(pattern: list[ast.stmt], replacement: list[ast.stmt]) -> None:
    """Reject private names that could not follow a renaming."""
    missing = sorted(_private_names(replacement) - _private_names(pattern))
    if missing:
        names = ", ".join(missing)
        raise StaleEdit(f"private names in `replace` must be in `find`, too, got {names}")


def _below(nodes: Sequence[ast.AST]) -> Iterator[ast.AST]:
    for node in nodes:
        yield from ast.walk(node)


def _private_names(statements: Sequence[ast.AST]) -> set[str]:
    names = set()
    for node in _below(statements):
        for _, value in ast.iter_fields(node):
            if isinstance(value, str) and not isinstance(node, ast.Constant) and is_private(value):
                names.add(value)
    return names


def _scopes(source: _Source, dotted: str) -> list[_Place]:
    """Return the definitions of a dotted name."""
    scopes = [source.whole]
    for name in filter(None, dotted.split(".")):
        below = []
        existing = []
        for scope in scopes:
            for place in source.places_in(scope):
                if isinstance(place.node, _DEFINITIONS) and place.node is not scope.node:
                    existing.append(place.node.name)
                    if place.node.name == name:
                        below.append(place)
        if not below:
            similar = get_close_matches(name, existing, n=1)
            hint = f"; did you mean {similar[0]}?" if similar else ""
            raise StaleEdit(f"has no class or function {name} (of: {dotted}){hint}")
        scopes = below
    return scopes


def _places(scope: _Place) -> Iterator[_Place]:
    """Yield a place and those of all nodes below it."""
    queue = [scope]
    while queue:
        node, owner, function = queue.pop()
        if function is None and isinstance(node, _FUNCTIONS):
            function = node
        yield _Place(node, owner, function)
        queue += [_Place(child, node, function) for child in ast.iter_child_nodes(node)]


@lru_cache(maxsize=256)
def _variables(node: ast.AST) -> frozenset[str]:
    """Return the names of variables and parameters in code."""
    names = set()
    for below in ast.walk(node):
        if isinstance(below, ast.Name) and not isinstance(below.ctx, ast.Load):
            names.add(below.id)
        elif isinstance(below, ast.arg):
            names.add(below.arg)
        elif isinstance(below, ast.ExceptHandler | ast.MatchAs) and below.name:
            names.add(below.name)
    return frozenset(names)


def _global_names(tree: ast.Module) -> frozenset[str]:
    """Return the names that a module defines or imports."""
    names: set[str] = set()
    for statement in tree.body:
        if isinstance(statement, _DEFINITIONS):
            names.add(statement.name)
        elif isinstance(statement, ast.Import | ast.ImportFrom):
            names.update(alias.asname or alias.name for alias in statement.names)
        else:
            names.update(_variables(statement))
    return frozenset(names)


def _is_expression(statements: list[ast.stmt]) -> bool:
    return len(statements) == 1 and isinstance(statements[0], ast.Expr)


def _matches_of(
    candidate: _Candidate, pattern: list[ast.stmt], matcher: _Matcher
) -> Iterator[_Match]:
    """Yield each way in which a pattern fits a candidate."""
    if candidate.expression is not None:
        assert isinstance(pattern[0], ast.Expr)
        for bound in matcher.match(pattern[0].value, candidate.expression, _Binding()):
            yield _Match(bound, candidate)
        return
    statements = candidate.block[candidate.start :]
    for bound, count in matcher.match_start(pattern, statements, _Binding()):
        yield _Match(bound, candidate, count)


def _text_with_replacement(source: _Source, match: _Match, replacement: list[ast.stmt]) -> str:
    """Return a source's text with matched code replaced; its tree stays as it is."""
    filled = _Filling(match.binding).fill(replacement)
    owner = match.candidate.owner
    [top_level] = [node for node in source.tree.body if match.line in _lines_of(node)]
    with _restored_fields(owner):
        _put(match, filled)
        if owner is source.tree:
            return ast.unparse(source.tree) + "\n"
        return source.text_with(top_level)


def _lines_of(statement: ast.stmt) -> range:
    decorators = getattr(statement, "decorator_list", [])
    first_line = min(node.lineno for node in [statement, *decorators])
    return range(first_line, (statement.end_lineno or first_line) + 1)


@contextlib.contextmanager
def _restored_fields(node: ast.AST) -> Iterator[None]:
    """Give a node its present fields back, and each of its lists the present items."""
    fields = dict(ast.iter_fields(node))
    items = {name: [*value] for name, value in fields.items() if isinstance(value, list)}
    try:
        yield
    finally:
        for name, value in fields.items():
            setattr(node, name, value)
        for name, values in items.items():
            fields[name][:] = values


def _put(match: _Match, filled: list[ast.stmt]) -> None:
    """Put a filled replacement in place of matched code."""
    owner, expression = match.candidate.owner, match.candidate.expression
    if expression is None:
        block, start = match.candidate.block, match.candidate.start
        block[start : start + match.count] = filled
        if not block:
            block.append(ast.Pass())
        return
    assert isinstance(filled[0], ast.Expr)
    for name, value in ast.iter_fields(owner):
        if value is expression:
            setattr(owner, name, filled[0].value)
        elif isinstance(value, list):
            value[:] = [filled[0].value if item is expression else item for item in value]


class _Filling(ast.NodeTransformer):
    """Gives a replacement the names and the code that its pattern matched."""

    def __init__(self, binding: _Binding) -> None:
        self._names = binding.names
        self._holes = list(binding.holes)

    def fill(self, replacement: list[ast.stmt]) -> list[ast.stmt]:
        module = self.visit(ast.Module(deepcopy(replacement), []))
        statements: list[ast.stmt] = module.body
        return statements

    def _next_hole(self) -> Any:
        if not self._holes:
            raise StaleEdit("`replace` must not have more `...` than `find`")
        return self._holes.pop(0)

    def visit_Expr(self, node: ast.Expr) -> Any:
        return self._next_hole() if _is_hole(node.value) else self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> ast.AST:
        has_hole = any(_is_hole(argument) for argument in node.args)
        if not has_hole:
            return self.generic_visit(node)
        node.func = self.visit(node.func)
        first = [self.visit(argument) for argument in node.args if not _is_hole(argument)]
        other_arguments, other_keywords = self._next_hole()
        node.args = [*first, *other_arguments]
        named = [self.visit(keyword) for keyword in node.keywords]
        node.keywords = [*named, *other_keywords]
        return node

    def visit(self, node: ast.AST) -> Any:
        if _is_hole(node):
            return self._next_hole()
        for name, value in ast.iter_fields(node):
            if isinstance(value, str) and not isinstance(node, ast.Constant):
                setattr(node, name, self._names.get((_kind(node, value), value), value))
        return super().visit(node)


def _nothing_matches(edit: Edit, pattern: list[ast.stmt], scopes: Sequence[ast.AST]) -> str:
    """Describe what looks most like a pattern that matches nothing."""
    where = f" in {edit.scope}" if edit.scope else ""
    lines = [f"matches nothing{where}, must match once: {edit.find}"]
    wanted = ast.unparse(pattern[0]).partition("\n")[0]
    texts = {}
    for node in _below(scopes):
        if isinstance(node, ast.stmt | ast.expr):
            texts[ast.unparse(node).partition("\n")[0]] = node.lineno
    similar = get_close_matches(wanted, texts, n=1)
    if similar:
        lines.append(f"nearest, in line {texts[similar[0]]}: {similar[0]}")
    return "\n    ".join(lines)


_TOKEN = re.compile(
    r"""
    (?P<blank> \s+ | //[^\n]* | /\*.*?\*/ )
    | "(?:\\.|[^"\\])*" | '(?:\\.|[^'\\])*' | `(?:\\.|[^`\\])*`
    | [A-Za-z_$][\w$]* | \d[\w.]* | .
    """,
    re.VERBOSE | re.DOTALL,
)


class _Token(NamedTuple):
    text: str
    start: int
    end: int


def tokens(source: str) -> list[_Token]:
    """Return the tokens of C or JavaScript without whitespace and comments."""
    matches = [match for match in _TOKEN.finditer(source) if match["blank"] is None]
    return [_Token(match[0], match.start(), match.end()) for match in matches]


def _plant_tokens(edit: Edit, source: str) -> str:
    code = tokens(source)
    texts = [token.text for token in code]
    pattern = [token.text for token in tokens(edit.find)]
    first, last = _function_span(edit, texts) if edit.scope else (0, len(code))
    starts = range(first, last - len(pattern) + 1)
    matches = [start for start in starts if texts[start : start + len(pattern)] == pattern]
    if len(matches) != 1:
        lines = [source.count("\n", 0, code[start].start) + 1 for start in matches]
        where = f" of {edit.scope}" if edit.scope else ""
        count = f"matches in lines {', '.join(map(str, lines))}" if lines else "matches nothing"
        similar = get_close_matches(edit.find, source.splitlines(), n=1, cutoff=0.4)
        hint = f"\n    nearest: {similar[0].strip()}" if similar and not lines else ""
        raise StaleEdit(f"{count}{where}, must match once: {edit.find}{hint}")
    begin = code[matches[0]].start
    end = code[matches[0] + len(pattern) - 1].end
    return source[:begin] + edit.replace.strip() + source[end:]


def _function_span(edit: Edit, texts: Sequence[str]) -> tuple[int, int]:
    """Return the first token of a function's definition, and the one after its last."""
    for index, text in enumerate(texts):
        if text != edit.scope or texts[index + 1 : index + 2] != ["("]:
            continue
        body = _closing(texts, index + 1) + 1
        if texts[body : body + 1] == ["{"]:
            return index, _closing(texts, body) + 1
    raise StaleEdit(f"has no function {edit.scope}")


def _closing(texts: Sequence[str], opening: int) -> int:
    """Return the index of the bracket that closes another one."""
    depth = 0
    for index in range(opening, len(texts)):
        depth += (texts[index] in "([{") - (texts[index] in ")]}")
        if depth == 0:
            return index
    return len(texts)
