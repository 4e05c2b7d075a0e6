"""Do the scores of an experiment fit what is to be scored? Asked while it is planned, before anything is computed.

A downstream model says in `PREDICTS` what of `joints2d`, `joints3d`, `smpl` and `classes` its predictions hold, a
metric in `INPUT` what it compares. A model without `PREDICTS` is not checked.
"""

from __future__ import annotations

from collections.abc import Sequence

from ctlev_core import plugins
from ctlev_core.plugins import PluginError
from data_contracts.config import DownstreamChoice, MetricChoice

FEATURES = "features"
"""`INPUT` of metrics that compare two sets of frames rather than predictions with labels."""


def check_metrics(downstream: DownstreamChoice, metrics: Sequence[MetricChoice]) -> None:
    """Check that a model's predictions can be scored.

    Raises:
        PluginError: a metric needs what the model does not predict, or compares sets of frames.
        DataError: a file that a metric reads is missing.
    """
    predicts = getattr(plugins.load_options(downstream).module, "PREDICTS", None)
    for choice in metrics:
        metric = plugins.load_options(choice)
        needed = metric.module.INPUT
        if needed == FEATURES:
            raise PluginError(
                f"metrics: expected metrics of predictions, got {choice.name!r}, which compares the features of two "
                "sets of frames; name it under distances"
            )
        if predicts is not None and needed not in predicts:
            raise PluginError(
                f"metrics: {choice.name!r} expected a downstream model that predicts {needed}, got "
                f"{downstream.name!r}, which predicts {', '.join(predicts) or 'nothing but features'}"
            )
        if hasattr(metric.module, "input_files"):
            metric.module.input_files(metric.options)


def check_distances(extractor: DownstreamChoice, distances: Sequence[MetricChoice]) -> None:
    """Check that sets of frames can be compared.

    Raises:
        PluginError: the extractor has no features, or a metric does not compare features.
    """
    if not hasattr(plugins.load_options(extractor).module, "features"):
        raise PluginError(f"feature_extractor: expected a model with features, got {extractor.name!r}, which has none")
    for choice in distances:
        needed = plugins.load_options(choice).module.INPUT
        if needed != FEATURES:
            raise PluginError(
                f"distances: expected metrics of features, got {choice.name!r}, which compares {needed}; "
                "name it under metrics"
            )
