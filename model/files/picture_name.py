"""Names under which pictures are written."""

from pathlib import Path

from model.errors import InputError
from model.files.replacing import check_place

PICTURE_ENDINGS = (".png", ".svg", ".pdf")


def check_picture_name(path: Path) -> None:
    """Raise InputError for an ending that is not in PICTURE_ENDINGS."""
    if path.suffix.lower() not in PICTURE_ENDINGS:
        raise InputError(
            f"{path}: a picture's name must end in {', '.join(PICTURE_ENDINGS[:-1])} or "
            f"{PICTURE_ENDINGS[-1]}, for instance {path.stem}.png"
        )


def check_picture(path: Path) -> None:
    """Raise InputError where no picture can be written; to be asked before what takes long."""
    check_picture_name(path)
    check_place(path, example="map.png")
