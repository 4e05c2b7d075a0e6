"""The stage that samples frames: the quality filter before them, tries that are counted, rows that can be made again
alone."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
from tiny_base_model import make_data, shared_base_model

from ctlev_core import plugins
from ctlev_core.diffusion.sampling import sampling
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.postprocessing.quality_filter import find_causes, fit_quality_filter, seed_of_attempt
from ctlev_core.seeds import sample_seeds
from data_contracts import tables
from data_contracts.arrays import save_compressed
from data_contracts.config import SamplingChoice
from data_contracts.file_lists import file_digest
from data_contracts.labels import Conditions, Labels
from data_contracts.manifest import Manifest, conditions_of, label_columns, read_manifest, write_manifest
from tasks import sample as task
from tasks.stage import Output

OPTIONS = SamplingOptions(num_inference_steps=2, palette="grey", batch_size=2)
COUNT, SEED = 6, 3


def draw(conditions: Conditions, seeds, work) -> np.ndarray:
    """Noise of the random base model; where the seed is odd, nothing."""
    frames = sampling.sample_frames(shared_base_model(), conditions, OPTIONS, seeds=seeds, work=work)
    frames[np.array(seeds) % 2 == 1] = 0
    return frames


@pytest.fixture(autouse=True)
def generator(monkeypatch):
    def sample(folder, conditions, options, *, seeds, work):
        assert folder.name == "checkpoint"
        return draw(conditions, seeds, work)

    plugin = plugins.Plugin("generators", "tiny", SimpleNamespace(sample=sample, VERSION=1), OPTIONS)
    monkeypatch.setattr(task.plugins, "load_options", lambda choice: plugin)


def write_frames(folder, frames: np.ndarray) -> Manifest:
    folder.mkdir()
    count = len(frames)
    np.save(folder / "frames.npy", frames)
    table = pa.table(
        {
            "sample_id": [f"f{row}" for row in range(count)],
            "recording_id": [f"r{row}" for row in range(count)],
            "subject": ["s"] * count,
            "split": ["train"] * (count - 1) + ["test"],
            "class_name": ["walk"] * count,
            **{name: pa.array([1] * count, pa.int64()) for name in ("t_start_us", "t_end_us", "t_us", "num_events")},
            **label_columns(Labels(("walk",) * count, np.arange(count))),
        }
    )
    return read_manifest(write_manifest(folder, table.select(tables.FRAMES.arrow().names), tables.FRAMES))


def write_conditions(folder) -> Manifest:
    folder.mkdir()
    images, conditions = make_data(COUNT)  # whose condition images are the frames
    np.save(folder / "images.npy", images)
    names = [f"c{row}" for row in range(COUNT)]
    joints = np.arange(COUNT * 26, dtype=np.float32).reshape(COUNT, 13, 2)
    labels = Labels(("walk",) * COUNT, np.arange(COUNT), joints, np.ones((COUNT, 13), bool), "dhp19")
    table = pa.table(
        {
            **{name: names for name in ("sample_id", "source_id", "subject", "class_name")},
            "prompt": pa.array(conditions.prompts, pa.string()),
            **{name: pa.array([1] * COUNT, pa.int64()) for name in ("t_start_us", "t_end_us")},
            **label_columns(labels),
        }
    )
    return read_manifest(write_manifest(folder, table.select(tables.CONDITIONS.arrow().names), tables.CONDITIONS))


@pytest.fixture
def inputs(tmp_path):
    """A checkpoint, recorded frames like those the generator draws, and conditions."""
    _, other = make_data(8, seed=1)
    real = draw(other, [2 * row for row in range(8)], tmp_path / "real_work")
    frames = write_frames(tmp_path / "frames", real)
    return frames, frames, write_conditions(tmp_path / "conditions")


def run(tmp_path, inputs, name="out", max_attempts=20) -> Manifest:
    folder, work = tmp_path / name, tmp_path / f"{name}_work"
    folder.mkdir()
    work.mkdir(exist_ok=True)
    table = task.sample.function(
        Output(folder, work), *inputs, sampling=SamplingChoice(name="tiny"), max_attempts=max_attempts, seed=SEED
    )
    return read_manifest(write_manifest(folder, table, tables.SYNTHETIC))


def test_refused_rows_are_sampled_again_and_every_row_can_be_made_alone(tmp_path, inputs):
    made = run(tmp_path, inputs)
    first, used, tries = sample_seeds(SEED, COUNT), made.column("seed"), made.column("num_attempts")
    assert min(tries) == 1 < max(tries), "some rows must pass at once and others not"
    assert used == [seed_of_attempt(seed, number - 1) for seed, number in zip(first, tries, strict=True)]
    assert made.column("rejected") == [""] * COUNT and not any(seed % 2 for seed in used)
    asked = conditions_of(inputs[2])
    for row, seed in enumerate(used):
        alone = draw(asked.take(slice(row, row + 1)), [seed], tmp_path / f"alone_{row}")
        # Convolutions may round otherwise in batches of another size; by one level at most.
        assert np.abs(alone[0].astype(int) - made.array("frames")[row]).max() <= 1
    np.testing.assert_array_equal(made.labels.joints2d, inputs[2].labels.joints2d)


def test_rows_that_never_pass_keep_their_last_frame_and_say_why(tmp_path, inputs):
    made = run(tmp_path, inputs, max_attempts=1)
    refused = np.array([bool(cause) for cause in made.column("rejected")])
    np.testing.assert_array_equal(refused, np.array(sample_seeds(SEED, COUNT)) % 2 == 1)
    assert made.column("num_attempts") == [1] * COUNT and made.column("seed") == sample_seeds(SEED, COUNT)
    assert all(cause.startswith("empty: active_share 0, expected") for cause in made.column("rejected") if cause)
    assert not made.array("frames")[refused].any() and made.array("frames")[~refused].any()


def test_a_run_killed_in_a_later_try_goes_on_from_what_it_sampled(tmp_path, inputs, monkeypatch):
    whole = run(tmp_path, inputs, "whole")
    original, counted = sampling.sample_latents, []

    def until(limit):
        def sample_latents(*arguments):
            if len(counted) == limit:
                raise KeyboardInterrupt
            counted.append(len(arguments[4]))
            return original(*arguments)

        return sample_latents

    monkeypatch.setattr(sampling, "sample_latents", until(COUNT // OPTIONS.batch_size))
    with pytest.raises(KeyboardInterrupt):  # in the second try: the first takes three batches
        run(tmp_path, inputs, "killed")
    (tmp_path / "killed").rename(tmp_path / "half")
    counted.clear()
    monkeypatch.setattr(sampling, "sample_latents", until(-1))
    resumed = run(tmp_path, inputs, "killed")
    assert sum(counted) == sum(whole.column("num_attempts")) - COUNT, "the first try was not sampled again"
    assert resumed.table.equals(whole.table)
    np.testing.assert_array_equal(resumed.array("frames"), whole.array("frames"))


def drawn_alone(folder, conditions, options, *, seeds, work):
    """As `draw` in what is refused, but every row by itself, whatever it is drawn with."""
    shape = conditions.images.shape[1:3]
    noise = [np.random.default_rng(int(seed)).integers(60, 200, shape, dtype=np.uint8) for seed in seeds]
    return np.stack([grey * np.uint8(seed % 2 == 0) for grey, seed in zip(noise, seeds, strict=True)])[
        ..., None
    ].repeat(3, axis=3)


def test_frames_written_block_by_block_are_those_written_at_once(tmp_path, inputs, monkeypatch):
    plugin = plugins.Plugin("generators", "alone", SimpleNamespace(sample=drawn_alone, VERSION=1), OPTIONS)
    monkeypatch.setattr(task.plugins, "load_options", lambda choice: plugin)
    loose = fit_quality_filter(
        drawn_alone(None, conditions_of(inputs[2]), None, seeds=range(0, 2 * COUNT, 2), work=None), polarity=False
    )
    monkeypatch.setattr(task, "quality_filter_of", lambda frames: loose)
    whole = run(tmp_path, inputs, "whole")
    monkeypatch.setattr(task, "SHARD", 2)
    monkeypatch.setattr(task, "BLOCK_BYTES", 1)
    blocks = run(tmp_path, inputs, "blocks")
    assert max(whole.column("num_attempts")) > 1
    assert blocks.ref.digest == whole.ref.digest, "the table, and through it the array, byte by byte"
    save_compressed(tmp_path / "saved.npy.zst", np.asarray(whole.array("frames")))
    assert file_digest(tmp_path / "saved.npy.zst") == whole.files["frames.npy.zst"]["sha256"], "as if written at once"


def test_memory_does_not_grow_with_the_number_of_frames(tmp_path, inputs, monkeypatch):
    """Rows that a generator holds at once, with blocks of two shards of one row."""
    held = []

    def watched(folder, conditions, options, *, seeds, work):
        held.append(len(conditions))
        return drawn_alone(folder, conditions, options, seeds=seeds, work=work)

    plugin = plugins.Plugin("generators", "alone", SimpleNamespace(sample=watched, VERSION=1), OPTIONS)
    monkeypatch.setattr(task.plugins, "load_options", lambda choice: plugin)
    monkeypatch.setattr(task, "SHARD", 1)
    monkeypatch.setattr(task, "BLOCK_BYTES", 2 * inputs[0].array("frames")[0].nbytes)
    assert len(run(tmp_path, inputs, max_attempts=2)) == COUNT and max(held) == 2


def test_the_gate_is_that_of_the_training_frames(tmp_path):
    bars, _ = make_data(4)
    bars[:, 0, 0] = 255
    grey = task.quality_filter_of(write_frames(tmp_path / "grey", bars))
    coloured = task.quality_filter_of(write_frames(tmp_path / "coloured", bars * np.array([1, 0, 1], np.uint8)))
    assert (grey.polarity, coloured.polarity) == (False, True)
    assert find_causes(bars, grey) == [""] * 4 and find_causes(bars, coloured) != [""] * 4
    odd = bars.copy()
    odd[-1] = 255  # of split `test`
    assert task.quality_filter_of(write_frames(tmp_path / "odd", odd)) == grey
