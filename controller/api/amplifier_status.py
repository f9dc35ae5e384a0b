"""The status of an amplifier, with a key for each reading of the protocol.

`amplifier_status.pyi`, which `make pages` writes, has them for editors and mypy.
"""

from typing import Any

from pydantic import Field, create_model

from controller.api.schema import AmplifierState
from drivers.protocol.records import Number
from drivers.protocol.table import READINGS


def _field(reading: Number) -> Any:
    text = "null where the amplifier does not state it" if reading.is_added else None
    return float | None, Field(None if reading.is_added else ..., description=text)


AmplifierStatus = create_model(
    "AmplifierStatus",
    __base__=AmplifierState,
    __module__=__name__,
    __doc__="One amplifier according to its last reply; null where unknown.",
    **{each.key: _field(each) for each in READINGS},
)
