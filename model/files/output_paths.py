"""Check output paths: suffix, folder, and whether a file can be replaced."""

from pathlib import Path

from model.errors import InputError

PICTURE_ENDINGS = (".png", ".svg", ".pdf")


def check_replaceable(path: Path, *, is_own: bool, what: str) -> None:
    """Raise InputError if a file of another kind would be replaced.

    is_own: whether an existing file is of the kind that will be written; what: name of that kind.
    """
    if path.is_file() and not is_own:
        raise InputError(
            f"--output {path}: existing file must be a {what}; choose another name or remove it"
        )


def check_ending(path: Path, *endings: str, what: str) -> None:
    """Raise InputError for a name without one of the endings."""
    if path.suffix.lower() not in endings:
        ending = endings[0]
        better = path / f"new{ending}" if path.is_dir() else path.with_suffix(ending)
        raise InputError(f"{path}: name of {what} must end in {ending}; try {better}")


def check_place(path: Path, *, example: str) -> None:
    """Raise InputError for a path that is a folder or in a missing one; call before long work."""
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise InputError(
            f"--output {path}: must be a file in an existing folder, for instance {example}"
        )


def begins_with(path: Path, start: bytes) -> bool:
    """Return whether a file exists that is empty or begins with these bytes."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(len(start)) in (start, b"")


def check_picture_name(path: Path, *, instead: str = "") -> None:
    """Raise InputError for an ending that is not in PICTURE_ENDINGS.

    instead: other endings that the caller accepts, in words.
    """
    if path.suffix.lower() not in PICTURE_ENDINGS:
        raise InputError(
            f"{path}: a picture's name must end in {', '.join(PICTURE_ENDINGS[:-1])} or "
            f"{PICTURE_ENDINGS[-1]}{instead}, for instance {path.stem}.png"
        )


def check_picture(path: Path, *, instead: str = "") -> None:
    """Raise InputError for a path to which no picture can be written; call before long work."""
    check_picture_name(path, instead=instead)
    check_place(path, example="map.png")
