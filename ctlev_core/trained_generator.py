"""A generator that was trained by a run, to sample from in a script or a notebook."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ctlev_core import plugins
from ctlev_core.diffusion.motion_files import has_motion_layers
from ctlev_core.diffusion.pretrained.adapters import is_adapter, read_adapter
from ctlev_core.diffusion.sampling.options import OF_STUDENTS
from ctlev_core.diffusion.student_files import distilled_evaluations
from ctlev_core.pixel_decoder.options import DECODER_FOLDER
from ctlev_core.plugins import validate_options
from ctlev_core.provenance.records import Record, read_provenance
from ctlev_core.provenance.scores import GENERATOR_STAGES
from ctlev_core.seeds import check_seed, sample_seeds
from data_contracts.config import EncodingChoice
from data_contracts.errors import DataError
from data_contracts.home_folder import home_folder
from data_contracts.labels import Conditions
from data_contracts.manifest import RUN_FILE

CHECKPOINT = "checkpoint"
PROMPT = "A moving human"
"""What ControlNets are told, where nothing else is said."""


@dataclass(frozen=True)
class DecoderChoice:
    """A trained pixel decoder, and how a run used it.

    Attributes:
        folder: of its weights.
        options: `PixelDecoderOptions`, as a run recorded them.
        encoding: that of the recorded frames.
    """

    folder: Path
    options: dict[str, Any]
    encoding: EncodingChoice


class TrainedGenerator:
    """A checkpoint, and how to sample from it.

    Attributes:
        folder: of the checkpoint; of diffusion models an ordinary diffusers folder.
        name: of the plug-in in `ctlev_core/generators` that made it.
        decoder: draws the pixel values of what is sampled, where the run had one.
        defaults: options of sampling that the run had; none where only a folder is known.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        decoder: DecoderChoice | None = None,
        defaults: Mapping[str, Any] | None = None,
    ) -> None:
        self.folder, self.name, self.decoder, self.defaults = folder, name, decoder, dict(defaults or {})

    def __repr__(self) -> str:
        return f"TrainedGenerator({self.name!r}, {str(self.folder)!r})"

    def sample(
        self,
        prompts: str | Sequence[str] | None = None,
        *,
        images: npt.ArrayLike | None = None,
        seed: int = 0,
        lengths: Sequence[int] | None = None,
        **options: Any,
    ) -> np.ndarray:
        """Event images, one for each prompt or condition image.

        Args:
            prompts: texts, such as "A photo of cat"; one text serves all images.
            images: [N, H, W, 3] uint8 condition images, such as those of `skeleton_map` and `normal_map`, or one
                [H, W, 3]; for generators that are asked by pictures.
            seed: 0 or more; row i has the i-th seed that follows from it.
            lengths: rows of each stretch whose frames follow one another in time, in order, for a generator with motion
                layers or the option `noise="stretches"`; None = each frame is made by itself.
            options: the generator's `SampleOptions`, such as `num_inference_steps`, in place of those the run had;
                `ctlev options NAME` lists them.
        Returns:
            [N, H, W, 3] uint8.
        Raises:
            ValueError: nothing was asked for, numbers differ, the seed is none, or the generator takes something else.
            PluginError: an unknown or wrong option.
            DataError: the checkpoint is broken.
        """
        asked, seed = _conditions(prompts, images), check_seed(seed, "sample")
        module: Any = plugins.load("generators", self.name)
        defaults = dict(self.defaults)
        if "scheduler" in options:
            defaults.pop("timestep_spacing", None)  # each solver has its own
        if self.decoder is not None:
            defaults["black_threshold"] = 0
        options = defaults | options
        chosen = validate_options(module.SampleOptions, options, f"generators {self.name!r}")
        if lengths is not None:
            in_time = has_motion_layers(self.folder) or getattr(chosen, "noise", None) == "stretches"
            asked = replace(asked, stretches=self._stretches(lengths, len(asked), in_time))
        seeds = sample_seeds(seed, len(asked))
        with tempfile.TemporaryDirectory(prefix="ctlev_sample_") as work:
            frames = module.sample(self.folder, asked, chosen, seeds=seeds, work=Path(work))
        return frames if self.decoder is None else self._decoded(self.decoder, frames, asked, seeds, lengths)

    def _stretches(self, lengths: Sequence[int], count: int, in_time: bool) -> tuple[str, ...]:
        if not in_time:
            raise ValueError(
                f"{self.folder}: lengths are for a generator with motion layers, which this one has not, or for the "
                "option noise='stretches'"
            )
        if sum(lengths) != count or any(length < 1 for length in lengths):
            raise ValueError(f"lengths must be 1 or more and add up to the {count} rows, got {list(lengths)}")
        return tuple(str(number) for number, length in enumerate(lengths) for _ in range(length))

    def _decoded(
        self,
        choice: DecoderChoice,
        frames: np.ndarray,
        asked: Conditions,
        seeds: list[int],
        lengths: Sequence[int] | None,
    ) -> np.ndarray:
        from ctlev_core.pixel_decoder.decoder import open_decoder
        from ctlev_core.pixel_decoder.options import PixelDecoderOptions

        options = validate_options(PixelDecoderOptions, choice.options, f"pixel decoder {choice.folder}")
        decoder = open_decoder(choice.folder, options, plugins.load_options(choice.encoding))
        return np.stack(list(decoder.redraw(frames, asked.images, seeds, lengths)))


