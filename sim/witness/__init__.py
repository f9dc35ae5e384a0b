"""An independent witness of the wires: it decodes every frame anew and says which rule was broken.

Nothing here comes from `drivers` or from the far ends: the decoders are written from
docs/wire-protocol.md, docs/wire-modbus.md and docs/wire-can.md alone.
"""
