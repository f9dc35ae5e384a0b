"""Where a result may be written: in a folder that is there, and over nothing but its own kind."""

from pathlib import Path

from model.errors import InputError


def check_replaceable(path: Path, *, is_own: bool, what: str) -> None:
    """Raise InputError where a file of another kind stands; it is somebody's work, a rig's say.

    is_own: whether the file there, if there is one, is of the kind that will be written; what: the
    name of that kind.
    """
    if path.is_file() and not is_own:
        raise InputError(
            f"--output {path}: a file is there that is no {what}; it is left alone. Give another "
            "name, or remove it first"
        )


def check_ending(path: Path, *endings: str, what: str) -> None:
    """Raise InputError for a name that ends in none of what such a file may."""
    if path.suffix.lower() not in endings:
        ending = endings[0]
        better = path / f"new{ending}" if path.is_dir() else path.with_suffix(ending)
        raise InputError(f"{path}: {what} ends in {ending}; try {better}")


def check_place(path: Path, *, example: str) -> None:
    """Raise InputError where no file can be written: at a folder, or in one that is not there.

    To be asked before whatever takes long.
    """
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise InputError(
            f"--output {path}: give the name of a file in a folder that exists, e.g. {example}"
        )


def begins_with(path: Path, start: bytes) -> bool:
    """Whether a file is there that begins so, or an empty one."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(len(start)) in (start, b"")
