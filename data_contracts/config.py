"""Configuration base classes. Everything a user can set is a frozen pydantic model that refuses unknown names."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer, model_validator


class Frozen(BaseModel):
    """Base of every options model: immutable, and an unknown or misspelt option is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_serializer(mode="wrap")
    def _without_what_is_off(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values = serialize(self)
        for name, info in type(self).model_fields.items():
            if info.json_schema_extra == ADDED_LATER and getattr(self, name) == info.default:
                values.pop(name, None)
        return values


RUN_SETTING: dict[str, Any] = {"run_setting": True}
"""Pass as `Field(json_schema_extra=RUN_SETTING)`: the field (a path, a device, a worker count) must not
change any result and therefore stays outside the cache key."""

ADDED_LATER: dict[str, Any] = {"added_later": True}
"""Pass as `Field(json_schema_extra=ADDED_LATER)`: an option that came when there were artefacts without it. While it
has its default it is not written, so that those artefacts keep their keys and are not made again."""


def cache_material(options: BaseModel, of_choice: Callable[[Choice], Any] | None = None) -> dict[str, Any]:
    """The options as JSON-ready values, without the run settings: what the cache key is made of.

    Args:
        options: of a plug-in, or of what a stage does.
        of_choice: what stands for a plug-in that is chosen among them; None = its name and options as they are.
    """
    excluded = {
        name
        for name, info in type(options).model_fields.items()
        if isinstance(info.json_schema_extra, dict) and info.json_schema_extra.get("run_setting")
    }
    material = options.model_dump(mode="json", exclude=excluded)
    for name in material:
        material[name] = _material_of(getattr(options, name), material[name], of_choice)
    return material


def _material_of(value: Any, dumped: Any, of_choice: Callable[[Choice], Any] | None) -> Any:
    """What stands for one option, which is `dumped` in JSON."""
    if isinstance(value, Choice) and of_choice is not None:
        return of_choice(value)
    if isinstance(value, BaseModel):
        return cache_material(value, of_choice)
    if isinstance(value, dict) and any(isinstance(item, BaseModel) for item in value.values()):
        return {name: _material_of(item, dumped[str(name)], of_choice) for name, item in value.items()}
    return dumped


class Choice(Frozen):
    """A plug-in by name, with its options. Subclasses say its kind and which options model of the module applies."""

    KIND: ClassVar[str] = ""
    OPTIONS: ClassVar[str] = "Options"

    name: str
    options: dict[str, Any] = Field(default_factory=dict)


class DatasetChoice(Choice):
    """A module of `ctlev_core/datasets`."""

    KIND = "datasets"


class EncodingChoice(Choice):
    """A module of `ctlev_core/encodings`."""

    KIND = "encodings"


class ConditionChoice(Choice):
    """A module of `ctlev_core/conditions`."""

    KIND = "conditions"


class GeneratorChoice(Choice):
    """A module of `ctlev_core/generators`."""

    KIND = "generators"


class SamplingChoice(Choice):
    """How a generator of `ctlev_core/generators` samples: its `SampleOptions`."""

    KIND = "generators"
    OPTIONS = "SampleOptions"


class DownstreamChoice(Choice):
    """A module of `ctlev_core/downstream`."""

    KIND = "downstream"


class MetricChoice(Choice):
    """A module of `ctlev_core/metrics`."""

    KIND = "metrics"


class Windows(Frozen):
    """How a recording is cut into windows; each window becomes one frame."""

    method: Literal["count", "duration", "whole", "dataset"] = Field(
        default="count",
        description="what every window has the same of; dataset = as the dataset's authors cut their recordings",
    )
    num_events: int = Field(default=7500, gt=0, description="events a window (count); DHP19's mean per camera")
    duration_us: int = Field(default=8333, gt=0, description="length of a window (duration); CDEHP has 120 a second")
    max_windows: int | None = Field(
        default=None, gt=0, description="at most so many of each split of a recording, evenly spread"
    )
    min_events: int = Field(default=1, ge=1, description="drop windows with fewer events (duration, whole)")
    anchor: Literal["first_event", "labels"] = Field(
        default="first_event",
        json_schema_extra=ADDED_LATER,
        description="one window after another from the first event; or one that ends at each label (count, duration), "
        "which overlap where labels follow faster",
    )
    labels: Literal["mean", "interpolated"] = Field(
        default="mean",
        json_schema_extra=ADDED_LATER,
        description="label of a window that has none of its own: the mean of the positions in it and the body in its "
        "middle, or those nearest to it, as DHP19; or those at its end, between the labels before and after, without "
        "which, or with a gap between them, there is no window",
    )

    @property
    def end_at_labels(self) -> bool:
        """Whether labels are those of the moment a window ends at, and not of its middle."""
        return self.anchor == "labels" or self.labels == "interpolated"

    @model_validator(mode="after")
    def _labels_end_what_can_be_moved(self) -> Windows:
        if self.anchor == "labels" and self.method not in ("count", "duration"):
            raise ValueError(f"windows.anchor 'labels' needs method count or duration, got {self.method!r}")
        return self
