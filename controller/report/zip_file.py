"""A report as a file to send."""

import os
import zipfile
from pathlib import Path

from controller.report.collect import Report
from model.errors import InputError


def write_zip(path: Path, report: Report) -> None:
    """Write a new file, for its owner only, whole or not at all.

    Raises InputError where there is one already, OSError.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError as error:
        raise InputError(f"{path}: there is such a file; name another with -o") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
    try:
        with (
            os.fdopen(descriptor, "wb") as stream,
            zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive,
        ):
            for name, text in report.files.items():
                archive.writestr(name, text)
            archive.writestr("missing.txt", "".join(f"{what}\n" for what in report.missing))
    except BaseException:
        path.unlink(missing_ok=True)
        raise
