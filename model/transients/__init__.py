"""The plate in time: onsets and endings, predicted exactly and shaped to stay quiet."""
