"""Types of the API's messages, in the notation of a page or of another language."""

import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from controller.api.schema import ApiMessage

Models = dict[str, type[ApiMessage]]


@dataclass(frozen=True)
class Notation:
    """A notation for types; formats contain `{}` for the inner type.

    plain: names of types that are not messages; union, literals, items: separators of alternatives,
    values and tuple members; nested: format of an array or object inside another; bounds: returns
    the text to append for the metadata of an annotated type.
    """

    plain: Mapping[Any, str]
    union: str
    literal: str
    literals: str
    items: str
    array: str
    mapping: str
    model: Callable[[str], str]
    nested: str = "{}"
    bounds: Callable[[tuple[object, ...]], str] = lambda metadata: ""

    def type_of(self, annotation: Any, models: Models) -> str:
        """Return the notation of a type; add the models that it contains to `models`."""
        origin, arguments = get_origin(annotation), get_args(annotation)
        if origin is Literal:
            return self.literals.join(map(self.literal.format, arguments))
        if isinstance(annotation, type) and issubclass(annotation, ApiMessage):
            models[annotation.__name__] = annotation
            return self.model(annotation.__name__)
        if origin is Annotated:
            return self.type_of(arguments[0], models) + self.bounds(arguments[1:])
        if origin in (list, dict):
            form = self.array if origin is list else self.mapping
            item = self.type_of(arguments[-1], models)
            return form.format(self.nested.format(item) if _is_nested(arguments[-1]) else item)
        if origin in (tuple, Union, types.UnionType):
            written = [self.type_of(argument, models) for argument in arguments]
            is_tuple = origin is tuple
            return f"[{self.items.join(written)}]" if is_tuple else self.union.join(written)
        return self.plain[annotation]


def _is_nested(annotation: Any) -> bool:
    """Return whether an array or object contains arrays or objects."""
    if get_origin(annotation) is Annotated:
        return _is_nested(get_args(annotation)[0])
    return get_origin(annotation) in (list, dict)


def each_model(models: Models) -> Iterator[tuple[str, type[ApiMessage]]]:
    """Yield each model once, including models that are added during the iteration."""
    shown: set[str] = set()
    while left := [name for name in models if name not in shown]:
        for name in left:
            shown.add(name)
            yield name, models[name]
