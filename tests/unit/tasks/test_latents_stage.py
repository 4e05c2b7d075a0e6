"""Latents as a stage: the same weights after training to the last bit, encoded once, resumed, in bounded memory."""

import tracemalloc
import types

import numpy as np
import pyarrow as pa
import pytest
import torch
from safetensors.torch import load_file
from sd1_latent_tiny import FOLDER as TINY_SD1_WEIGHTS
from sd1_latent_tiny import tiny_autoencoder
from tiny_stable_diffusion import SIDE, make_models, tiny_changes, write_folder

from ctlev_core.diffusion.pretrained.loading import images_to_tensor
from ctlev_core.diffusion.training import latent_files
from ctlev_core.diffusion.training.latent_choice import choose_latents
from ctlev_core.diffusion.training.options import FineTuningOptions, LatentOptions
from data_contracts import tables
from data_contracts.config import GeneratorChoice
from data_contracts.errors import DataError
from data_contracts.experiment import Experiment
from data_contracts.image_rows import ImageRows
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, label_columns, read_manifest, write_manifest
from data_contracts.run_record import read_run_record
from flows.command_line import PRESETS, load_preset
from flows.evaluate import evaluate
from tasks.finetune import finetune
from tasks.latents import encode_latents
from tasks.stage import call_flow, planning
from tasks.store import Store

TRAIN, TEST = 70, 3


@pytest.fixture(scope="module")
def base_model(tmp_path_factory):
    return write_folder(make_models(tiny_changes()), tmp_path_factory.mktemp("base_model") / "sd")


def written(folder, schema, columns, **arrays):
    folder.mkdir(parents=True)
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    return write_manifest(folder, pa.table(columns), schema)


@pytest.fixture
def inputs(home):
    """Frames, of which every tenth or so is a test frame, and conditions of the training frames."""
    random, count = np.random.default_rng(0), TRAIN + TEST
    splits = ["test" if row in (0, 20, 71) else "train" for row in range(count)]
    names = [f"r:{split}:{row:05d}" for row, split in enumerate(splits)]
    learnt = [row for row, split in enumerate(splits) if split == "train"]
    times = dict.fromkeys(("t_start_us", "t_end_us"), pa.array([1] * count, pa.int64()))
    labels = label_columns(Labels(("",) * count, np.zeros(count, np.int64)))
    same = {"subject": ["s"] * count, "class_name": [""] * count, **times, **labels}
    frames = {"sample_id": names, "recording_id": ["r"] * count, "split": splits, **same}
    frames["num_events"] = frames["t_us"] = pa.array([1] * count, pa.int64())
    asked = {"sample_id": names, "source_id": names, "prompt": ["a moving human"] * count, **same}
    images = random.integers(0, 256, (2, count, SIDE, SIDE, 3), np.uint8)
    artefacts = home / "artefacts"
    return (
        written(artefacts / "encode" / ("a" * 32), tables.FRAMES, frames, frames=images[0]),
        written(
            artefacts / "condition_frames" / ("b" * 32), tables.CONDITIONS,
            {name: pa.array(column).take(pa.array(learnt)) for name, column in asked.items()}, images=images[1][learnt],
        ),
    )  # fmt: skip


def run(stage, *inputs, **settings):
    bound = stage.signature.bind(None, *inputs, **settings)
    bound.apply_defaults()
    arguments = dict(list(bound.arguments.items())[1:])
    return stage.run(stage.key(arguments, Store()), arguments)[0]


def choice(base_model, **changes):
    options = {
        "base_model": str(base_model), "controlnet": f"{base_model}-controlnet", "num_steps": 2, "batch_size": 4,
        "device": "cpu", "num_validation": 4, "validation_every": 1, "gradient_accumulation": 2,
    }  # fmt: skip
    return GeneratorChoice(name="controlnet", options=options | changes)


def weights(artefact, name="controlnet"):
    return load_file(artefact.path / "checkpoint" / name / "diffusion_pytorch_model.safetensors")


def trained_with_and_without(monkeypatch, tmp_path, inputs, generator, latents):
    """Checkpoints of two homes, for both have one key; in the second nothing may be encoded."""
    plain = run(finetune, *inputs, generator=generator, seed=3)
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path / "other"))
    if generator.options.get("num_processes", 1) == 1:
        monkeypatch.setattr(latent_files, "encode_posterior", refuse)
    return plain, run(finetune, *inputs, None, latents, generator=generator, seed=3)


