"""Topics that only the gateway has, beside those of the daemon's API."""

FIELD = "field"
"""How the plate vibrates, as binary frames; see `fields.Field.encoded`."""

HELLO = "hello"
"""The daemon as it introduced itself, or null while it is away."""

OWN = frozenset({FIELD, HELLO})
