"""Where a generator loses realism: recorded frames sent through its parts, one after another.

python flows/realism_chain.py [--preset NAME] [--set key=value ...] [--dry-run]
"""

from __future__ import annotations

import json
import sys

from ctlev_core import plugins
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.plugins import PluginError
from data_contracts.config import SamplingChoice
from data_contracts.manifest import ManifestRef
from data_contracts.realism_chain import Link, RealismChain
from flows.cli import script
from flows.command_line import Command, load_experiment
from flows.prepare_dataset import prepare_dataset
from flows.sampling import decoder_options, smooth, train_decoder, without_solver
from flows.settings import flow
from flows.train_generator import train_generator, without_student
from tasks.chain_report import chain_report, publish_chain_report
from tasks.condition import condition_some_frames
from tasks.realism_chain import chain_frames, chain_realism
from tasks.stage import call_flow
from tasks.store import home_folder


def load_realism_chain(preset: str, overrides: list[str]) -> RealismChain:
    """The experiment a preset describes, and how its generator is taken apart: options `chain.NAME`.

    Raises:
        PluginError: unknown preset or option, or a generator that is no latent-diffusion model.
    """
    asked = load_experiment(preset, overrides, RealismChain)
    if not isinstance(plugins.load_options(asked.sampling_choice).options, SamplingOptions):
        raise PluginError(
            f"{preset}: expected a latent-diffusion generator, such as controlnet or stable_diffusion, which has an "
            f"autoencoder and a denoiser; got {asked.generator.name!r}"
        )
    num_timesteps = _num_timesteps(asked)
    for link in asked.links:
        plugins.load_options(sampling_of(asked, link))  # its number of steps is one that can be sampled with
        most = num_timesteps - (link.kind == "denoised")
        if link.amount > most:
            name = "time_steps" if link.kind == "denoised" else "num_inference_steps"
            raise PluginError(f"chain.{name}: expected at most {most}, as the noise schedule has; got {link.amount}")
    return asked


def _num_timesteps(asked: RealismChain) -> int:
    """Of the noise schedule that fine-tuning starts from, where a folder says it; it is 1,000 elsewhere."""
    generator = plugins.load_options(asked.generator)
    config = generator.module.base_model_folders(generator.options)[0] / "scheduler" / "scheduler_config.json"
    if not config.is_file():
        return 1000
    return int(json.loads(config.read_text(encoding="utf-8")).get("num_train_timesteps", 1000))


def sampling_of(asked: RealismChain, link: Link) -> SamplingChoice:
    """The sampling options that a link depends on: whole sampling has its own number of steps, the rest no solver."""
    choice = asked.sampling_choice if asked.pixel_decoder is None else smooth(asked.sampling_choice)
    if link.kind == "sampled":
        return choice.model_copy(update={"options": choice.options | {"num_inference_steps": link.amount}})
    return without_solver(choice)


@flow(name="realism-chain")
def realism_chain(asked: RealismChain) -> ManifestRef:
    """Send recorded frames through the parts of the tuned generator, and write the page with the table.

    The links follow one another: whole sampling takes all cores or devices by itself.
    """
    dataset, options = call_flow(prepare_dataset, asked), asked.chain
    split = asked.evaluate_on if options.split == "test" else options.split
    conditions = condition_some_frames(
        dataset.recordings,
        dataset.frames,
        condition=asked.condition,
        encoding=asked.encoding,
        split=split,
        count=options.num_frames,
        seed=options.seed,
        label=f"{asked.condition.name}, recorded frames of split {split}",
    )
    checkpoint = call_flow(train_generator, without_student(asked), dataset).tuned
    decoder = train_decoder(
        asked,
        checkpoint,
        dataset.frames,
        dataset.frame_conditions,
        sampling=asked.sampling_choice,
        label=asked.generator.name,
    )
    rounds = asked.rounding if decoder is None else asked.encoding
    processed = [
        chain_frames(
            checkpoint,
            dataset.frames,
            conditions,
            decoder,
            sampling=sampling_of(asked, link),
            link=link,
            rounding=None if link.kind in ("autoencoder", "values") else rounds,
            decoding=None if decoder is None else decoder_options(asked),
            seed=options.seed,
            label=f"{link.kind} {link.amount}" if link.amount else link.kind,
        )
        for link in asked.links
    ]
    measured = chain_realism(
        dataset.frames, conditions, processed, links=asked.links, seed=options.seed, label=asked.name
    )
    return chain_report(
        dataset.frames,
        measured,
        processed,
        links=asked.links,
        title=asked.name,
        notice=asked.data_notice,
        label=asked.name,
    )


COMMAND = Command(
    realism_chain,
    lambda made, asked: publish_chain_report(made, home_folder(), asked.name),
    load=load_realism_chain,
)


if __name__ == "__main__":
    sys.exit(script("realism-chain"))
