"""Tasks of a design on parallel processes or other machines."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

from era_haptics.lab.design.results import RankedLayout
from model.processes import Progress, on_processes, unseen

Machines: TypeAlias = Callable[..., Iterator[tuple[int, Any]]]
"""Solves tasks: `model.processes.on_processes`, or `model.processes.on_cluster` with an address."""

LayoutListener: TypeAlias = Callable[[RankedLayout], None]
"""Called with every layout as soon as it is scored, and again once it is evaluated in full."""

_THIS_PROCESS: Machines = partial(on_processes, 1)


def ignore_layout(layout: RankedLayout) -> None:
    """Ignore a layout (default listener)."""


@dataclass(frozen=True)
class Runner:
    """Solves tasks on machines."""

    machines: Machines = _THIS_PROCESS
    progress: Progress = unseen
    """Progress of the current stage."""
    on_layout: LayoutListener = ignore_layout

    def run(
        self,
        solve: Callable[[Any, Any], Any],
        shared: object,
        tasks: Sequence[Any],
        on_result: Callable[[int, Any], None] = lambda number, result: None,
    ) -> list[Any]:
        """Return the results of tasks, in their order.

        on_result: called with each task's number and result as soon as it is done.
        """
        results: dict[int, Any] = {}
        for number, result in self.machines(solve, shared, dict(enumerate(tasks))):
            results[number] = result
            on_result(number, result)
            self.progress(len(results), len(tasks))
        return [results[number] for number in range(len(tasks))]

    def run_layouts(
        self,
        solve: Callable[[Any, Any], Any],
        shared: object,
        tasks: Sequence[Any],
        layouts_of_result: Callable[[int, Any], list[RankedLayout]],
    ) -> list[RankedLayout]:
        """Return the layouts of all results, in the order of their tasks, and notify the listener.

        layouts_of_result: converts a task's number and result to layouts.
        """

        def notify(number: int, result: Any) -> None:
            for layout in layouts_of_result(number, result):
                self.on_layout(layout)

        results = self.run(solve, shared, tasks, notify)
        layouts: list[RankedLayout] = []
        for number, result in enumerate(results):
            layouts += layouts_of_result(number, result)
        return layouts
