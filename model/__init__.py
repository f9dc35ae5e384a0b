"""Plate model of era-haptics: plate, actuators and localization; its only I/O is files."""
