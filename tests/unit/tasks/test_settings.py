"""What downstream models are trained on: the names of the settings, and the frames behind them."""

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
import yaml
from pydantic import ValidationError

from ctlev_core import plugins
from ctlev_core.encodings import event_histogram
from ctlev_core.plugins import PluginError
from ctlev_core.postprocessing.stochastic_rounding import round_frames, training_counts
from data_contracts import tables
from data_contracts.compressed_arrays import CompressedArray
from data_contracts.config import DownstreamChoice, EncodingChoice, MetricChoice
from data_contracts.errors import DataError
from data_contracts.experiment import Experiment
from data_contracts.image_rows import ImageRows
from data_contracts.labels import Labels
from flows.command_line import PRESETS, load_preset
from flows.full_experiment import full_experiment
from flows.inputs import check_inputs
from tasks.evaluate import _groups_by_origin, _others
from tasks.stage import Output, call_flow, planning
from tasks.subset import take_label_consistent, take_recorded, take_share

COUNT = 12


def smoke(*overrides):
    return load_preset(Experiment, PRESETS, "smoke", list(overrides))


def test_training_sets_are_named_after_what_is_learnt_from():
    names = list(map(str, smoke("scaling=[0.5,0.25]").all_training_sets))
    assert names == [
        "recorded", "synthetic", "event_gan", "smpl_esim", "label_consistent", "oracle", "recorded+synthetic",
        "recorded+event_gan", "recorded+smpl_esim", "recorded+label_consistent", "recorded+oracle",
        "recorded+synthetic@0.25", "recorded+synthetic@0.5",
    ]  # fmt: skip
    plain = smoke("scaling=[]", "keep_fraction=null", "oracle=null", "baselines={}")
    assert list(map(str, plain.all_training_sets)) == ["recorded", "synthetic", "recorded+synthetic"]


@pytest.mark.parametrize("override", ["scaling=[1.0]", "scaling=[0.5,0.5]", "scaling=[0]", "keep_fraction=1"])
def test_shares_that_are_none_are_refused(override):
    with pytest.raises((DataError, ValidationError, ValueError), match=r"scaling|keep_fraction"):
        smoke(override)


FOREIGN = "baselines={foreign: {poses: {name: text_motion}}, gan: {generator: {name: event_gan}}}"


def test_what_a_baseline_leaves_out_is_the_experiments_own():
    made = smoke(FOREIGN)
    foreign, gan = made.baselines.values()
    assert (foreign.condition, foreign.generator, foreign.sampling) == (made.condition, made.generator, made.sampling)
    assert foreign.poses in made.choices
    # The sampling options of another generator are other ones.
    assert (gan.condition, gan.generator.name, gan.sampling, gan.poses) == (made.condition, "event_gan", {}, None)


def test_a_baseline_without_a_name_changes_single_options_of_the_experiments_own():
    made = smoke(
        "generator.options.num_steps=7",
        "generator.options.moves.shift=0.1",
        "baselines={random: {generator: {options: {random_init: true, moves: {turn_deg: 5}}}}}",
        "baselines.random.sampling={batch_size: 3}",
        "baselines.random.generator.options.num_steps=9",
    )
    random = made.baselines["random"]
    assert random.generator.name == made.generator.name and random.condition == made.condition
    changed = {"random_init": True, "num_steps": 9, "moves": {"shift": 0.1, "turn_deg": 5}}
    assert random.generator.options == made.generator.options | changed
    assert random.sampling == made.sampling | {"batch_size": 3}
    # The experiment's own stay as they were.
    assert made.generator.options["num_steps"] == 7 and "turn_deg" not in made.generator.options["moves"]
    condition = smoke("baselines={other: {condition: {options: {drawing: openpose}}}}").baselines["other"].condition
    assert condition.name == made.condition.name and condition.options == made.condition.options | {
        "drawing": "openpose"
    }


@pytest.mark.parametrize(
    "baseline", ["{generator: {optoins: {num_steps: 3}}}", "{generator: 3}", "{generator: {options: 3}}", "3"]
)
def test_a_baseline_that_says_something_else_is_refused(baseline):
    with pytest.raises((DataError, ValueError), match=r"baselines.*other"):
        smoke(f"baselines={{other: {baseline}}}")


