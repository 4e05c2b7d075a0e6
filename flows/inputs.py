"""What experiments need from outside the store, looked for all at once: one look says everything that is missing."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ctlev_core import plugins
from ctlev_core.events.files import check_complete
from ctlev_core.events.image_grid import ImageFit
from ctlev_core.events.windows import spread
from ctlev_core.plugin_contracts import (
    ConditionOfClasses,
    Dataset,
    Generator,
    GeneratorFromWeights,
    MetricOfRows,
    PluginWithFiles,
)
from ctlev_core.plugins import PluginError
from ctlev_core.scoring.checks import check_dataset
from data_contracts.config import Choice, ConditionChoice, DatasetChoice
from data_contracts.errors import DataError
from data_contracts.experiment import Experiment
from data_contracts.study import Study

MAX_OPENED = 20_000
"""Files that a dry run opens: half a minute on a busy disk."""
MAX_LISTED = 20


class InputsMissing(PluginError):
    """Options, files or folders are missing or wrong.

    Attributes:
        asked: the experiment or study that needs them.
    """

    def __init__(self, problems: list[str], asked: Experiment | Study) -> None:
        self.asked = asked
        listed = "".join("\n  - " + problem.replace("\n", "\n    ") for problem in problems)
        # Each is short; of a study there may be many, and all are to be seen at once.
        all_of_them = problems[0] if len(problems) == 1 else f"{len(problems)} inputs are missing or wrong:{listed}"
        super().__init__(all_of_them, limit=len(all_of_them))


def check_inputs(asked: Experiment | Study, *, thoroughly: bool = False) -> None:
    """Raise `InputsMissing` unless every plug-in is there, its options are right, and datasets have what is needed.

    The labels of one test recording are read, to see whether the metrics can use them.

    Whether all files are there is seen where stages are planned, which reads folders once; here they are only looked
    for when something is wrong already, so that the error names them all.
    """
    experiments = asked.experiments if isinstance(asked, Study) else {"": asked}
    try:
        for experiment in experiments.values():
            for choice in experiment.choices:
                plugins.load_options(choice)
            for check in CHECKS:
                check(experiment)
    except (PluginError, DataError) as error:
        # What is found by looking again need not be what was found first: folders change.
        raise InputsMissing(_problems(experiments) or [str(error)], asked) from error
    if thoroughly and (problems := _problems(experiments)):
        raise InputsMissing(problems, asked)


def check_recordings(asked: Experiment | Study) -> None:
    """Raise `InputsMissing` where files of recordings are cut, as far as can be told without decoding them.

    It opens every file, which a run does later anyway; of more than `MAX_OPENED` files so many, evenly spread.
    """
    experiments = asked.experiments.values() if isinstance(asked, Study) else [asked]
    files: dict[Path, None] = {}
    for choice in (choice for experiment in experiments for choice in experiment.choices):
        plugin = plugins.load_options(choice)
        if isinstance(plugin.module, Dataset):
            for recording in plugin.module.list_recordings(plugin.options):
                files |= dict.fromkeys(recording.files)
    listed = list(files)
    problems = []
    for number in spread(len(listed), MAX_OPENED).tolist():
        try:
            check_complete(listed[number])
        except (DataError, OSError) as error:
            problems.append(str(error))
    if len(problems) > MAX_LISTED:
        problems[MAX_LISTED:] = [f"and {len(problems) - MAX_LISTED} more files"]
    if problems:
        raise InputsMissing(problems, asked)


def _problems(experiments: Mapping[str, Experiment]) -> list[str]:
    """Every problem once, with the experiments of a study that have it."""
    found: dict[str, list[str]] = {}
    for name, experiment in experiments.items():
        for choice in experiment.choices:
            try:
                _look_for(choice)
            except (PluginError, DataError, OSError) as error:
                found.setdefault(str(error), []).append(name)
        for check in CHECKS:
            try:
                check(experiment)
            except (PluginError, DataError, OSError) as error:
                found.setdefault(str(error), []).append(name)
    listed = []
    for problem, names in found.items():
        of = ", ".join(dict.fromkeys(names))
        listed.append(f"{of}: {problem}" if of else _name_option(problem, experiments[""]))
    return listed


def _name_option(problem: str, experiment: Experiment) -> str:
    """`--set ...root=PATH` with the whole name of the option: plug-ins do not know what an experiment has them for."""
    for field in type(experiment).model_fields:
        choice = getattr(experiment, field)
        if isinstance(choice, Choice) and problem.startswith(f"{choice.KIND} {choice.name!r}: "):
            return problem.replace("--set ...", f"--set {field}.options.")
    return problem


def _look_for(choice: Choice) -> None:
    """Load a plug-in, and let it look for its files."""
    plugin = plugins.load_options(choice)
    if isinstance(plugin.module, Dataset):
        plugin.module.list_recordings(plugin.options)
    elif isinstance(plugin.module, Generator):
        if choice.OPTIONS == "Options":
            plugin.module.base_model_folders(plugin.options)
    elif choice.KIND != "generators" and isinstance(plugin.module, PluginWithFiles):
        plugin.module.input_files(plugin.options)


def _check_labels(experiment: Experiment) -> None:
    check_dataset(experiment.metrics, experiment.tested_dataset, experiment.evaluate_on)


def _check_counts(experiment: Experiment) -> None:
    asking = {
        "stochastic_rounding": experiment.stochastic_rounding,
        "export": experiment.export is not None,
    }
    for what, is_asked in asking.items():
        if is_asked:
            check_whole_counts(experiment, what)


def check_whole_counts(experiment: Experiment, what: str) -> None:
    """Raise `PluginError` where event images of the dataset will not show whole counts, which `what` needs."""
    plugin, encoding = plugins.load_options(experiment.dataset), plugins.load_options(experiment.encoding).options
    recordings = plugin.module.list_recordings(plugin.options)
    finished = [one.recording_id for one in recordings if one.has_event_images and not one.has_events]
    if finished:
        raise PluginError(f"{what} needs events, and {finished[0]} comes as finished event images")
    if not isinstance(encoding, ImageFit) or encoding.image_size is None or encoding.resampling != "area":
        return
    image_size = encoding.image_size
    # A sensor whose size only its files tell may have that of the image; with `events` it comes to the same.
    other = [one for one in recordings if one.has_events and one.sensor_size != image_size]
    if other:
        size = other[0].sensor_size
        sensor = f"sensors of {size[0]} x {size[1]} px" if size else "sensors whose sizes only their files tell"
        raise PluginError(
            f"{what} needs whole counts of image pixels, and images of {image_size[0]} x {image_size[1]} px are "
            f"averages over areas of {sensor}: set encoding.options.resampling=events, or no "
            "encoding.options.image_size"
        )


def _check_intensity(experiment: Experiment) -> None:
    """Raise `PluginError` where a condition needs intensity frames and a dataset has none, before anything is read."""
    for name, (condition, poses) in _conditions(experiment).items():
        if plugins.load("conditions", condition.name).NEEDS != "intensity":
            continue
        for dataset in (experiment.dataset, poses):
            if dataset is None:
                continue
            for part, choice in _learnt_from(experiment, name, dataset).items():
                if not _has_intensity(choice):
                    of = f"part {part!r}, " if part else ""
                    hint = "; name another by `part` of the baseline" if part and name != "condition" else ""
                    raise PluginError(
                        f"{name}: needs intensity frames, and {of}dataset {choice.name!r} with these options has none"
                        f"{hint}"
                    )


def _check_displacements(experiment: Experiment) -> None:
    """Raise `PluginError` where it cannot be told where joints come from and go to: that is told by labels in 2D."""
    for name, (condition, poses) in _conditions(experiment).items():
        if plugins.load("conditions", condition.name).NEEDS != "displacement":
            continue
        if experiment.view == "new":
            raise PluginError(
                f"{name}: {condition.name!r} shows the motion that the labelled view sees, not view 'new'"
            )
        if poses is not None:
            plugin = plugins.load_options(poses)
            first = plugin.module.list_recordings(plugin.options)[0]
            if plugin.module.read_labels(first, plugin.options).joints2d is None:
                raise PluginError(f"{name}: {condition.name!r} needs joints2d, and dataset {poses.name!r} has none")


def _check_chosen_labels(experiment: Experiment) -> None:
    """Raise `DataError` where labels are chosen by their poses, and there is nothing to choose from or by."""
    chosen = [(experiment.labels, experiment.poses)]
    chosen += [
        (experiment.labels_of(name), one.poses or experiment.poses) for name, one in experiment.baselines.items()
    ]
    for labels, poses in chosen:
        if labels == "random":
            continue
        choice = poses or experiment.dataset
        plugin = plugins.load_options(choice)
        recordings = plugin.module.list_recordings(plugin.options)
        label_only = [one for one in recordings if any(part.split == "condition" for part in one.parts)]
        where = f"labels {labels!r}: dataset {choice.name!r} with these options has no"
        if not label_only:
            raise DataError(f"{where} recordings of split 'condition' to choose from; use 'random'")
        found = plugin.module.read_labels(label_only[0], plugin.options)
        if found.joints2d is None and found.joints3d is None and found.smpl_pose is None:
            raise DataError(f"{where} joints or bodies, by which labels are chosen; use 'random'")


def _check_scores_of_frames(experiment: Experiment) -> None:
    """Raise `PluginError` where frames or labels are chosen by a metric that has no score of a single frame."""
    by_hard = "hard" in (experiment.labels, *(experiment.labels_of(name) for name in experiment.baselines))
    metric = plugins.load_options(experiment.metrics[0])
    for what, asked in (("labels 'hard'", by_hard), ("keep_fraction", experiment.keep_fraction is not None)):
        if asked and not isinstance(metric.module, MetricOfRows):
            raise PluginError(f"{what}: metric {metric.name!r} has no score of single frames to choose by")


def _check_values(experiment: Experiment) -> None:
    """Raise `PluginError` where samples take values as training frames have them, which nothing has learnt."""
    if experiment.pixel_decoder is not None:  # draws them itself, which `flows.sampling` says
        return
    for name, asked in {None: experiment, **experiment.baselines}.items():
        values = getattr(plugins.load_options(asked.sampling_choice).options, "values", "expected")
        values_at = getattr(plugins.load_options(asked.generator).options, "values_at", None)
        if values != "expected" and values_at == 0:
            before = "" if name is None else f"baselines.{name}."
            raise PluginError(
                f"{before}sampling.values={values} needs a generator of the text route that learnt its values: set "
                f"{before}generator.options.values_at above 0"
            )


def _check_classes(experiment: Experiment) -> None:
    """Raise `DataError` where a condition has nothing to show of a class that is to be sampled."""
    for condition, poses in _conditions(experiment).values():
        plugin = plugins.load_options(condition)
        if isinstance(plugin.module, ConditionOfClasses):
            dataset = plugins.load_options(poses or experiment.dataset)
            recordings = dataset.module.list_recordings(dataset.options)
            names = {recording.class_name for recording in recordings if recording.class_name}
            plugin.module.check_classes(names, plugin.options)


def _check_labels_kept(experiment: Experiment) -> None:
    """Raise `DataError` where frames would be made that show the class they are asked for, and none of its joints."""
    predicts = set(plugins.load("downstream", experiment.downstream.name).PREDICTS) - {"classes"}
    makers = {"generator": experiment.generator}
    makers |= {f"baselines.{name}": baseline.generator for name, baseline in experiment.baselines.items()}
    for where, choice in makers.items():
        if predicts and getattr(plugins.load("generators", choice.name), "KEEPS_CLASSES_ALONE", False):
            raise DataError(
                f"{where}: {choice.name!r} makes frames of a class, whose {', '.join(sorted(predicts))} are those of "
                f"another frame; it is for models of classes, not for {experiment.downstream.name!r}"
            )


def check_num_classes(experiment: Experiment) -> None:
    """Raise `DataError` where a classifier would have a single class to learn, as far as recordings name classes.

    Generators learn from one class as well, so that it is not asked of what is only sampled.
    """
    for choice in (experiment.downstream, experiment.feature_extractor):
        if choice is None or "classes" not in plugins.load("downstream", choice.name).PREDICTS:
            continue
        dataset = plugins.load_options(experiment.dataset)
        recordings = dataset.module.list_recordings(dataset.options)
        classes = {one.class_name for one in recordings if any(part.split == "train" for part in one.parts)}
        if len(classes) == 1 and "" not in classes:
            raise DataError(
                f"dataset {dataset.name!r}: {choice.name} needs at least two classes, got {classes.pop()!r} alone"
            )


def _check_base_models(experiment: Experiment) -> None:
    """Raise `DataError` where event images or conditions do not fit the weights a generator starts from."""
    encoding = plugins.load_options(experiment.encoding).options
    image_size = encoding.image_size if isinstance(encoding, ImageFit) else None
    used = [(experiment.generator, experiment.condition)]
    used += [(baseline.generator, baseline.condition) for baseline in experiment.baselines.values()]
    for generator, condition in used:
        plugin = plugins.load_options(generator)
        if not isinstance(plugin.module, GeneratorFromWeights):
            continue
        base_model = plugin.options.base_model
        # What is not there is told by the plan, and what the experiment makes itself is made to fit.
        if (base_model is None and experiment.base_model) or (base_model and not base_model.exists()):
            continue
        plugin.module.check_fit(plugin.options, image_size, condition)


def _conditions(experiment: Experiment) -> dict[str, tuple[ConditionChoice, DatasetChoice | None]]:
    """The conditions of an experiment by their settings, and what else than its own dataset labels are taken from."""
    asked = experiment.poses or experiment.target
    found = {"condition": (experiment.condition, asked)}
    for name, baseline in experiment.baselines.items():
        found[f"baselines.{name}.condition"] = baseline.condition, baseline.poses or asked
    return found


def _learnt_from(experiment: Experiment, name: str, dataset: DatasetChoice) -> dict[str, DatasetChoice]:
    """The dataset; of a union its parts, or the one that the baseline of the setting `name` learns from."""
    if dataset.name != "union":
        return {"": dataset}
    parts = plugins.load_options(dataset).options.parts
    baseline = experiment.baselines.get(name.removeprefix("baselines.").removesuffix(".condition"))
    return parts if baseline is None or baseline.part is None else {baseline.part: parts[baseline.part]}


def _has_intensity(dataset: DatasetChoice) -> bool:
    plugin = plugins.load_options(dataset)
    return any(recording.has_intensity for recording in plugin.module.list_recordings(plugin.options))


CHECKS = (
    _check_intensity,
    _check_displacements,
    _check_labels,
    _check_chosen_labels,
    _check_scores_of_frames,
    _check_values,
    _check_counts,
    _check_classes,
    _check_labels_kept,
    _check_base_models,
)
