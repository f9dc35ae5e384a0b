# Written by docs/generators/client_stub.py.

from controller.api.schema import AmplifierState

class AmplifierStatus(AmplifierState):
    temperature_c: float | None
    high_voltage_v: float | None
