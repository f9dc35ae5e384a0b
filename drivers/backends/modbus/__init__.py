"""An amplifier that speaks Modbus, and the line that several share."""