def test_frames_of_several_generators_are_learnt_from_together():
    names = list(map(str, smoke(FOREIGN, "mixtures=[recorded+synthetic+foreign, synthetic+foreign]").all_training_sets))
    assert names[-2:] == ["recorded+synthetic+foreign", "synthetic+foreign"]
    for wrong in ("recorded+nobody", "recorded", "recorded+recorded", "recorded+label_consistent+gan"):
        with pytest.raises(
            ValueError, match=r"mixtures join different ones of foreign, gan, oracle, recorded, synthetic"
        ):
            smoke(FOREIGN, f"mixtures=[{wrong}]")


def plan(*overrides):
    with planning() as rows:
        call_flow(full_experiment, smoke(*overrides))
    return Counter({row.stage: len({r.key for r in rows if r.stage == row.stage}) for row in rows})


def test_several_generators_are_trained_sampled_and_scored_each(monkeypatch, tmp_path):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    once, twice = plan("downstream_seeds=[0,1]"), plan("downstream_seeds=[0,1]", "num_generators=2")
    for name in ("finetune", "sample", "simulate"):
        assert twice[name] == 2 * once[name], name
    # As many models as before: downstream seeds take turns with the generators.
    assert twice["train_downstream"] == once["train_downstream"]
    made = len(smoke().generator_names)
    assert twice["score_distance"] == once["score_distance"] + made


class Synthetic:
    """A manifest of synthetic frames, held in memory."""

    def __init__(self):
        self.frames = np.arange(COUNT * 3, dtype=np.uint8).reshape(COUNT, 1, 1, 3)
        names = ["a", "b", "b"] * 4
        self.table = pa.table({"sample_id": [f"s{n}" for n in range(COUNT)], "class_name": names})
        self.labels = Labels(tuple(names), np.arange(COUNT))
        self.ref = SimpleNamespace(path=".")

    def __len__(self):
        return COUNT

    def array(self, name):
        return self.frames

    def images(self, rows, name="frames"):
        return ImageRows.of([(self.array(name), rows)])


def test_a_share_is_the_first_rows(tmp_path):
    synthetic = Synthetic()
    for share, expected in ((0.5, 6), (0.01, 1)):
        folder = tmp_path / str(share)
        folder.mkdir()
        table = take_share.function(Output(folder, folder), synthetic, share=share)
        assert table.equals(synthetic.table[:expected])
        np.testing.assert_array_equal(CompressedArray(folder / "frames.npy.zst")[:], synthetic.frames[:expected])


def recorded_frames(counts):
    """`counts` frames by (subject, class, recording), and as many test frames, held in memory."""
    rows = [names for names, count in counts.items() for _ in range(count)]
    splits = ["train"] * len(rows) + ["test"] * len(rows)
    rows += [(f"other {subject}", *names) for subject, *names in rows]
    names = ("subject", "class_name", "recording_id")
    table = pa.table(
        {
            "sample_id": [f"s{number}" for number in range(len(rows))],
            "split": splits,
            **{name: [row[column] for row in rows] for column, name in enumerate(names)},
        }
    )
    arrays = {
        "frames": np.arange(len(rows), dtype=np.uint8)[:, None, None, None].repeat(3, axis=3),
        "histograms": np.arange(len(rows), dtype=np.uint16)[:, None, None, None],
    }
    frames = Synthetic()
    frames.table, frames.array = table, arrays.__getitem__
    frames.column = lambda name: table[name].to_pylist()
    frames.rows_where = lambda split: np.flatnonzero(np.array(splits) == split)
    return frames, arrays


COUNTS = {("ann", "walk", "r0"): 10, ("ann", "walk", "r1"): 10, ("ann", "run", "r2"): 3, ("bob", "walk", "r3"): 30}


