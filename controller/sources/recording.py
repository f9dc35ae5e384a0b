"""Reading the text of a recorded touch stream."""

from pathlib import Path

from model.errors import InputError
from model.files.regular_file import regular_file

MAX_BYTES = 16 << 20  # 100 s of ten fingers at 100 Hz; of one finger a quarter of an hour
_MAX_LINE = 1 << 18  # bytes; a datagram of the largest size takes half of it


def recorded_lines(path: Path, *, what: str) -> list[str]:
    """Read the lines of a recording; what: its kind, for errors. Raises InputError.

    No operation is on more than a line, so that threads can alternate while it is read.
    """
    lines: list[str] = []
    left = MAX_BYTES
    try:
        with open(path, "rb", opener=regular_file) as stream:
            while line := stream.readline(_MAX_LINE):
                left -= len(line)
                if left < 0:
                    raise InputError(
                        f"{path}: must have at most {MAX_BYTES >> 20} MiB; record a shorter time"
                    )
                lines.append(line.decode("utf-8").removesuffix("\n").removesuffix("\r"))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check the path, which is relative to the "
            "working directory, and its permissions"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: must be {what}, got a binary file") from error
    return lines
