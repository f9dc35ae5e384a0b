"""Plate elements by name, those of plug-ins included.

An installed package adds one by an entry point of the group `era_haptics.elements` that leads to
an `Element` of that name; it must pass `model.fem.element_checks`.
"""

from operator import attrgetter

from model.errors import InputError
from model.fem.element_checks import matrices, nodes
from model.fem.elements import ELEMENTS, Element
from registry.plugins import Instance, PluginRegistry

_ELEMENTS: PluginRegistry[Element] = PluginRegistry(
    "element",
    "era_haptics.elements",
    Instance(Element),
    error=InputError,
    own=ELEMENTS,
    called=attrgetter("name"),
    problem=lambda element: nodes(element) or matrices(element),
)


def element_names() -> tuple[str, ...]:
    """Names of all elements, those of plug-ins included; no plug-in is loaded."""
    return _ELEMENTS.names()


def element_of(name: str) -> Element:
    """Look up an element; raises InputError with a suggestion."""
    return _ELEMENTS.find(name)
