"""Touch sources by the scheme of their URL, our own and those of installed plug-ins alike."""

from importlib.metadata import EntryPoint, entry_points

from controller.touch import TouchSource
from model.errors import InputError, did_you_mean
from model.plugins import blamed

GROUP = "era_haptics.touch_sources"


def open_source(url: str) -> TouchSource:
    """Make the touch source of a URL such as `tuio:127.0.0.1:3333` or `evemu:taps.events`.

    Only the plug-in that the scheme names is loaded, so a broken one disturbs no other. Raises
    InputError on an unknown scheme, a plug-in that does not work or a URL that it refuses.
    """
    plugins = _plugins()
    scheme, colon, _ = url.partition(":")
    if not colon or scheme not in plugins:
        known = [f"{name}:" for name in sorted(plugins)]
        raise InputError(
            f"touch source {url}: unknown kind {scheme!r}; {did_you_mean(f'{scheme}:', known)}"
            f"known are {', '.join(known)}"
        )
    plugin = plugins[scheme]
    with blamed(plugin, f"touch source {url}", but=(InputError,)):
        source = plugin.load()(url)
    if not isinstance(source, TouchSource):
        raise InputError(
            f"touch source {url}: the plug-in {plugin.value} does not make a TouchSource"
        )
    return source


def _plugins() -> dict[str, EntryPoint]:
    """Entry points by scheme."""
    return {point.name: point for point in entry_points(group=GROUP)}
