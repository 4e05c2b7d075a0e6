"""Every flow as a deployment, asked for as its script is: a preset and options to change. `prefect.yaml` lists them.

A run happens in a process of a Prefect worker, on the worker's server, and keeps its state in the worker's home: its
CTLEV_HOME, else `.ctlev` in the folder that was deployed. The flows are those of the scripts, and so are the artefacts.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from prefect import Flow
from prefect.logging import get_run_logger

from ctlev_core.report.page.report_files import publish_report
from flows import baselines as of_baselines
from flows import compare as of_compare
from flows import evaluate as of_evaluate
from flows import export_events as of_export_events
from flows import full_experiment as of_full_experiment
from flows import prepare_dataset as of_prepare_dataset
from flows import pretrain as of_pretrain
from flows import realism_chain as of_realism_chain
from flows import regenerate as of_regenerate
from flows import speed_vs_error as of_speed_vs_error
from flows import synthesize as of_synthesize
from flows import train_generator as of_train_generator
from flows.command_line import check_home, load_experiment, publish_plan
from flows.memory_use import use_memory
from flows.preset_list import PRESETS, preset_names
from flows.settings import ScriptFlow, configure, flow, run_named
from flows.studies import load_study
from tasks.chain_report import publish_chain_report
from tasks.contact_sheet import publish_contact_sheet
from tasks.export_events import publish_events
from tasks.speed_report import publish_speed_report
from tasks.stage import planning
from tasks.store import Store

_ARGUMENTS = """

Args:
    preset: name of a bundled preset, or path of a .yaml file.
    overrides: options to change, each as `key=value`.
    home: folder of all state, or URL of a bucket; by default that of the worker.
"""


def _deployable(
    script_flow: ScriptFlow[..., Any],
    *,
    default_preset: str = "pose",
    load: Callable[[str, list[str]], Any] = load_experiment,
    presets: Path = PRESETS,
    publish: Callable[[Any, Path, str], str] | None = None,
) -> Flow[..., Any]:
    """A flow that does what a flow's script does, within the flow run that a worker has begun.

    Args:
        script_flow: a flow of one parameter, its options.
        default_preset: of the options.
        load: from a preset's name and overrides to the options.
        presets: folder of the presets to choose from.
        publish: puts the result where a person looks for it, and says where that is.
    """

    def run(preset: str = default_preset, overrides: tuple[str, ...] = (), home: str | None = None) -> Any:
        folder = configure(home)  # this process runs this one flow, and stages look there
        folder.mkdir(parents=True, exist_ok=True)
        check_home(folder)
        Store(folder).connect(send=True)
        options = load(preset, list(overrides))
        with planning() as rows:
            script_flow.fn(options)
        publish_plan(rows, f"{script_flow.name}, preset {preset}, in {folder}")
        use_memory(rows, folder)
        with run_named(script_flow.name, getattr(options, "name", "")):
            made = script_flow.fn(options)  # called as a flow it would be a second run of the same name within this one
        if publish is not None:
            get_run_logger().info(publish(made, folder, options.name))
        Store(folder).send_files()
        return made

    # A choice of the bundled presets, or the path of another.
    run.__annotations__["preset"] = Literal[tuple(preset_names(presets))] | str  # pyright: ignore[reportInvalidTypeForm]
    run.__name__ = script_flow.fn.__name__
    run.__doc__ = (inspect.getdoc(script_flow.fn) or "") + _ARGUMENTS
    return flow(name=script_flow.name)(run).of_prefect


full_experiment = _deployable(
    of_full_experiment.full_experiment, default_preset="demo", load=load_study, publish=publish_report
)
prepare_dataset = _deployable(
    of_prepare_dataset.prepare_dataset,
    publish=lambda made, folder, name: publish_contact_sheet(made.contact_sheet, folder, name),
)
train_generator = _deployable(of_train_generator.train_generator)
synthesize = _deployable(of_synthesize.synthesize, load=of_synthesize.load_synthesis)
regenerate = _deployable(of_regenerate.regenerate, load=of_regenerate.load_regeneration)
baselines = _deployable(of_baselines.baselines)
evaluate = _deployable(of_evaluate.evaluate)
compare = of_compare.compare.of_prefect
export_events = _deployable(of_export_events.export_streams, publish=publish_events)
speed_vs_error = _deployable(
    of_speed_vs_error.speed_vs_error,
    load=of_speed_vs_error.load_speed_vs_error,
    presets=PRESETS / "speed_vs_error",
    publish=publish_speed_report,
)
realism_chain = _deployable(
    of_realism_chain.realism_chain, load=of_realism_chain.load_realism_chain, publish=publish_chain_report
)
pretrain = _deployable(
    of_pretrain.pretrain,
    default_preset="small",
    load=of_pretrain.load_pretraining,
    presets=PRESETS / "pretraining",
)
