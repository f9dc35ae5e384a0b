"""What may stand where a result is written: nothing, or a result of the same kind."""

from pathlib import Path

from model.errors import InputError


def check_replaceable(path: Path, *, begins: bytes, what: str) -> None:
    """Raise InputError where a file of another kind stands; it is somebody's work, a rig's say.

    begins: the first bytes of every file of this kind; what: its name.
    """
    if not path.is_file():
        return
    with path.open("rb") as stream:
        start = stream.read(len(begins))
    if start and start != begins:
        raise InputError(
            f"--output {path}: a file is there that is no {what}; it is left alone. Give another "
            "name, or remove it first"
        )
