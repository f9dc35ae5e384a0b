"""The reference in docs/reference/api.md: methods, topics, types and errors of the API."""

from collections.abc import Iterable, Iterator
from typing import Any

from controller.api.jsonrpc import ERROR_MEANINGS
from controller.api.methods import METHODS, TOPICS, EventParams, Method
from controller.api.schema import ApiMessage
from controller.api.summaries import SUMMARIES
from message_types import Models, Notation, each_model


def api_reference() -> str:
    """Return all lists, as Markdown."""
    models: Models = {}
    lines = [
        "### Methods",
        "",
        "→ parameters, ← results. For a method without parameters or results, the object is empty "
        "(`{}`).",
    ]
    for name, method in METHODS.items():
        rows = [*_rows("→ ", method.params, models), *_rows("← ", method.result, models)]
        lines += ["", f"#### {name}", "", " ".join([SUMMARIES[name], *_notes(method)]), "", *rows]
    lines += ["", "### Topics", "", "The parameters of every `event` notification, and its `data`:"]
    lines += ["", *_rows("", EventParams, models)]
    for topic, entry in TOPICS.items():
        lines += [f"- **{topic}**: {entry.summary}"]
        lines += [f"  {row}" for row in _data(entry.data, models)]
    lines += ["", "### Types"]
    for name, model in each_model(models):
        lines += ["", f"#### {name}", "", _summary(model), "", *_rows("", model, models)]
    lines += ["", "### Errors", "", "| code | name | meaning |", "|---|---|---|"]
    lines += [
        f"| {code.value} | {code.name} | {meaning} |" for code, meaning in ERROR_MEANINGS.items()
    ]
    return "\n".join(lines) + "\n"


def _notes(method: Method) -> Iterator[str]:
    """Yield who may call a method, and how its requests are handled."""
    lease = method.params.model_fields.get("lease")
    if lease is not None and lease.is_required():
        yield "Needs the current lease."
    if method.in_reserve:
        yield "Served to clients in reserve, too."
    if method.needs_reply:
        yield "Needs an `id`."
    if not method.is_repeated:
        yield "The Python clients do not repeat it if the reply is lost."
    if not method.over_http:
        yield "Needs a persistent connection; not available over HTTP."


def _rows(prefix: str, model: type[ApiMessage], models: Models) -> Iterator[str]:
    """Yield a row for each field; add the models of the fields to `models`."""
    descriptions = model.descriptions()
    for name, field in model.model_fields.items():
        kind = _TYPES.type_of(field.rebuild_annotation(), models)
        optional = "" if field.is_required() else "optional"
        if prefix == "→ " and isinstance(field.default, float):
            optional += f", by default {field.default:g}"
        notes = "; ".join(part for part in (descriptions.get(name), optional) if part)
        yield f"- {prefix}`{name}` ({kind}){notes and f': {notes}'}"


def _data(model: type[ApiMessage], models: Models) -> Iterator[str]:
    """Yield the rows of a topic; fields that `status` also returns share a row."""
    status = set(_rows("", METHODS["status"].result, models))
    rows = list(_rows("", model, models))
    same = [row.split(" (")[0].removeprefix("- ") for row in rows if row in status]
    if len(same) > 1:
        yield f"- {', '.join(same)}: see [status](#status)"
    yield from (row for row in rows if len(same) < 2 or row not in status)


_SIGNS = ("ge", "le", "lt", "min_length", "max_length")


def _limits(metadata: Iterable[object]) -> dict[str, str]:
    """Return the limits in the metadata of an annotated type, by sign."""
    limits: dict[str, str] = {}
    for part in metadata:
        for bound in getattr(part, "metadata", [part]):
            for sign in _SIGNS:
                value = getattr(bound, sign, None)
                if value is not None:
                    limits[sign] = f"{value:g}" if isinstance(value, float) else str(value)
    return limits


def _bounded(metadata: tuple[object, ...]) -> str:
    limits = _limits(metadata)
    below = f" and below {limits['lt']}" if "lt" in limits else ""
    return (
        _range(limits.get("ge"), limits.get("le"), "of", "from")
        + below
        + _range(limits.get("min_length"), limits.get("max_length"), "of length", "of length")
    )


def _range(lowest: str | None, highest: str | None, alone: str, both: str) -> str:
    """Return limits as text, empty without any; alone, both: words before one limit, or two."""
    if lowest is None and highest is None:
        return ""
    if lowest is None:
        return f" {alone} at most {highest}"
    if highest is None:
        return f" {alone} at least {lowest}"
    return f" {both} {lowest}" if lowest == highest else f" {both} {lowest} to {highest}"


_TYPES = Notation(
    plain={
        str: "string",
        int: "integer",
        float: "number",
        bool: "boolean",
        type(None): "null",
        Any: "any value",
        object: "any value",
    },
    union=" or ",
    literal="`{}`",
    literals=", ",
    items=", ",
    array="array of {}",
    mapping="object with values: {}",
    nested="({})",
    model=lambda name: f"[{name}](#{name.lower()})",
    bounds=_bounded,
)


def _summary(model: type[ApiMessage]) -> str:
    return " ".join((model.__doc__ or "").split())
