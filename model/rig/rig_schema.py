"""JSON schema of rig files: complete rigs, and fitted rigs that change a base."""

from typing import Any

from model.rig.sections import RigSection

_REQUIREMENTS = ("required", "oneOf", "dependentRequired", "minProperties")
"""Keywords that require keys; a fitted rig may leave out every key of its base."""


def rig_schema() -> dict[str, Any]:
    """Return the JSON schema of a complete rig, and of a fitted one with changes to its base."""
    complete = RigSection.model_json_schema()
    fitted = _without_requirements(complete)
    fitted["properties"] |= {"base": {"type": "string"}, "base_fingerprint": {"type": "string"}}
    fitted["properties"]["standard_errors"] = {
        "type": "object",
        "description": "standard errors of values, by key",
    }
    definitions = complete.pop("$defs") | {"fitted": {"$defs": fitted.pop("$defs")}}
    return {
        "$defs": definitions,
        "type": "object",
        "if": {"required": ["base"]},
        "then": fitted,
        "else": complete,
    }


def _without_requirements(schema: Any) -> Any:
    """Return a JSON schema without required keys; null removes a key of the base."""
    if isinstance(schema, list):
        return [_without_requirements(entry) for entry in schema]
    if not isinstance(schema, dict):
        return schema
    partial: dict[str, Any] = {}
    for keyword, value in schema.items():
        if keyword not in _REQUIREMENTS:
            partial[keyword] = _without_requirements(value)
    for key, value in partial.get("properties", {}).items():
        partial["properties"][key] = {"anyOf": [value, {"type": "null"}]}
    if "$ref" in partial:
        partial["$ref"] = partial["$ref"].replace("#/$defs", "#/$defs/fitted/$defs", 1)
    return partial
