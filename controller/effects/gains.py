"""What a strength may be, over the API and in the file that keeps it."""

from typing import Annotated, TypeAlias

from pydantic import Field

SourceName: TypeAlias = Annotated[str, Field(min_length=1, max_length=2048)]
"""A name that has a strength; those of senders are escaped, and so may be long."""

GainDb: TypeAlias = Annotated[float, Field(ge=-40, le=0)]
"""The gain [dB] of a name."""
