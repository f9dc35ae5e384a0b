"""Content format for spreadsheets: CSV with a line `time [s],intensity,sharpness` per point."""

from era_haptics.plugins.content_formats import (
    ContentFormat,
    InputError,
    Pattern,
    pattern_of_points,
)


class CsvPoints(ContentFormat):
    """CSV file of points."""

    ending = "example.csv"

    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return the pattern of a file; empty lines are skipped."""
        points = []
        lines = content.decode("utf-8", "replace").splitlines()
        for number, line in enumerate(lines, start=1):
            if not line.strip():
                continue
            try:
                points.append([float(value) for value in line.split(",")])
            except ValueError:
                raise InputError(
                    f"{source}:{number}: must be time,intensity,sharpness, got {line[:40]!r}"
                ) from None
        try:
            return pattern_of_points(points)
        except InputError as error:
            raise InputError(f"{source}: {error}") from None