def refuse(vae, images):
    raise AssertionError("encoded again")


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(
    "changes",
    [
        {},
        pytest.param({"rot90_probability": 0.7}, marks=pytest.mark.slow),
        pytest.param({"num_processes": 2, "rot90_probability": 0.7}, marks=pytest.mark.slow),
    ],
)
def test_weights_are_the_same_to_the_last_bit(base_model, inputs, changes, monkeypatch, tmp_path):
    monkeypatch.setattr(latent_files, "FILE_FRAMES", 32)
    generator = choice(base_model, **changes)
    options = LatentOptions(base_model=base_model, device="cpu", num_turns=4 if "rot90_probability" in changes else 1)
    latents = run(encode_latents, inputs[0], latents=options)
    manifest = read_manifest(latents)
    assert len(manifest) == TRAIN * options.num_turns and {f"std_{number:04d}.npy" for number in range(3)} <= set(
        manifest.files
    )
    plain, stored = trained_with_and_without(monkeypatch, tmp_path, inputs, generator, latents)
    assert plain.key == stored.key
    assert read_manifest(plain).table.equals(read_manifest(stored).table)
    for name in ("controlnet", "unet", "vae"):
        one, two = weights(plain, name), weights(stored, name)
        assert all(torch.equal(one[key], two[key]) for key in one) and set(one) == set(two)
    record = read_run_record(stored.path)
    assert "latents" not in record.arguments and latents.key not in record.upstream


@pytest.mark.usefixtures("one_thread")
def test_a_run_that_was_killed_goes_on_with_the_file_it_was_at(base_model, inputs, monkeypatch):
    monkeypatch.setattr(latent_files, "FILE_FRAMES", 32)
    encode, encoded = latent_files.encode_posterior, []

    def killed(vae, images):
        encoded.append(len(images))
        if len(encoded) == 2:
            raise KeyboardInterrupt
        return encode(vae, images)

    monkeypatch.setattr(latent_files, "encode_posterior", killed)
    options = LatentOptions(base_model=base_model, device="cpu")
    with pytest.raises(KeyboardInterrupt):
        run(encode_latents, inputs[0], latents=options)
    made = run(encode_latents, inputs[0], latents=options)
    assert encoded == [32, 32, 32, TRAIN - 64]
    assert not list((Store().home / "work").glob("*"))
    whole = latent_files.latents_in_memory(
        latent_files_vae(base_model), read_manifest(inputs[0]).array("frames")[train_rows(inputs[0])], 1
    )
    names = read_manifest(inputs[1]).column("sample_id")[::-1]
    stored = latent_files.stored_latents(read_manifest(made), names, 1)
    assert whole.std is not None and stored.std is not None
    np.testing.assert_array_equal(np.asarray(stored.mean)[::-1], whole.mean)
    np.testing.assert_array_equal(np.asarray(stored.std)[::-1], whole.std)
    with pytest.raises(DataError, match="expected latents of every frame and turn, got none of"):
        latent_files.stored_latents(read_manifest(made), names, 4)


def latent_files_vae(base_model):
    from ctlev_core.diffusion.pretrained.loading import load_autoencoder

    return load_autoencoder(base_model)


def train_rows(frames):
    return read_manifest(frames).rows_where(split="train")


def test_the_key_is_of_frames_and_autoencoder_alone(base_model, inputs, tmp_path):
    def key(**changes):
        with planning() as rows:
            encode_latents(inputs[0], latents=LatentOptions(**{"base_model": base_model} | changes))
        return rows[0].key

    first = key()
    assert key(device="cpu") == first and key(num_turns=4) != first
    models = make_models(tiny_changes(), seed=1)
    models["vae"] = make_models(tiny_changes())["vae"]
    assert key(base_model=write_folder(models, tmp_path / "other_networks")) == first
    assert key(base_model=write_folder(make_models(tiny_changes(), seed=1), tmp_path / "all_others")) != first


