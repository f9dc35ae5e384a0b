"""The vibrating structure: plate, materials, ERAs, and other attachments."""
