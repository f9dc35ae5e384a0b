"""Numbers with their nouns: `1 cell`, `2 cells`."""


def counted(number: int, thing: str, *, plural: str | None = None) -> str:
    """Format a number with its noun; plural: where it is not the noun with an s."""
    return f"{number} {thing if number == 1 else plural or f'{thing}s'}"
