"""Interfaces for formats of content: entry points `era_haptics.content_formats`.

`read_content` is for trying one.
"""

from controller.content.formats import read_content
from controller.content.pattern import Pattern, Transient, pattern_of_points
from controller.content.reading import ContentFormat, ContentSection, Entries, read_json
from model.config.fields import Validation
from model.errors import InputError

__all__ = [
    "ContentFormat",
    "ContentSection",
    "Entries",
    "InputError",
    "Pattern",
    "Transient",
    "Validation",
    "pattern_of_points",
    "read_content",
    "read_json",
]