@pytest.mark.parametrize(
    ("count", "kept"),
    [
        (6, {"r0": 1, "r1": 1, "r2": 2, "r3": 2}),
        (12, {"r0": 2, "r1": 2, "r2": 3, "r3": 5}),  # "run" is used up, and the others go on
        (53, {"r0": 10, "r1": 10, "r2": 3, "r3": 30}),
    ],
)
def test_recorded_frames_are_spread_over_subjects_classes_and_recordings(tmp_path, count, kept):
    frames, arrays = recorded_frames(COUNTS)
    table = take_recorded.function(Output(tmp_path, tmp_path), frames, count=count, seed=1)
    splits, recordings = (np.array(table[name].to_pylist()) for name in ("split", "recording_id"))
    found = Counter(recordings[splits == "train"].tolist())
    assert sum(found.values()) == count and (splits == "test").sum() == 53
    assert all(abs(found[name] - number) <= 1 for name, number in kept.items()), found
    rows = np.array([int(name[1:]) for name in table["sample_id"].to_pylist()])
    assert (np.diff(rows) > 0).all()
    for name, array in arrays.items():
        np.testing.assert_array_equal(CompressedArray(tmp_path / f"{name}.npy.zst")[:], array[rows])
    again = take_recorded.function(Output(tmp_path, tmp_path), frames, count=count, seed=1)
    assert again.equals(table)
    other = take_recorded.function(Output(tmp_path, tmp_path), frames, count=count, seed=2)
    assert other.equals(table) == (count == 53)


def test_more_recorded_frames_than_there_are_is_refused(tmp_path):
    frames, _ = recorded_frames(COUNTS)
    with pytest.raises(DataError, match=r"num_recorded: 54 training frames were asked for, the recordings give 53"):
        take_recorded.function(Output(tmp_path, tmp_path), frames, count=54, seed=0)


def test_label_consistent_rows_are_the_best_of_each_class(monkeypatch, tmp_path):
    errors = np.array([3, 9, 1, 1, 8, 2, 2, 7, 3, np.nan, 6, 4.0])
    model = SimpleNamespace(PREDICTS=(), predict=lambda folder, frames: {})

    def metric(score):
        return SimpleNamespace(
            VERSION=1, INPUT="joints2d", SCORES=(), Options=None,
            compute_rows=lambda *given: errors, compute=lambda *given: {score: 1.0, "mpjpe": 2.0},
        )  # fmt: skip

    scores = {"mpjpe2d": "mpjpe2d_px", "pck2d": "pck2d", "pve": "pve_mm"}
    fakes = {"pose2d": model, **{name: metric(score) for name, score in scores.items()}}
    monkeypatch.setattr(
        plugins,
        "load_options",
        lambda choice: SimpleNamespace(name=choice.name, module=fakes[choice.name], options=None),
    )

    def kept(name):
        folder = tmp_path / name
        folder.mkdir()
        table = take_label_consistent.function(
            Output(folder, folder),
            SimpleNamespace(ref=SimpleNamespace(path=tmp_path)),
            Synthetic(),
            downstream=DownstreamChoice(name="pose2d"),
            metric=MetricChoice(name=name),
            share=0.5,
        )
        return table["sample_id"].to_pylist()

    # a: rows 0, 3, 6, 9 with errors 3, 1, 2, NaN; b: the other eight.
    kept_of_errors = ["s2", "s3", "s5", "s6", "s8", "s11"]
    assert kept("mpjpe2d") == kept_of_errors
    assert kept("pve") == kept_of_errors
    # Of a score that wants to be large the largest are kept.
    assert kept("pck2d") == ["s0", "s1", "s4", "s6", "s7", "s10"]


