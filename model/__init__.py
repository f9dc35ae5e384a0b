"""The plate in physics, of era-haptics: elements, actuators, localization; no I/O but files."""
