"""Surface layouts: regions of the plate, their effects, and the files that define them.

Reading a file reports all of its problems. `LAYOUT` makes layouts a kind of configuration for
`era config`.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field

from controller.config_kind import CheckedFile, ConfigKind
from controller.effects.effect import (
    DEFAULT_MAX_DB_SL,
    ON_MOVE,
    ON_RELEASE,
    USES,
    Effect,
    Level,
    Region,
    TunedSection,
)
from controller.effects.file_effect import named_effects
from controller.effects.kinds import BUILT_IN_EFFECTS, effect_kind, effect_kinds
from controller.play.intent import band_problem
from model.answer.stimulus import MAX_LEVEL_DB_SL
from model.arrays import FloatArray
from model.config.document import Document, KeyPath, is_null_word, read_document
from model.config.fields import Quantity, Section, Validation
from model.config.shapes import ShapedSection
from model.config.units import LEVEL
from model.errors import InputError
from model.finger import STRONG_DB_SL
from model.rig.key_types import Identifier
from model.structure.plate import Plate
from registry.plugins import did_you_mean

BUZZ = "buzz"
"""Name of the effect that plays without a layout."""

ELSEWHERE = "elsewhere"
"""Key of the effect outside all regions, and name of that area in reports."""


def default_effects(level_db_sl: float = STRONG_DB_SL) -> dict[str, Effect]:
    """Return the default effects of every layout, at a level."""
    effects: dict[str, Effect] = {**named_effects(level_db_sl)}
    for kind in BUILT_IN_EFFECTS:
        if not kind.needs_entry:
            effects[kind.kind] = kind.model_construct(set(), level=level_db_sl)
    return effects


@dataclass(frozen=True)
class SurfaceLayout:
    """Regions, later ones on top of earlier ones, and effects by name."""

    regions: tuple[Region, ...] = ()
    effects: Mapping[str, Effect] = field(default_factory=default_effects)
    elsewhere: str | None = BUZZ
    """Effect outside all regions, felt by the newest finger there."""

    def region_at(self, x: float, y: float) -> Region | None:
        """Return the topmost region at a position [m], or None."""
        for region in reversed(self.regions):
            if region.shape.contains(x, y):
                return region
        return None

    def uses(self) -> Iterator[tuple[Region | None, str, str]]:
        """Yield every effect of every region: the region (None outside all), key and name."""
        for region in self.regions:
            for key in USES:
                name = getattr(region, key)
                if name is not None:
                    yield region, key, name
        if self.elsewhere is not None:
            yield None, ELSEWHERE, self.elsewhere

    def for_table(self, frequencies: FloatArray) -> Self:
        """Return the layout for the frequencies of a table [Hz], with its effects prepared."""
        effects = {}
        for name, effect in self.effects.items():
            effects[name] = effect.for_table(frequencies)
            effects[name].prepare(effect.level_db_sl)
        for region, _, name in self.uses():
            effects[name].prepare(self.level_of(name, region))
        return replace(self, effects=effects)

    @property
    def max_db_sl(self) -> float:
        """Highest level of all effects; infinite for a level that the neighbors limit."""
        highest = -math.inf
        for effect in self.effects.values():
            highest = max(highest, effect.max_db_sl(effect.level_db_sl))
        for region, _, name in self.uses():
            level_db_sl = self.level_of(name, region)
            highest = max(highest, self.effects[name].max_db_sl(level_db_sl))
        return highest

    def level_of(self, name: str, region: Region | None) -> float | None:
        """Return the level [dB SL] of an effect, by name, in a region or outside all.

        None for as strong as the neighbors allow.
        """
        if region is not None and region.has_level:
            return region.level_db_sl
        return self.effects[name].level_db_sl

    def band_problems(self, frequencies: FloatArray) -> list[str]:
        """Describe the table frequencies [Hz] played for bands without a table frequency."""
        problems: dict[str, None] = {}  # in order, each once
        for region, _, name in self.uses():
            band = self.effects[name].band_in(region)
            if band is None:
                continue
            problem = band_problem(band, frequencies)
            if problem is not None:
                area = ELSEWHERE if region is None else region.name
                problems[f"{area}: {problem}"] = None
        return list(problems)

    def as_json(self) -> dict[str, Any]:
        """Return the layout in the format of the API."""
        return {
            "regions": [region.as_json() for region in self.regions],
            "elsewhere": self.elsewhere,
        }


# Regions and effects beyond these numbers are reported as one problem, and not checked.
_MAX_REGIONS = 256
_MAX_EFFECTS = 64

_KEYS_OF_OTHERS = {"plate", "surface", "rig"}
"""Keys of rigs and daemon files."""

_HighestLevel = Annotated[
    float, Quantity(LEVEL, at_least=DEFAULT_MAX_DB_SL, at_most=MAX_LEVEL_DB_SL)
]

EffectName = Annotated[
    Identifier | None, BeforeValidator(lambda value: None if is_null_word(value) else value)
]
"""Type of the name of an effect, null or `none` for no effect."""


class RegionSection(ShapedSection, TunedSection):
    """A region of the plate and its effects."""

    on_press: EffectName = None
    on_move: EffectName = None
    on_release: EffectName = None
    level: Level | None = None
    priority: Annotated[int, Field(ge=0, le=100)] = 0
    own: bool = False
    may_share: bool = False
    protected: bool = False


class LayoutSection(Section):
    """A surface layout."""

    effects: Annotated[
        dict[Identifier, dict[str, Any]], Field(max_length=_MAX_EFFECTS, default_factory=dict)
    ]
    regions: Annotated[
        dict[Identifier, RegionSection], Field(max_length=_MAX_REGIONS, default_factory=dict)
    ]
    elsewhere: EffectName = BUZZ
    max_level_db_sl: _HighestLevel = DEFAULT_MAX_DB_SL


def load_layout(
    path: Path, plate: Plate | None, *, level_db_sl: float = STRONG_DB_SL
) -> SurfaceLayout:
    """Read a layout; raises ConfigError with every problem of the file.

    plate: must contain all regions, None for any. level_db_sl: of the default effects.
    """
    return layout_of(read_document(path), plate, level_db_sl=level_db_sl)


def layout_of(
    document: Document, plate: Plate | None, *, level_db_sl: float = STRONG_DB_SL
) -> SurfaceLayout:
    """Make the layout of a document; arguments and errors: see `load_layout`."""
    if not is_layout_document(document) and document.data.keys() & _KEYS_OF_OTHERS:
        kind = "a daemon file" if "rig" in document.data else "a rig"
        raise InputError(
            f"{document.source}: must be a surface layout, got {kind}; "
            "era config init layout.yaml --kind layout  writes one"
        )
    validation = Validation(document, LayoutSection)
    effects = _effects(document, validation, level_db_sl)
    for name in islice(validation.mapping(("regions",)), _MAX_REGIONS):
        _check_region(validation, ("regions", name), effects, plate)
    elsewhere = validation.field(("elsewhere",), LayoutSection)
    _check_use(validation, ("elsewhere",), elsewhere, effects, is_for_motion=None)
    _check_levels(validation, effects)
    section = validation.finish()
    return SurfaceLayout(
        regions=tuple(_region(name, region) for name, region in section.regions.items()),
        effects={name: effect for name, effect in effects.items() if effect is not None},
        elsewhere=section.elsewhere,
    )


def _region(name: str, section: RegionSection) -> Region:
    """Return the region of a section."""
    return Region(
        name=name,
        shape=section.shape,
        on_press=section.on_press,
        on_move=section.on_move,
        on_release=section.on_release,
        level_db_sl=section.level if isinstance(section.level, float) else None,
        has_level=section.level is not None,
        priority=section.priority,
        band=section.tuned_band,
        is_own=section.own,
        may_share=section.may_share,
        is_protected=section.protected,
    )


def is_layout_document(document: Document) -> bool:
    """Whether a configuration file is a surface layout."""
    keys = document.data.keys()
    has_layout_key = bool(keys & LayoutSection.model_fields.keys())
    return has_layout_key and keys.isdisjoint(_KEYS_OF_OTHERS)


def _effects(
    document: Document, validation: Validation[LayoutSection], level_db_sl: float
) -> dict[str, Effect | None]:
    """Return effects by name, with the default ones; None for an invalid one."""
    effects: dict[str, Effect | None] = {**default_effects(level_db_sl)}
    sections = validation.mapping(("effects",))
    effects |= dict.fromkeys(sections)
    for name, parameters in islice(sections.items(), _MAX_EFFECTS):
        path = ("effects", name)
        if not isinstance(parameters, dict):
            continue  # reported with the section of the layout
        if is_null_word(name):
            validation.add(path, "means no effect where an effect is named; choose another name")
            continue
        kind = _kind_of(validation, name, parameters)
        if kind is None:
            continue
        effect = validation.nested(path, kind, without="kind")
        effects[name] = effect
        if effect is None:
            continue
        try:
            effect.read(document.beside(""))
        except InputError as error:
            validation.add((*path, "file"), f"{error}")
    return effects


def _kind_of(
    validation: Validation[LayoutSection], name: str, parameters: Mapping[str, Any]
) -> type[Effect] | None:
    """Return the kind of an effect with a name and parameters; report an unknown one."""
    kind = parameters.get("kind", name)
    try:
        return effect_kind(kind if isinstance(kind, str) else repr(kind))
    except InputError as error:
        if "kind" in parameters:
            validation.add(("effects", name, "kind"), f"{error}")
        elif name in effect_kinds():
            validation.add(("effects", name), f"{error}")
        else:
            validation.add(("effects", name), f"needs a kind; {error}")
        return None


def _check_region(
    validation: Validation[LayoutSection],
    path: KeyPath,
    effects: dict[str, Effect | None],
    plate: Plate | None,
) -> None:
    """Check that a region has one shape, on the plate, and that its effects exist."""
    region = validation.part(path, RegionSection)
    if region is None:
        return
    sides = None if plate is None else (plate.length, plate.width)
    problem = region.shape_problem(sides)
    if problem:
        keys, message = problem
        validation.add((*path, *keys), message)
    if not any(getattr(region, key) for key in USES):
        for key in ("level", "band", "frequency", "own", "may_share"):
            value = getattr(region, key)
            if value is not None and value is not False:  # a level can be 0
                validation.add(
                    (*path, key), f"has no effect to apply to; add an effect or remove the {key}"
                )
    if region.own and region.may_share:
        validation.add(
            (*path, "may_share"),
            "must not be true together with own: content is shared; remove one",
        )
    for key in USES:
        name = getattr(region, key)
        _check_use(validation, (*path, key), name, effects, is_for_motion=key == ON_MOVE)


def _check_levels(validation: Validation[LayoutSection], effects: dict[str, Effect | None]) -> None:
    """Check that no level is above the highest one of the layout."""
    highest = validation.field(("max_level_db_sl",), LayoutSection)
    levels: dict[KeyPath, float] = {}
    for name, effect in effects.items():
        if effect is not None and effect.level_db_sl is not None:
            levels["effects", name] = effect.max_db_sl(effect.level_db_sl)
    for name in islice(validation.mapping(("regions",)), _MAX_REGIONS):
        region = validation.part(("regions", name), RegionSection)
        if region is not None and isinstance(region.level, float):
            levels["regions", name, "level"] = region.level
    for path, level in levels.items():
        problem = level_problem(level, highest)
        if problem:
            validation.add(path, problem)


def level_problem(level_db_sl: float, highest: float | None = None) -> str | None:
    """Return why a level [dB SL] is too high for a layout; highest: None for the default."""
    if highest is None:
        highest = DEFAULT_MAX_DB_SL
    if level_db_sl <= highest:
        return None
    return (
        f"level must be up to {highest:g} dB SL, got {level_db_sl:g}; lower it, or raise "
        "max_level_db_sl of the layout"
    )


def _check_use(
    validation: Validation[LayoutSection],
    path: KeyPath,
    name: str | None,
    effects: dict[str, Effect | None],
    *,
    is_for_motion: bool | None,
) -> None:
    """Check that an effect exists and fits its use; is_for_motion: None if any effect fits."""
    if name is None:
        return
    if name not in effects:
        suggestion = did_you_mean(name, effects)
        message = f"unknown effect {name!r}; {suggestion}choose one of {', '.join(effects)}"
        if name in effect_kinds():
            message += f"; or define it, as `{name}: {{}}` under effects"
        validation.add(path, message)
        return
    effect = effects[name]
    if effect is None:
        return
    if is_for_motion is None:
        if effect.needs_region:
            validation.add(path, f"{name} works only in regions; put it under on_move of a region")
        return
    if effect.is_for_motion and not is_for_motion:
        validation.add(path, f"{name} is for motion; put it under on_move")
    elif is_for_motion and not effect.is_for_motion:
        validation.add(path, f"{name} is not for motion; put it under on_press or on_release")
    elif path[-1] == ON_RELEASE and not effect.has_end:
        can_end = "duration" in type(effect).model_fields
        remedy = "give it a duration" if can_end else "choose an effect that does"
        validation.add(path, f"{name} must end by itself; {remedy}")


def _checked(document: Document) -> CheckedFile:
    """Read a layout; raises ConfigError. Only a daemon file shows whether it fits a plate."""
    layout = layout_of(document, None)
    region_names = [region.name for region in layout.regions]
    unused = default_effects().keys() - {name for _, _, name in layout.uses()}
    effect_names = [name for name in layout.effects if name not in unused]
    return CheckedFile(
        f"good: regions {', '.join(region_names) or 'none'}; "
        f"effects {', '.join(effect_names) or 'none'}; "
        f"elsewhere {layout.elsewhere or 'nothing'}. "
        "Check the daemon's file that names it to see whether it fits the plate",
    )


def _keys() -> dict[str, Any]:
    """The JSON schema of a layout; the kinds of effects are under `$defs`."""
    schema = LayoutSection.model_json_schema()
    kinds = {f"effect {name}": effect_kind(name).model_json_schema() for name in effect_kinds()}
    return {**schema, "$defs": {**schema.get("$defs", {}), **kinds}}


LAYOUT = ConfigKind(
    "A surface layout of era-haptics",
    recognises=is_layout_document,
    check=_checked,
    example_file=Path(__file__).with_name("example.yaml"),
    keys=_keys,
)
