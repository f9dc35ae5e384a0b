"""Accuracy of plates of layers and of the air behind them: `python -m benchmarks.layers`."""
