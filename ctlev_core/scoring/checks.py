"""Do the scores of an experiment fit what is to be scored? Asked while it is planned, before anything is computed.

A downstream model says in `PREDICTS` what of `joints2d`, `joints3d`, `smpl` and `classes` its predictions hold, a
metric in `INPUT` what it compares, which must be among the labels, too. A model without `PREDICTS` is not checked.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from ctlev_core import plugins
from ctlev_core.plugin_contracts import FeatureExtractor, MetricOfSkeletons, PluginWithFiles
from ctlev_core.plugins import PluginError
from data_contracts.config import DatasetChoice, DownstreamChoice, MetricChoice
from data_contracts.errors import DataError
from data_contracts.labels import HeldOut, Labels
from data_contracts.manifest import MANIFEST_FILE, ManifestRef, labels_of, read_manifest

_ARRAYS = {
    "joints2d": ("joints2d", "visible"),
    "joints3d": ("joints3d",),
    "smpl": ("smpl_pose", "smpl_betas", "smpl_transl"),
}
FEATURES = "features"
"""`INPUT` of metrics that compare two sets of frames rather than predictions with labels."""


def check_metrics(downstream: DownstreamChoice, metrics: Sequence[MetricChoice]) -> None:
    """Check that a model's predictions can be scored.

    Raises:
        PluginError: a metric needs what the model does not predict, or compares sets of frames.
        DataError: a file that a metric reads is missing.
    """
    predicts = plugins.load_options(downstream).module.PREDICTS
    for choice in metrics:
        metric = plugins.load_options(choice)
        needed = metric.module.INPUT
        if needed == FEATURES:
            raise PluginError(
                f"metrics: expected metrics of predictions, got {choice.name!r}, which compares the features of two "
                "sets of frames; name it under distances"
            )
        if needed not in predicts:
            raise PluginError(
                f"metrics: {choice.name!r} expected a downstream model that predicts {needed}, got "
                f"{downstream.name!r}, which predicts {', '.join(predicts) or 'nothing but features'}"
            )
        if isinstance(metric.module, PluginWithFiles):
            metric.module.input_files(metric.options)


def check_labels(metrics: Sequence[MetricChoice], labels: Labels, where: str) -> None:
    """Check that predictions can be compared with labels such as these.

    Args:
        metrics: of predictions.
        labels: one row is enough, for all rows of a dataset have the same kinds.
        where: whose they are.

    Raises:
        PluginError: a metric needs labels or joints that there are not.
    """
    kinds = [kind for kind, arrays in _ARRAYS.items() if set(arrays) <= set(labels.arrays)]
    kinds += ["classes"] * all(labels.class_names)
    for choice in metrics:
        metric = plugins.load_options(choice)
        needed = metric.module.INPUT
        if needed not in kinds:
            raise PluginError(
                f"metrics: {choice.name!r} expected labels with {needed}, got {where}, which has "
                f"{', '.join(kinds) or 'none of any kind'}"
            )
        if isinstance(metric.module, MetricOfSkeletons):
            try:
                metric.module.check_joint_set(labels.joint_set, metric.options)
            except ValueError as error:
                raise PluginError(f"metrics: {choice.name!r} does not fit the labels of {where}: {error}") from None


def check_dataset(metrics: Sequence[MetricChoice], dataset: DatasetChoice, held_out: HeldOut = "test") -> None:
    """The same by the labels of one recording, the first of the split that is tested on; it is read for that.

    Raises:
        PluginError: as `check_labels`.
        DataError: the dataset cannot be read, or has no recording of that split.
    """
    plugin = plugins.load_options(dataset)
    recordings = plugin.module.list_recordings(plugin.options)
    tested = [recording for recording in recordings if any(part.split == held_out for part in recording.parts)]
    if tested:
        labels = plugin.module.read_labels(tested[0], plugin.options)
        check_labels(metrics, labels, f"dataset {dataset.name!r}")
    elif held_out == "validation":
        raise DataError(
            f"dataset {dataset.name!r}: evaluate_on is 'validation', but its options hold no recordings back for that "
            "(docs/datasets.md, Validation)"
        )


def check_frames(metrics: Sequence[MetricChoice], folder: Path) -> None:
    """The same by the labels of an artefact of frames, where it is there already.

    Raises:
        PluginError: as `check_labels`.
    """
    if (folder / MANIFEST_FILE).is_file():
        # One that cannot be read is made anew, and looked at then.
        with suppress(DataError):
            labels = _first_label(folder)
            if len(labels):
                check_labels(metrics, labels, str(folder))


@lru_cache(maxsize=16)
def _first_label(folder: Path) -> Labels:
    """Every score of an experiment asks for the same."""
    return labels_of(read_manifest(ManifestRef(key=folder.name, path=folder)).table.slice(0, 1))


def check_distances(extractor: DownstreamChoice, distances: Sequence[MetricChoice]) -> None:
    """Check that sets of frames can be compared.

    Raises:
        PluginError: the extractor has no features, or a metric does not compare features.
        DataError: a file that a metric reads is missing.
    """
    plugin = plugins.load_options(extractor)
    if not isinstance(plugin.module, FeatureExtractor):
        raise PluginError(f"feature_extractor: expected a model with features, got {extractor.name!r}, which has none")
    if getattr(plugin.options, "binary", None) is not None:
        raise PluginError(
            f"feature_extractor: {extractor.name!r} with the option binary is a classifier for each class, which have "
            "no features in common; leave binary out"
        )
    for choice in distances:
        metric = plugins.load_options(choice)
        needed = metric.module.INPUT
        if needed != FEATURES:
            raise PluginError(
                f"distances: expected metrics of features, got {choice.name!r}, which compares {needed}; "
                "name it under metrics"
            )
        if isinstance(metric.module, PluginWithFiles):
            metric.module.input_files(metric.options)
