"""Costs of networks of Stable Diffusion's size: closed forms of their weights, and the rows that plans tell."""

from __future__ import annotations

import json

import pytest
from tiny_families import write_family

from ctlev_core.diffusion.training.options import LatentOptions, StudentOptions
from ctlev_core.stand_ins.making import make_stand_in
from data_contracts.config import DatasetChoice, GeneratorChoice, SamplingChoice
from flows import network_costs
from flows.amounts_of_work import Amounts, Rows
from flows.network_costs import network_cost
from flows.network_operations import Networks, read_networks, stable_diffusion_v1
from flows.stage_costs import Measured, StageCost, kind_of, predict_stages
from tasks.stage import PlannedStage

SIZE = (512, 512)
WEIGHTS = {"unet": 860_000_000, "vae": 84_000_000, "text_encoder": 123_000_000}
ALL = sum(WEIGHTS.values())


@pytest.fixture
def base_model(monkeypatch, tmp_path):
    """A place whose files say that they hold Stable Diffusion."""

    def read(place, controlnet, with_controlnet):
        weights = WEIGHTS | ({"controlnet": 361_000_000} if with_controlnet else {})
        return Networks(stable_diffusion_v1(with_controlnet).configs, weights)

    monkeypatch.setattr(network_costs, "read_networks", read)
    return tmp_path


def operations(work, with_controlnet=False):
    return stable_diffusion_v1(with_controlnet).operations(work, *SIZE)


@pytest.mark.slow
def test_counts_of_stable_diffusion_v1_are_those_in_the_literature():
    """TFLOP an image at 512 and 256 px, counted once by torch on networks with weights."""
    published = {"denoising": (0.803, 0.180), "encoding": (1.117, 0.273), "decoding": (2.515, 0.622)}
    for work, expected in published.items():
        found = [stable_diffusion_v1(False).operations(work, side, side) / 1e12 for side in (512, 256)]
        assert found == pytest.approx(expected, rel=2e-3)
    assert operations("tune unet") / 1e12 == pytest.approx(2.41, rel=2e-3)
    assert operations("denoising", True) / 1e12 == pytest.approx(0.803 + 0.283, rel=2e-3)
    assert operations("tune controlnet", True) / 1e12 == pytest.approx(2.27, rel=3e-3)


