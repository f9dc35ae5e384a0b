"""Data of tests in YAML, with words and numbers as the product's own files have them."""

from pathlib import Path
from typing import Any, ClassVar

import yaml

from model.config.document import plain_value


class _Loader(yaml.CSafeLoader):
    """Leaves it to `plain_value` which unquoted texts are words and numbers; `<<` merges."""

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {
        "<": yaml.CSafeLoader.yaml_implicit_resolvers["<"]
    }

    def scalar(self, node: yaml.ScalarNode) -> Any:
        """The value of a text."""
        return node.value if node.style else plain_value(node.value)


_Loader.add_constructor("tag:yaml.org,2002:str", _Loader.scalar)


def read_yaml(path: Path) -> Any:
    """The data of a file."""
    return yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
