"""Backend for amplifiers on Modbus."""