def test_rounded_frames_show_whole_counts():
    random = np.random.default_rng(0)
    rate = np.full((24, 24), 0.05)
    rate[6:18, 8:14] = 1.5
    counts = random.poisson(rate, (20, 1, 24, 24)).astype(np.uint16)
    encoding = EncodingChoice(name="event_histogram", options={"polarity": False})
    options = event_histogram.Options(polarity=False)
    real = event_histogram.render_image(counts, options)
    num_events = counts.sum(axis=(1, 2, 3), dtype=np.int64)
    # A decoder that is unsure where an event is spreads it over two pixels.
    blurred = ((real.astype(int) + np.roll(real, 1, axis=1)) // 2).astype(np.uint8)
    rounded = round_frames(blurred, num_events, plugins.load_options(encoding), range(20))

    def active_share(images):
        return (images > 0).mean()

    assert active_share(blurred) > 1.4 * active_share(real)
    assert active_share(rounded) == pytest.approx(active_share(real), rel=0.15)
    scales = event_histogram.full_scales(counts, options)
    levels = {int(255 * k / scale) for scale in scales for k in range(1, int(scale) + 1)}
    assert len(np.unique(rounded)) < 4 * len(levels)


def test_only_event_histograms_can_be_rounded_to_counts():
    with pytest.raises((DataError, ValidationError, ValueError), match="stochastic_rounding needs encoding"):
        smoke("stochastic_rounding=true", "encoding={name: voxel_grid}")


AREA = "encoding={name: event_histogram, options: {polarity: false, image_size: [32, 32]}}"
EVENTS = "encoding={name: event_histogram, options: {polarity: false, image_size: [32, 32], resampling: events}}"


@pytest.mark.parametrize("asked", ["stochastic_rounding=true", "export={}"])
def test_images_without_whole_counts_are_refused_before_anything_runs(asked):
    what, small = asked.partition("=")[0], "base_model={image_size: 32}"
    with pytest.raises(
        PluginError, match=rf"{what} needs whole counts .* 32 x 32 px .* 64 x 64 px: .*resampling=events"
    ):
        check_inputs(smoke(asked, AREA, small))
    check_inputs(smoke(asked, EVENTS, small))
    check_inputs(smoke(asked))
    check_inputs(smoke(asked, AREA.replace("32", "64")))
    check_inputs(smoke(AREA, small))


def test_frames_without_whole_counts_are_refused_before_they_are_sampled():
    arrays = {"histograms": np.zeros((2, 1, 24, 24), np.uint16), "frames": np.zeros((2, 16, 16, 3), np.uint8)}
    ref = SimpleNamespace(path="frames")
    manifest = SimpleNamespace(array=arrays.__getitem__, column=lambda name: [3, 0], ref=ref)
    with pytest.raises(DataError, match="stochastic_rounding needs whole counts"):
        training_counts(manifest)
    arrays["frames"] = np.zeros((2, 24, 24, 3), np.uint8)
    with pytest.raises(DataError, match="stochastic_rounding needs event counts"):
        training_counts(manifest)


def test_groups_by_origin_part_the_test_rows():
    names = ["walk", "jump", "crawl", "walk", "jump"]
    data = SimpleNamespace(column=lambda name: ["walk", "walk", "sit"], rows_where=lambda split: np.array([0, 2]))
    poses = SimpleNamespace(
        column=lambda name: ["jump", "walk", "crawl"],
        rows_where=lambda splits: np.array([0, 1]),
    )
    groups = {name: rows.tolist() for name, rows in _groups_by_origin(names, data, [poses])}
    assert groups == {
        "classes with recorded training frames": [0, 3],
        "classes with synthetic frames only": [1, 4],
        "classes without training frames": [2],
    }
    assert _groups_by_origin(["walk", "sit"], data, [poses]) == []  # one group would be all


@pytest.mark.parametrize("count", [2, 3, 100])
def test_shuffled_labels_are_those_of_others(count):
    other = _others(count, seed=1)
    assert sorted(other) == list(range(count)) and not (other == np.arange(count)).any()


def test_subsets_are_tables_of_synthetic_frames():
    assert take_share.schema is tables.SYNTHETIC and take_label_consistent.schema is tables.SYNTHETIC


def test_a_preset_extends_another(tmp_path):
    (tmp_path / "base.yaml").write_text(yaml.safe_dump(smoke().model_dump(mode="json")))
    (tmp_path / "heir.yaml").write_text("extends: base\nname: heir\nbaselines: {}\n")
    (tmp_path / "grandchild.yaml").write_text(f"extends: {tmp_path / 'heir.yaml'}\nscaling: []\n")
    found = load_preset(Experiment, tmp_path, "grandchild", ["num_synthetic=5"])
    assert found == smoke("name=heir", "baselines={}", "scaling=[]", "num_synthetic=5")
    for text, message in (
        ("extends: loop", "extends must name another preset"),
        ("extends: [base]", "extends must name another preset"),
        ("extends: nothing", "loop extends an unknown preset 'nothing'"),
    ):
        (tmp_path / "loop.yaml").write_text(text)
        with pytest.raises(plugins.PluginError, match=message):
            load_preset(Experiment, tmp_path, "loop", [])
