"""Columns of numbers as a pandas DataFrame."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from model.errors import InputError

if TYPE_CHECKING:
    from model.files.csv_file import Columns


def as_frame(columns: "Columns") -> Any:
    """A pandas DataFrame of columns; raises InputError where pandas is not installed."""
    try:
        pandas = import_module("pandas")
    except ModuleNotFoundError as error:
        raise InputError("pandas must be installed for to_frame: pip install pandas") from error
    return pandas.DataFrame(dict(columns))
