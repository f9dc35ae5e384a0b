"""Wiring of a sound card: ERAs at outputs, accelerometers at inputs, and a loop-back.

The loop-back is a cable from the output after the ERA outputs to the input after the sensor inputs.
If the card has no free output, a Y cable takes it from the output of the last ERA. Outputs and
inputs are counted from 1. A *source* is an output that plays a signal of its own.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from era_haptics.lab.measuring.sensor_file import WiredSensor
from model.arrays import ComplexArray, FloatArray


@dataclass(frozen=True)
class SoundCardWiring:
    """Outputs and inputs of a sound card.

    era_outputs: output by ERA name, in the rig's order; is_shared: whether the loop-back shares the
    output of the last ERA.
    """

    era_outputs: Mapping[str, int]
    sensors: tuple[WiredSensor, ...]
    is_shared: bool

    @property
    def loopback_output(self) -> int:
        """Output of the loop-back, the last one."""
        last_era_output = max(self.era_outputs.values())
        return last_era_output if self.is_shared else last_era_output + 1

    @property
    def loopback_input(self) -> int:
        """Input of the loop-back, the last one."""
        return max(sensor.input for sensor in self.sensors) + 1

    @property
    def source_outputs(self) -> list[int]:
        """Output of each source: of the ERAs in their order, and of a loop-back of its own."""
        outputs = list(self.era_outputs.values())
        return outputs if self.is_shared else [*outputs, self.loopback_output]

    @property
    def loopback_source(self) -> int:
        """Index of the source that the loop-back returns."""
        return self.source_outputs.index(self.loopback_output)

    @property
    def input_names(self) -> dict[int, str]:
        """Description of each connected input, including the loop-back, by number."""
        names = {sensor.input: f"sensor {sensor.name}" for sensor in self.sensors}
        return names | {self.loopback_input: f"the loop-back of output {self.loopback_output}"}

    @property
    def sensor_columns(self) -> list[int]:
        """Index of each sensor's input."""
        return [sensor.input - 1 for sensor in self.sensors]

    def on_outputs(self, signals: FloatArray) -> FloatArray:
        """Samples (n, outputs) of the signals (n, sources)."""
        columns = [output - 1 for output in self.source_outputs]
        return np.asarray(signals @ np.eye(self.loopback_output)[columns])

    def loopback_of(self, values: ComplexArray) -> ComplexArray:
        """The response (f,) of the loop-back among responses (f, inputs, sources)."""
        return np.asarray(values[:, self.loopback_input - 1, self.loopback_source])

    def era_responses_of(self, values: ComplexArray) -> ComplexArray:
        """The responses (f, sensors, ERAs) among responses (f, inputs, sources)."""
        return np.asarray(values[:, self.sensor_columns, : len(self.era_outputs)])