def load_generator(place: str | os.PathLike[str], home: str | os.PathLike[str] | None = None) -> TrainedGenerator:
    """The generator of a run, or of a folder.

    Args:
        place: name of a report, of a study STUDY/EXPERIMENT (the experiment's own generator, with its pixel decoder);
            the path of an artefact of the stage `finetune`, `train_motion_layers` or `distill`, or of a diffusers
            folder that training wrote.
        home: folder of all state, where `place` is a name, or URL of a bucket, of which what is in the cache of this
            machine is found; None = CTLEV_HOME, else `.ctlev`.
    Raises:
        DataError: there is no such run or folder, or it holds no generator.
    """
    path = Path(place).expanduser()
    if path.is_dir():
        return _of_folder(path.absolute())
    state = home_folder(home)
    report = state / "reports" / str(place)
    if not (report / "provenance.json").is_file():
        reports = state / "reports"
        known = sorted(one.parent.relative_to(reports).as_posix() for one in reports.rglob("provenance.json"))
        raise DataError(
            f"generator {str(place)!r}: is neither a folder nor a report of {state}, which has "
            f"{', '.join(known) or 'none'}; of a study name one of its experiments, as STUDY/EXPERIMENT"
        )
    records = read_provenance(report / "provenance.json")
    own = next(
        (one for one in records if one.role == "checkpoint of synthetic" and one.stage in GENERATOR_STAGES), None
    )
    if own is None:
        raise DataError(f"{report}: no generator was trained in this run")
    decoded = next((one for one in records if one.role == "frames of synthetic" and one.stage == "decode_pixels"), None)
    sampled = (one.arguments for one in records if one.stage == "sample")
    defaults = next((one["sampling"]["options"] for one in sampled if one["checkpoint"]["manifest"] == own.key), None)
    return _of_folder(
        _in_store(state, own.stage, own.key), None if decoded is None else _decoder_of(state, decoded), defaults
    )


def _in_store(state: Path, stage: str, key: str) -> Path:
    folder = state / "artefacts" / stage / key
    if not folder.is_dir():
        raise DataError(f"{folder}: is not in the store any more; run the experiment again")
    return folder


def _decoder_of(state: Path, decoded: Record) -> DecoderChoice:
    """What drew the synthetic frames of a run."""
    asked = decoded.arguments
    encoding = EncodingChoice(name=asked["encoding"]["plugin"].rpartition("/")[2], options=asked["encoding"]["options"])
    folder = _in_store(state, "train_pixel_decoder", asked["decoder"]["manifest"])
    return DecoderChoice(folder / DECODER_FOLDER, asked["options"], encoding)


def _of_folder(
    folder: Path, decoder: DecoderChoice | None = None, defaults: Mapping[str, Any] | None = None
) -> TrainedGenerator:
    """The generator of an artefact, or of the checkpoint alone."""
    if not (folder / RUN_FILE).is_file() and (folder.parent / RUN_FILE).is_file() and folder.name == CHECKPOINT:
        folder = folder.parent
    if (folder / RUN_FILE).is_file() and not has_motion_layers(folder / CHECKPOINT):
        try:
            arguments = json.loads((folder / RUN_FILE).read_text())["arguments"]
            plugin = (arguments.get("generator") or arguments["sampling"])["plugin"]
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise DataError(f"{folder}: is no artefact of the stage finetune") from error
        folder = folder / CHECKPOINT
        return TrainedGenerator(folder, plugin.rpartition("/")[2], decoder, defaults or _defaults_of(folder))
    if (folder / RUN_FILE).is_file():
        folder = folder / CHECKPOINT
    if not (folder / "model_index.json").is_file() and not is_adapter(folder):
        raise DataError(
            f"{folder}: expected an artefact of the stage finetune or a diffusers folder; no model_index.json"
        )
    told = read_adapter(folder).with_controlnet if is_adapter(folder) else None
    name = "controlnet" if told or (told is None and (folder / "controlnet").is_dir()) else "stable_diffusion"
    return TrainedGenerator(folder, name, decoder, defaults or _defaults_of(folder))


def _defaults_of(folder: Path) -> dict[str, Any]:
    """Students are sampled in one way alone."""
    number = distilled_evaluations(folder)
    return {} if number is None else {"scheduler": OF_STUDENTS, "num_inference_steps": number}


def _conditions(prompts: str | Sequence[str] | None, images: npt.ArrayLike | None) -> Conditions:
    pictures = None if images is None else np.asarray(images)
    if pictures is not None and pictures.ndim == 3:
        pictures = pictures[None]
    if pictures is not None and (pictures.ndim != 4 or pictures.shape[3] != 3 or pictures.dtype != np.uint8):
        raise ValueError(f"images must be [N, H, W, 3] uint8, got {pictures.shape} {pictures.dtype}")
    count = None if pictures is None else len(pictures)
    if prompts is None and count is None:
        raise ValueError("sample: expected prompts, or images to be conditioned on")
    if isinstance(prompts, str | None):
        texts = [PROMPT if prompts is None else prompts] * (1 if count is None else count)
    else:
        texts = list(prompts)
    if not texts:
        raise ValueError("sample: nothing was asked for, got no prompt and no image")
    if count is not None and len(texts) != count:
        raise ValueError(f"sample: {len(texts)} prompts for {count} images")
    return Conditions(tuple(texts), pictures)
