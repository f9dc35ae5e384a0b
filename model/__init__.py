"""The plate in physics: finite elements, actuators, response, localization. No I/O but files."""
