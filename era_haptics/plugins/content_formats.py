"""Interfaces for content formats: entry points `era_haptics.content_formats`.

Use `read_content` to try a format.
"""

from controller.content.formats import read_content
from controller.content.pattern import Pattern, Transient
from controller.content.points import pattern_of_points
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
