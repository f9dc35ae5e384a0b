"""Configuration files with new values in them, and new ones."""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from io import StringIO
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.resolver import BaseResolver, VersionedResolver

from model.config.document import (
    ConfigError,
    ConfigProblem,
    Document,
    Value,
    parse_document,
    plain_value,
)


def edited_text(document: Document, change: Callable[[CommentedMap], None]) -> str:
    """The text of a document after a change of its data in place.

    change: sets, inserts or deletes keys of the mapping that it is called with. Comments, order
    and numbers as they are written stay, spaces within a line do not. Raises ConfigError if there
    are comments that cannot be kept.
    """
    yaml = YAML(typ="rt", pure=True)
    yaml.Resolver = _PlainResolver
    yaml.preserve_quotes = True
    # Room for new keys on the longest line, which would break elsewhere otherwise.
    yaml.width = max(map(len, document.text.splitlines())) + 100
    yaml.indent(**_indentation(document.text))
    stream = StringIO()
    with _refused_if_lossy(document):
        # Comments alone would keep their CR, and tabs between value and comment are refused.
        data = yaml.load(document.text.replace("\r\n", "\n").replace("\t", " "))
    change(data)
    with _refused_if_lossy(document):
        yaml.dump(data, stream)
        if parse_document(document.source, stream.getvalue()).data != data:
            raise AssertionError
    return stream.getvalue()


class _PlainResolver(VersionedResolver):
    """Takes for numbers and words what reading takes for them."""

    processing_version = (1, 2)  # ignores %YAML directives

    def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
        """The tag of a node by its kind and text."""
        if kind is ScalarNode and isinstance(plain_value(value), str):
            return BaseResolver.DEFAULT_SCALAR_TAG
        return super().resolve(kind, value, implicit)


_BLOCK_MAPPING = re.compile(r"^( +)[^\s#-]", re.MULTILINE)
_BLOCK_SEQUENCE = re.compile(r"^( *)[^\s#-][^\n]*:[ ]*(?:#[^\n]*)?\n( *)- ", re.MULTILINE)


def _indentation(text: str) -> dict[str, int]:
    """How the first blocks of a text are indented, as ruamel.yaml wants it."""
    mapping = _BLOCK_MAPPING.search(text)
    sequence = _BLOCK_SEQUENCE.search(text)
    offset = len(sequence[2]) - len(sequence[1]) if sequence else 2
    return {"mapping": len(mapping[1]) if mapping else 2, "sequence": offset + 2, "offset": offset}


@contextmanager
def _refused_if_lossy(document: Document) -> Iterator[None]:
    """Raise what the library raises at comments that it cannot place as ConfigError."""
    try:
        yield
    except (YAMLError, ConfigError, NotImplementedError, AssertionError) as error:
        message = (
            "cannot be edited with its comments kept; write every value on the line of its key, "
            "and comments on lines of their own"
        )
        raise ConfigError(document.source, [ConfigProblem(None, "", message)]) from error


def data_text(data: Mapping[str, Value]) -> str:
    """The text of a new file with this data, in its order."""
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None  # inner lists and mappings on one line
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment] # typed as None
    yaml.allow_unicode = True
    stream = StringIO()
    yaml.dump(data, stream)
    return stream.getvalue()
