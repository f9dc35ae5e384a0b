"""Whether a command prints what a page shows: words as they are, numbers about.

`...` stands for whatever a line holds there, and on a line of its own for any lines. A number may
be off by one in its last printed digit, or by two parts in a hundred, whichever is more.
"""

import re

_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w]|\.\d)")
_PARTS = re.compile(rf"(\.\.\.|{_NUMBER.pattern})")
_SHARE = 0.02


def difference(shown: str, printed: str) -> str | None:
    """The first shown line that is not printed where it should be; None: all as shown."""
    wanted = [line.rstrip() for line in shown.strip("\n").splitlines()]
    lines = [line.rstrip() for line in printed.strip("\n").splitlines()]
    at, gap = 0, False
    for number, want in enumerate(wanted):
        if want.strip() == "...":
            gap = True
            continue
        ends = range(at, len(lines)) if gap else range(at, min(at + 1, len(lines)))
        found = next((place for place in ends if is_line(want, lines[place])), None)
        if found is None:
            instead = lines[at] if at < len(lines) else "the end"
            return f"line {number + 1} shown: {want!r}; printed there: {instead!r}"
        at, gap = found + 1, False
    return None if gap or at == len(lines) else f"printed beyond what is shown: {lines[at]!r}"


def is_line(shown: str, printed: str) -> bool:
    """Whether one line is as shown."""
    parts = _PARTS.split(" ".join(shown.split()))
    pattern = "".join(
        r"(.*)" if part == "..." else f"({_NUMBER.pattern})" if index % 2 else re.escape(part)
        for index, part in enumerate(parts)
    )
    found = re.fullmatch(pattern, " ".join(printed.split()))
    return found is not None and all(
        part == "..." or _is_about(part, there)
        for part, there in zip(parts[1::2], found.groups(), strict=True)
    )


def _is_about(shown: str, printed: str) -> bool:
    mantissa, _, exponent = shown.partition("e")
    last_digit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    if "." not in shown and not exponent:
        last_digit = 0.0 if abs(int(shown)) < 10 else 1.0  # counts are counts
    allowed = max(1.001 * last_digit, _SHARE * abs(float(shown)))
    return abs(float(shown) - float(printed)) <= allowed
