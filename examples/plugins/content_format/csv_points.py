"""Content as a spreadsheet saves it: a line `time [s],intensity,sharpness` for each point."""

from era_haptics.plugins.content_formats import (
    ContentFormat,
    InputError,
    Pattern,
    pattern_of_points,
)


class CsvPoints(ContentFormat):
    """Points with commas between their values."""

    ending = "example.csv"

    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return the pattern in a file; empty lines are skipped."""
        points = []
        for number, line in enumerate(content.decode("utf-8", "replace").splitlines(), start=1):
            try:
                points += [[float(value) for value in line.split(",")]] if line.strip() else []
            except ValueError:
                raise InputError(
                    f"{source}:{number}: must be time,intensity,sharpness, got {line[:40]!r}"
                ) from None
        try:
            return pattern_of_points(points)
        except InputError as error:
            raise InputError(f"{source}: {error}") from None
