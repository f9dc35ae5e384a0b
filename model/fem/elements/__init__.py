"""Plate elements, a file each."""

from model.errors import InputError
from model.fem.elements.element import DOF_PER_NODE, Element
from model.fem.elements.lagrange import Q3, Q4, Q5
from model.fem.elements.mitc4 import MITC4

__all__ = ["DOF_PER_NODE", "ELEMENTS", "MITC4", "Q5", "Element", "element_of"]

ELEMENTS = {element.name: element for element in (MITC4, Q3, Q4, Q5)}
"""All of them, by name."""


def element_of(name: str) -> Element:
    """Look up an element; raises InputError."""
    if name not in ELEMENTS:
        raise InputError(f"element must be one of {', '.join(ELEMENTS)}, got {name[:40]!r}")
    return ELEMENTS[name]
