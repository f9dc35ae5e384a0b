"""The table of docs/reference/metrics.md: every metric that the gateway can serve.

The metrics are generated from a status in which every value is set.
"""

import types
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from prometheus_client.parser import text_string_to_metric_families

from controller.api.methods import StatusResult
from controller.api.schema import ApiMessage
from controller.gateway.metrics import exposition


def metrics() -> str:
    """Return a table with the name, type, labels and meaning of each metric."""
    text = exposition(_known(StatusResult)).decode()
    rows = ["| metric | kind | labels | |", "|---|---|---|---|"]
    for family in text_string_to_metric_families(text):
        name = family.name + ("_total" if family.type == "counter" else "")
        labels = sorted({label for sample in family.samples for label in sample.labels} - {"le"})
        shown = "".join(f" {', '.join(f'`{label}`' for label in labels)}" if labels else "")
        rows.append(f"| `{name}` | {family.type} |{shown} | {family.documentation} |")
    return "\n".join(rows)


def _known(annotation: Any) -> Any:
    """Return a value of a type: the most informative alternative, and one entry of a list."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin in (Annotated, Literal):
        return arguments[0] if origin is Literal else _known(arguments[0])
    if origin in (Union, types.UnionType):
        return _known(next(each for each in arguments if each is not type(None)))
    if origin is list:
        return [_known(arguments[0])]
    if origin is tuple:
        return (*map(_known, arguments),)
    if origin is dict:
        return {"": _known(arguments[1])}
    if isinstance(annotation, type) and issubclass(annotation, ApiMessage):
        fields = annotation.model_fields.items()
        return annotation.model_construct(
            None, **{name: _known(field.rebuild_annotation()) for name, field in fields}
        )
    return annotation() if annotation in (str, int, float, bool) else None