def test_counts_of_a_transformer_are_its_closed_form():
    """Of 2 operations a weight and token, and attention; text and image have weights of their own."""
    width, depth, text = 64, 3, 77 + 256
    config = {
        "_class_name": "SD3Transformer2DModel", "sample_size": 16, "patch_size": 2, "in_channels": 16,
        "num_layers": depth, "attention_head_dim": 16, "num_attention_heads": 4, "joint_attention_dim": 96,
        "caption_projection_dim": width, "pooled_projection_dim": 48, "out_channels": 16, "pos_embed_max_size": 16,
    }  # fmt: skip
    vae = {"latent_channels": 16, "block_out_channels": [4, 4, 4, 4]}
    networks = Networks((("unet", json.dumps(config)), ("vae", json.dumps(vae))), {})
    for side in (64, 128):
        tokens = (side // 16) ** 2
        linear = 12 * width**2 * 2 * (tokens + text) * depth
        last = 2 * 9 * width**2 * text  # the last block makes no text
        modulation = 2 * 12 * width**2 * depth - 2 * 4 * width**2 + 2 * 2 * width**2
        attention = 4 * (tokens + text) ** 2 * width * depth
        embedding = 2 * (text * 96 * width + 2 * tokens * 4 * 16 * width + (256 + width + 48 + width) * width)
        expected = linear - last + modulation + attention + embedding
        found = networks.operations("denoising", side, side)
        assert found == pytest.approx(expected, rel=1e-3)
        assert networks.operations("tune unet", side, side) == pytest.approx(3 * found, rel=0.02)
    assert networks.latent_channels == 16


def test_larger_families_are_read_from_their_folders(tmp_path):
    networks = read_networks(write_family("sd3", tmp_path / "sd3"), None, True)
    assert networks is not None
    assert {"text_encoder_3", "controlnet", "unet"} <= networks.weights.keys()
    alone = read_networks(tmp_path / "sd3", None, False)
    assert alone is not None and alone.operations("denoising", 32, 32) < networks.operations("denoising", 32, 32)
    xl = read_networks(write_family("xl", tmp_path / "xl"), None, True)
    assert xl is not None and xl.operations("tune both", 32, 32) > 2 * xl.operations("denoising", 32, 32)
    assert read_networks(tmp_path / "nowhere", None, False) is None


def generator(name, base_model, **options):
    return GeneratorChoice(
        name=name, options={"base_model": str(base_model), "num_steps": 3, "batch_size": 2, **options}
    )


def fine_tuning(choice):
    return network_cost("finetune", {"generator": choice}, {}, 0, SIZE)


def test_fine_tuning_a_unet_keeps_its_gradients_and_moments(base_model):
    plain = fine_tuning(generator("stable_diffusion", base_model, ema_decay=0.0))
    averaged = fine_tuning(generator("stable_diffusion", base_model, ema_decay=0.9))
    assert averaged.memory_bytes - plain.memory_bytes == 4 * WEIGHTS["unet"]
    assert plain.memory_bytes > 16 * WEIGHTS["unet"] + 4 * (WEIGHTS["vae"] + WEIGHTS["text_encoder"])
    assert plain.disk_bytes == 4 * ALL
    assert plain.operations == {"float32": 6 * operations("tune unet")}


def test_fine_tuning_a_controlnet_takes_less_memory_and_more_disk(base_model):
    unet = fine_tuning(generator("stable_diffusion", base_model, ema_decay=0.0))
    controlnet = fine_tuning(generator("controlnet", base_model, tune="controlnet", ema_decay=0.0))
    difference = 12 * WEIGHTS["unet"] - 16 * 361_000_000
    assert unet.memory_bytes - controlnet.memory_bytes == difference
    assert controlnet.disk_bytes - unet.disk_bytes == 4 * 361_000_000


def test_less_activations_cost_a_third_more_time(base_model):
    kept = fine_tuning(generator("stable_diffusion", base_model))
    anew = fine_tuning(generator("stable_diffusion", base_model, gradient_checkpointing=True))
    assert anew.memory_bytes < kept.memory_bytes
    assert anew.operations["float32"] == pytest.approx(4 / 3 * kept.operations["float32"])


def test_sampling_is_steps_and_a_decoding_for_each_row(base_model):
    trained = {"generator": generator("stable_diffusion", base_model)}
    sampling = SamplingChoice(
        name="stable_diffusion", options={"num_inference_steps": 10, "precision": "bfloat16", "guidance_scale": 2.0}
    )
    cost = network_cost("sample", {"sampling": sampling}, trained, 7, SIZE)
    assert cost is not None
    assert cost.operations == {"bfloat16": 7 * (20 * operations("denoising") + operations("decoding"))}
    assert cost.memory_bytes > 2 * ALL


def test_distillation_is_a_training_and_passes_of_the_teacher(base_model):
    trained = {"generator": generator("stable_diffusion", base_model)}
    options = StudentOptions(num_evaluations=2, teacher_evaluations=5, num_steps=10, batch_size=4, ema_decay=0.0)
    plain, guided = (
        network_cost(
            "distill",
            {"sampling": SamplingChoice(name="stable_diffusion", options=sampling), "options": options},
            trained,
            0,
            SIZE,
        )
        for sampling in ({}, {"guidance_scale": 2.0})
    )
    assert plain is not None and guided is not None
    training, forward = operations("tune unet"), operations("denoising")
    assert plain.operations == {"float32": pytest.approx(10 * 4 * (training + 3 * forward))}
    assert guided.operations == {"float32": pytest.approx(10 * 4 * (training + 6 * forward))}
    # Weights of teacher and student, gradients and two moments.
    assert plain.memory_bytes > 20 * WEIGHTS["unet"] and plain.disk_bytes == 4 * ALL


def test_latents_do_not_take_more_memory_for_more_frames(base_model):
    options = {"latents": LatentOptions(base_model=base_model)}
    few, many = (network_cost("encode_latents", options, {}, count, SIZE) for count in (100, 10_000))
    assert few is not None and many is not None
    assert few.memory_bytes == many.memory_bytes and many.disk_bytes == 100 * few.disk_bytes
    assert few.disk_bytes == 100 * 2 * 4 * 64 * 64 * 4


def test_small_networks_and_other_stages_are_not_calculated(tmp_path, base_model):
    assert network_cost("score_model", {}, {}, 5, SIZE) is None
    assert network_cost("finetune", {"generator": GeneratorChoice(name="event_gan", options={})}, {}, 5, SIZE) is None
    assert network_cost("encode_latents", {"latents": LatentOptions(base_model=tmp_path)}, {}, 5, None) is None


def test_weights_are_counted_in_the_files(tmp_path):
    place = make_stand_in("stable_diffusion", "tiny", tmp_path)
    networks = read_networks(place, None, False)
    assert networks is not None
    counted = networks.weights
    assert set(counted) == {"unet", "vae", "text_encoder"}
    stored = sum(path.stat().st_size for path in place.rglob("*.safetensors"))
    assert 2 * sum(counted.values()) == pytest.approx(stored, rel=0.05)  # float16
    assert network_cost("encode_latents", {"latents": LatentOptions(base_model=place)}, {}, 5, SIZE) is None
    assert read_networks(tmp_path / "none", None, False) is None


def test_a_product_of_matrices_tells_how_fast_a_machine_is():
    assert 1e8 < network_costs.operations_a_second("float32", side=256) < 1e16


def planned(stage, key, given=None, **arguments):
    return PlannedStage(stage, stage, key, cached=False, arguments=arguments, given=given or {})


def ref(key):
    return {"manifest": key}


def test_rows_follow_from_the_recordings(tmp_path):
    """DHP19: 4 of 8 subjects to learn from, 2 to test, 2 that give poses alone; two cameras each."""
    place = make_stand_in("dhp19", "tiny", tmp_path)
    dataset = DatasetChoice(name="dhp19", options={"root": str(place), "condition_subjects": [11, 12]})
    stages = [
        planned("ingest", "a", {"dataset": dataset}),
        planned("encode", "b", recordings=ref("a"), windows={"max_windows": 3},
                encoding={"plugin": "encodings/event_histogram", "options": {"image_size": [512, 512]}}),
        planned("take_recorded", "c", frames=ref("b"), count=10),
        planned("encode_latents", "d", frames=ref("c")),
        planned("condition_samples", "e", poses=ref("a"), frames=ref("c"), count=5, windows={"max_windows": 3}),
        planned("sample", "f", checkpoint=ref("x"), frames=ref("c"), conditions=ref("e"),
                sampling={"options": {"num_inference_steps": 4}}),
        planned("train_downstream", "g", training_sets=[ref("c")],
                downstream={"options": {"num_steps": 7, "batch_size": 4, "sequence_length": 3}}),
        planned("realism", "h", frames=ref("c"), generated=ref("f"), floors=ref("i")),
    ]  # fmt: skip
    amounts = Amounts({stage.key: stage for stage in stages})
    assert [amounts.rows(key) for key in "abcde"] == [
        Rows(8, 12), Rows(24, 36), Rows(10, 22), Rows(10, 10), Rows(5, 5),
    ]  # fmt: skip
    assert amounts.work("f") == 20 and amounts.image_size("f") == SIZE and amounts.image_size("a") is None
    assert amounts.work("g") == 7 * 4 * 3
    # Of 22 recorded frames none are told apart.
    assert amounts.work("h") == 0
    # What is there already is counted and not guessed.
    known = Amounts({stage.key: stage for stage in stages}, {"b": 18, "d": 6})
    assert known.rows("b") == Rows(12, 18) and known.rows("c") == Rows(10, 16) and known.rows("d") == Rows(6, 6)


def test_scores_take_the_frames_they_are_of_and_not_the_steps_of_the_training():
    recorded = planned("encode", "a", recordings=ref("x"), num_train_recordings=90, num_test_recordings=60)
    sampled = planned("sample", "b", conditions=ref("x"), count=40)
    downstream = {"plugin": "downstream/classifier", "options": {"num_steps": 7, "batch_size": 4, "binary": None}}
    scores = [
        planned("score_model", name, data=ref(data), model=ref("m"), split=split, downstream=downstream)
        for name, data, split in (("c", "a", "test"), ("d", "a", "train"), ("e", "b", "train"))
    ]
    amounts = Amounts({stage.key: stage for stage in (recorded, sampled, *scores)})
    assert [amounts.work(key) for key in "cde"] == [60, 150, 40]


def test_a_network_for_each_class_is_another_kind_than_one_for_all():
    def kind(binary):
        choice = {"plugin": "downstream/classifier", "options": {"num_steps": 7, "binary": binary}}
        return kind_of("score_model", {"downstream": choice, "split": "test"}, SIZE)

    assert kind(None) == "score_model downstream/classifier 512x512"
    assert kind("balanced") == "score_model downstream/classifier:binary 512x512"


def test_downstream_networks_of_large_images_have_costs_of_their_own():
    """An epoch of ResNet-34 at 512 px takes far longer than one at 64 px, and its weights are 86 MB."""

    def cost(size, steps):
        encoding = {"plugin": "encodings/event_histogram", "options": {"image_size": list(size)}}
        recorded = planned("encode", "a", recordings=ref("x"), encoding=encoding, num_train_recordings=90)
        downstream = {"plugin": "downstream/classifier", "options": {"num_steps": steps, "batch_size": 2}}
        training = planned("train_downstream", "b", training_sets=[ref("a")], downstream=downstream)
        return predict_stages([training], of=[recorded, training])["b"]

    small, few, many = cost((64, 64), 8), cost(SIZE, 8), cost(SIZE, 80)
    assert few.seconds > 5 * small.seconds and 8 < many.seconds / few.seconds < 12
    assert few.disk_bytes > 80e6 and few.memory_mib > 1200


def test_what_took_time_without_any_work_does_not_make_work_endless():
    """Realism of few frames is no test, and records of before rows were noted tell no frames at all."""
    stage = planned("ingest", "a", num_train_recordings=30)
    assert predict_stages([stage], [Measured("ingest", 0.0, StageCost(40.0, 700.0, 9))])["a"].seconds == 40.0


def test_realism_is_as_many_two_sample_tests_as_have_enough_frames():
    recorded = planned("encode", "a", recordings=ref("x"), num_train_recordings=90, num_test_recordings=60)
    few, many = (planned("sample", name, conditions=ref("x"), count=count) for name, count in (("b", 39), ("c", 40)))
    of_few, of_many = (
        planned("realism", key, frames=ref("a"), generated=ref(made), floors=ref("f"))
        for key, made in (("d", "b"), ("g", "c"))
    )
    floors = planned("realism_floors", "f", frames=ref("a"))
    time = planned("sequence_realism", "e", frames=ref("a"), generated=[ref("c")], length=2)
    amounts = Amounts({stage.key: stage for stage in (recorded, few, many, of_few, of_many, floors, time)})
    # Halves of the training frames, and these against those of the test.
    assert amounts.work("f") == 1 + 1
    # The larger set against both.
    assert (amounts.work("d"), amounts.work("g")) == (0, 2)
    # Stretches: 45 of the training frames, in order and in none.
    assert amounts.work("e") == 1


def test_a_report_of_sequences_costs_as_much_as_any_other():
    made = planned("sample", "a", conditions=ref("x"), count=960)
    time = planned("sequence_realism", "b", frames=ref("a"), generated=[ref("a")], length=8)
    reports = planned("report", "c", made=ref("x")), planned("report", "d", made=ref("x"), sequences=ref("b"))
    foretold = predict_stages([*reports], of=[made, time, *reports])
    assert foretold["c"] is not None and foretold["c"] == foretold["d"] and foretold["c"].seconds < 60


def test_gpus_share_the_work_and_hold_what_processes_would(base_model, monkeypatch):
    choice = generator("controlnet", base_model, tune="controlnet", gradient_accumulation=4, num_processes=4)
    monkeypatch.setattr(network_costs, "num_gpus", lambda device: 0)
    on_cpu = fine_tuning(choice)
    monkeypatch.setattr(network_costs, "num_gpus", lambda device: 4)
    on_gpus = fine_tuning(choice)
    assert (on_cpu.devices, on_gpus.devices) == (1, 4)
    rest = 4 * (on_gpus.memory_bytes / 4 - network_costs.PROCESS_BYTES)
    assert rest == 4 * 4 * (ALL + 361_000_000) < on_cpu.memory_bytes
    monkeypatch.setattr(network_costs, "operations_a_second", lambda precision: 1e12)
    io_seconds = on_cpu.io_bytes / network_costs.DISK_BYTES_A_S
    slower = network_costs.EFFICIENCY["training"] / network_costs.GPU_EFFICIENCY["training"]
    assert slower * (on_cpu.seconds() - io_seconds) == pytest.approx(4 * (on_gpus.seconds() - io_seconds))