def test_frames_that_do_not_fit_are_refused(base_model, inputs, monkeypatch):
    options = LatentOptions(base_model=base_model, device="cpu")
    wide = ImageRows.of([(np.zeros((2, 8, 9, 3), np.uint8), np.arange(2))])
    with (
        monkeypatch.context() as patch,
        pytest.raises(DataError, match="makes images of 32 x 32 px, event images are 9"),
    ):
        patch.setattr(Manifest, "images", lambda self, rows: wide)
        run(encode_latents, inputs[0], latents=options)
    encode = latent_files.encode_posterior

    def broken(vae, images):
        mean, std = encode(vae, images)
        mean[5] = torch.nan
        return mean, std

    monkeypatch.setattr(latent_files, "encode_posterior", broken)
    with pytest.raises(DataError, match=f"frame 5 of {TRAIN}: the mean of its latents must be finite"):
        run(encode_latents, inputs[0], latents=options)


def test_only_a_learned_autoencoder_has_the_stage(base_model):
    assert choose_latents(FineTuningOptions()) is None
    bundled = PRESETS.parents[1] / "ctlev_core" / "base_models" / "small"
    assert choose_latents(FineTuningOptions(base_model=bundled)) is None
    assert choose_latents(FineTuningOptions(base_model=base_model / "absent")) is None
    found = choose_latents(FineTuningOptions(base_model=base_model, rot90_probability=0.1, device="cuda:1"))
    assert found == LatentOptions(base_model=base_model, device="cuda:1", num_turns=4)
    assert choose_latents(FineTuningOptions.model_validate({"base_model": base_model, "moves": {"shift": 0.1}})) is None


def planned(base_model, *overrides):
    given = [
        "encoding.options.image_size=[32,32]", "encoding.options.resampling=area", "stochastic_rounding=false",
        "export=null", "num_generators=2", "pixel_decoder=null", "baselines={}",
        *([f"generator.options.base_model={base_model}", f"generator.options.controlnet={base_model}-controlnet"]
          if base_model else []),
        *overrides,
    ]  # fmt: skip
    with planning() as rows:
        call_flow(evaluate, load_preset(Experiment, PRESETS, "smoke", given))
    return rows


def test_fine_tunings_share_it_and_a_checkpoint_that_is_there_needs_none(base_model, home, monkeypatch):
    rows = planned(base_model)
    (latents,) = {row.key for row in rows if row.stage == "encode_latents"}
    trained = {row.key for row in rows if row.stage == "finetune"}
    assert len(trained) == 2
    longer = planned(base_model, "generator.options.num_steps=7")
    assert {row.key for row in longer if row.stage == "encode_latents"} == {latents}
    assert not {row.key for row in longer if row.stage == "finetune"} & trained
    assert not [row for row in planned(None) if row.stage == "encode_latents"]
    monkeypatch.setattr(type(finetune), "is_made", lambda self, *inputs, **settings: True)
    assert not [row for row in planned(base_model) if row.stage == "encode_latents"]


def test_memory_does_not_grow_with_the_frames(tmp_path):
    """10,000 frames of 64 px are 123 MB, and their latents another 61."""

    def encode(images):
        mean = torch.nn.functional.avg_pool2d(images, 4)
        return types.SimpleNamespace(latent_dist=types.SimpleNamespace(mean=mean, std=mean * 0 + 1))

    config = types.SimpleNamespace(scaling_factor=1.0)
    vae = types.SimpleNamespace(encode=encode, device="cpu", dtype=torch.float32, state_dict=dict, config=config)
    frames = np.lib.format.open_memmap(tmp_path / "frames.npy", "w+", np.uint8, (10_000, 64, 64, 3))
    rows = ImageRows.of([(frames, np.arange(len(frames)))], "content")
    tracemalloc.start()
    try:
        files = latent_files.write_latent_files(vae, rows, 1, tmp_path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 40 * 2**20
    assert sum(len(own) for own, _ in files) == len(frames)
    assert len(files) == -(-len(frames) // latent_files.FILE_FRAMES)


@pytest.mark.skipif(not TINY_SD1_WEIGHTS.is_dir(), reason="the tiny autoencoder is not beside this checkout")
def test_latents_of_stable_diffusions_space_are_those_of_a_direct_call(tmp_path):
    frames = np.random.default_rng(1).integers(0, 256, (3, 64, 64, 3), np.uint8)
    vae = tiny_autoencoder()
    ((rows, files),) = latent_files.write_latent_files(vae, frames, 1, tmp_path)
    assert set(files) == {"mean"} and rows == range(3), "it has no deviations"
    with torch.no_grad():
        direct = vae.encode(images_to_tensor(frames)).latent_dist.mean
    np.testing.assert_array_equal(np.load(files["mean"]), direct.numpy())
