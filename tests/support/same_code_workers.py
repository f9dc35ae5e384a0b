"""Workers of a cluster that take their code for that of this process, as `same_code` does."""

from distributed import Client, Worker, WorkerPlugin

from model.studies import workers
from model.version import code_version


class SameCode(WorkerPlugin):
    """Every worker of a cluster has this process's version, those that replace others too."""

    def __init__(self) -> None:
        self.version = code_version()

    def setup(self, worker: Worker) -> None:
        """In the worker."""
        version = self.version
        workers.code_version = lambda: version  # type: ignore[assignment]


def give_same_code(address: str) -> None:
    """To all workers of a cluster."""
    with Client(address, set_as_default=False) as client:
        client.register_plugin(SameCode())
