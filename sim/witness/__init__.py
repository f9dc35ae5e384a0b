"""An independent witness of the wires: it decodes every frame anew and says which rule was broken.

Nothing here comes from `drivers` or from the far ends: the decoders are written from
docs/reference/wire-protocol.md, docs/reference/wire-modbus.md and docs/reference/wire-can.md alone.
"""
