"""Writes a report as a ZIP file."""

import os
import zipfile
from pathlib import Path

from controller.report.collect import Report
from model.errors import InputError


def write_zip(path: Path, report: Report) -> None:
    """Write a new file of mode 0600, completely or not at all.

    Raises InputError if it exists already or cannot be created, OSError if writing fails.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError as error:
        raise InputError(f"{path}: file exists already; choose another with -o") from error
    except OSError as error:
        raise InputError(f"{path}: cannot write: {error.strerror}") from error
    try:
        with (
            os.fdopen(descriptor, "wb") as stream,
            zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive,
        ):
            for name, text in report.files.items():
                archive.writestr(name, text)
            archive.writestr("missing.txt", "".join(f"{line}\n" for line in report.missing))
    except BaseException:
        path.unlink(missing_ok=True)
        raise
