"""The status of an amplifier, with a key for each reading of the protocol.

`amplifier_status.pyi`, which `make pages` writes, has them for editors and mypy.
"""

from pydantic import Field, create_model

from controller.api.schema import AmplifierState
from drivers.protocol.definition import READINGS

AmplifierStatus = create_model(
    "AmplifierStatus",
    __base__=AmplifierState,
    __module__=__name__,
    __doc__="One amplifier according to its last reply; null where unknown.",
    **{
        each.key: (
            float | None,
            Field(
                None if each.is_added else ...,
                description=each.meaning
                + "; null where the amplifier does not state it" * each.is_added,
            ),
        )
        for each in READINGS
    },
)
