"""Interfaces for formats of content: entry points `era_haptics.content_formats`.

`read_content` is for trying one.
"""

from controller.content.format import ContentFormat
from controller.content.formats import read_content
from controller.content.pattern import Pattern, Transient
from controller.content.points import pattern_of_points
from model.errors import InputError

__all__ = [
    "ContentFormat",
    "InputError",
    "Pattern",
    "Transient",
    "pattern_of_points",
    "read_content",
]
