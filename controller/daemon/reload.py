"""Reading a running daemon's files again, and applying their layouts.

`ConfigReload` runs as a task. `read_again` reads the configuration and returns a `ConfigChange`
with the changes that can be applied; it blocks, and runs outside the event loop because comparing
large layouts takes a while.
"""

import asyncio
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from controller.api.methods import ReloadResult
from controller.daemon.children import read_in_child
from controller.daemon.config import DaemonConfig
from controller.daemon.layouts import LayoutChoice, warn_of_bands
from controller.effects.effect import Effect
from model.arrays import FloatArray
from model.errors import InputError
from registry.threads import in_thread, without_collections

_logger = logging.getLogger(__name__)

_APPLIED = ("layouts", "level_db_sl")  # keys that a running daemon can apply


class ConfigReload:
    """Reads the configuration again on request and applies its layouts, if nothing else changed.

    frequencies: of the table [Hz]. is_armed: returns whether the plate is armed. started, ended:
    called before and after each reload.
    """

    def __init__(
        self,
        config: DaemonConfig,
        frequencies: FloatArray,
        layouts: LayoutChoice,
        *,
        is_armed: Callable[[], bool],
        started: Callable[[], None],
        ended: Callable[[], None],
    ) -> None:
        self.config = config
        """The configuration in use."""
        self._frequencies = frequencies
        self._layouts = layouts
        self._is_armed = is_armed
        self._started = started
        self._ended = ended
        self._released: list[Effect] = []  # of replaced layouts, not freed yet
        self._requested = asyncio.Event()
        self._next_result = self._new_result()

    def request(self) -> None:
        """Request a reload without waiting for its result."""
        self._requested.set()

    async def result(self) -> ReloadResult:
        """Request a reload and wait for its result.

        While one is under way, all further requests are combined into one after it.
        """
        self.request()
        return await asyncio.shield(self._next_result)

    async def run(self) -> None:
        """Reload whenever requested, until cancelled."""
        while True:
            await self._requested.wait()
            self._requested.clear()
            pending_result = self._next_result
            self._next_result = self._new_result()
            self._started()
            result = await self._reload()
            reasons = "; ".join(result.reasons)
            if result.reloaded:
                _logger.info("config: reloaded: %s", reasons)
            else:
                _logger.error("config: reload rejected, keeping previous: %s", reasons)
            self._ended()
            pending_result.set_result(result)

    @staticmethod
    def _new_result() -> asyncio.Future[ReloadResult]:
        """Return the future result of the next reload."""
        return asyncio.get_running_loop().create_future()

    async def _reload(self) -> ReloadResult:
        """Reload now; every error is a reason of the result."""
        is_done = False
        try:
            change = await self._read_again()
            reasons = change.refusals(is_armed=self._is_armed())
            if reasons:
                reasons += [f"{text}, but not applied" for text in change.changes]
            else:
                notes = self._layouts.apply(change.config.layouts, change.layouts)
                reasons = [*change.changes, *notes] or ["nothing has changed"]
                self.config = change.config
                is_done = True
            self._released = change.effects
            del change
            await release(self._released)
        except (InputError, OSError) as error:
            reasons = [line.strip() for line in str(error).splitlines()]
        except Exception as error:  # systemd and clients wait for the end of the reload
            _logger.exception("config: reload failed")
            reasons = [f"a bug in the daemon ({type(error).__name__}); its log has the details"]
        return ReloadResult(reloaded=is_done, reasons=reasons)

    async def _read_again(self) -> "ConfigChange":
        """Read the configuration again in a thread, which keeps no reference to either one."""
        changes = []

        def read() -> None:
            changes.append(read_again(self.config, self._frequencies))

        await in_thread(read, name="reload")
        return changes.pop()


@dataclass(frozen=True)
class ConfigChange:
    """A configuration, and its differences from the current one."""

    config: DaemonConfig
    restart: list[str]
    """Changed keys that need a restart."""
    changes: list[str]
    """Descriptions of all other changes."""
    layouts: frozenset[str | None]
    """Names of the changed layouts; None: the default layout of a configuration without layouts."""
    old_max_db_sl: float
    max_db_sl: float
    """Highest level of all layouts, before and after [dB SL]."""
    effects: list[Effect]
    """All effects of both configurations; see `release`."""

    def refusals(self, *, is_armed: bool) -> list[str]:
        """Return the reasons for rejecting the configuration; empty if it can be applied."""
        reasons = [f"{key}: changed, which needs a restart" for key in self.restart]
        if is_armed and self.max_db_sl > self.old_max_db_sl:
            reasons.append(
                f"maximum level must not increase while armed, got {self.max_db_sl:g} dB SL (was "
                f"{self.old_max_db_sl:g}); disarm, then reload"
            )
        return reasons


def read_again(old: DaemonConfig, frequencies: FloatArray) -> ConfigChange:
    """Read a daemon's configuration again for a table's frequencies [Hz]; blocks.

    Raises the errors of `read_in_child`.
    """
    with without_collections():  # large layouts would take long
        change = config_change(old, read_in_child(old.source, frequencies))
        layouts = change.config.layouts
        changed_layouts = {name: layouts[name] for name in layouts if name in change.layouts}
        warn_of_bands(changed_layouts, frequencies)
        return change


def config_change(old: DaemonConfig, new: DaemonConfig) -> ConfigChange:
    """Compare all keys and layouts, and the content of the rig's file."""
    old_values = old.section.model_dump()
    new_values = new.section.model_dump()
    restart = [key for key in old_values if _needs_restart(key, old_values, new_values)]
    if old.rig_text != new.rig_text and "rig" not in restart:
        restart.append("rig")
    names = {**old.layouts, **new.layouts}
    changed = [name for name in names if old.layouts.get(name) != new.layouts.get(name)]
    changes = []
    for name in changed:
        if name is not None:
            change = "removed" if name not in new.layouts else "changed"
            changes.append(f"layouts.{name}: {change if name in old.layouts else 'added'}")
    old_level = old_values["level_db_sl"]
    new_level = new_values["level_db_sl"]
    if old_level != new_level:
        changes.append(f"level_db_sl: from {old_level:g} to {new_level:g}")
    # Unchanged layouts keep their rendered effects.
    layouts = dict(new.layouts)
    for name in layouts.keys() - changed:
        layouts[name] = old.layouts[name]
    return ConfigChange(
        config=replace(new, layouts=layouts),
        restart=restart,
        changes=changes,
        layouts=frozenset(changed),
        old_max_db_sl=max([layout.max_db_sl for layout in old.layouts.values()]),
        max_db_sl=max([layout.max_db_sl for layout in new.layouts.values()]),
        effects=[*_effects_of(old), *_effects_of(new)],
    )


def _needs_restart(key: str, old: Mapping[str, object], new: Mapping[str, object]) -> bool:
    """Whether a key of the configuration has changed that a running daemon cannot apply."""
    return key not in _APPLIED and old[key] != new[key]


def _effects_of(config: DaemonConfig) -> list[Effect]:
    """Return the effects of all layouts."""
    return [effect for layout in config.layouts.values() for effect in layout.effects.values()]


async def release(effects: list[Effect]) -> None:
    """Free the effects of replaced layouts, one in each turn of the event loop.

    The caller must hold no other reference to these layouts. Freeing an object together with all
    its contents blocks the interpreter, so layouts of many files must not be freed as a whole.
    """
    while effects:
        effects.pop()
        await asyncio.sleep(0)
