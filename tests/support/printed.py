"""Whether a command prints the facts that a page shows; the words around them are free.

Facts are numbers and what holds a digit, an underscore, a slash, a dot within, or two capitals:
names of states, files and addresses. `...` stands for any of them within a line, and on a line of
its own for any lines. A number may be off by one in its last printed digit, or by two parts in a
hundred, whichever is more. Lines without facts are not compared.
"""

import re
from collections.abc import Sequence
from functools import cache

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_FACT = re.compile(r"\d|_|/|\w\.\w|[A-Z]{2}")
GAP = "..."
_WORDS = re.compile(r"ERAs?|JSON|YAML|SL")
_PUNCTUATION = ",;:()[]{}'\"`"
_SHARE = 0.02


def difference(shown: str, printed: str) -> str | None:
    """Return the first shown line whose facts are not printed where they should be, else None."""
    wanted = [_facts(line) for line in shown.splitlines()]
    lines = [facts for line in printed.splitlines() if (facts := _facts(line))]
    if not any(wanted):
        enough = len(printed.splitlines()) >= len(wanted)
        return None if enough else f"{len(wanted)} lines shown; printed: {printed!r}"
    reached = (0, 0)

    @cache
    def fits(number: int, at: int) -> bool:
        """Whether the shown lines from this one on are the printed ones from there on."""
        nonlocal reached
        reached = max(reached, (number, at))
        if number == len(wanted):
            return at == len(lines)
        if not wanted[number]:
            return fits(number + 1, at)
        if set(wanted[number]) == {GAP}:
            return any(fits(number + 1, later) for later in range(at, len(lines) + 1))
        return at < len(lines) and _match(wanted[number], lines[at]) and fits(number + 1, at + 1)

    if fits(0, 0):
        return None
    number, at = reached
    instead = " ".join(lines[at]) if at < len(lines) else "the end"
    if number == len(wanted):
        return f"printed beyond what is shown: {instead}"
    return f"line {number + 1} shown: {shown.splitlines()[number]!r}; printed there: {instead!r}"


def _match(shown: Sequence[str], printed: Sequence[str]) -> bool:
    """Whether the facts of a printed line are those of the shown one."""
    if not shown:
        return not printed
    first, *rest = shown
    if first == GAP:
        return any(_match(rest, printed[at:]) for at in range(len(printed) + 1))
    return bool(printed) and _is_same(first, printed[0]) and _match(rest, printed[1:])


def _is_same(shown: str, printed: str) -> bool:
    if _NUMBER.fullmatch(shown) and _NUMBER.fullmatch(printed):
        return _is_about(shown, printed)
    return re.fullmatch(".*".join(map(re.escape, shown.split(GAP))), printed) is not None


def _facts(line: str) -> list[str]:
    tokens = (token.strip(_PUNCTUATION) for token in line.split())
    cut = [token if token.endswith(GAP) else token.removesuffix(".") for token in tokens]
    known = [GAP if GAP in token and not _is_fact(token) else token for token in cut]
    return [token for token in known if token == GAP or _is_fact(token)]


def _is_fact(token: str) -> bool:
    words = token.replace(GAP, " ")
    return _FACT.search(words) is not None and not _WORDS.fullmatch(token)


def _is_about(shown: str, printed: str) -> bool:
    mantissa, _, exponent = shown.partition("e")
    last_digit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    if "." not in shown and not exponent:
        last_digit = 0.0 if abs(int(shown)) < 10 else 1.0  # counts are counts
    allowed = max(1.001 * last_digit, _SHARE * abs(float(shown)))
    return abs(float(shown) - float(printed)) <= allowed
