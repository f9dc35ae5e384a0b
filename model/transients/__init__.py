"""The plate in time: exact prediction and shaping of onsets and endings."""
