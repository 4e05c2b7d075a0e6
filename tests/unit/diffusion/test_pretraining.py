"""The pictures behind the bundled base model are a function of their index, and pre-training one of its seed."""

import numpy as np
import pytest
import torch

from ctlev_core.body.motion.procedural import HELD_OUT
from ctlev_core.diffusion.pretrained.loading import load_base_model
from ctlev_core.diffusion.pretrained.paths import BUNDLED_OBJECT_MODEL
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.pretraining import picture_styles, pretraining, procedural_images
from ctlev_core.diffusion.pretraining.architecture import WORD_GAIN, learn_merges, train_tokenizer
from ctlev_core.diffusion.pretraining.picture_styles import DataMixture
from ctlev_core.diffusion.pretraining.pretraining import (
    ImageStream,
    PretrainingOptions,
    check_start,
    new_base_model,
    pretrain,
)
from ctlev_core.diffusion.training.options import TrainingOptions
from ctlev_core.studio.compositions import RELATIONS, parse_composition
from ctlev_core.studio.object_drawing import draw_object
from ctlev_core.studio.objects import COLOURS, NAMES, OBJECTS
from data_contracts.errors import DataError, TrainingError

TINY = PretrainingOptions(
    training=TrainingOptions(num_steps=4, batch_size=4, warmup_steps=1, log_every=1, validation_every=2, ema_decay=0.5),
    max_seconds=None,
    chunk_scenes=8,
    image_size=16,
    widths=(32, 32),
    workers=0,
)


@pytest.fixture(autouse=True)
def few_images(monkeypatch):
    """Fit the code and validate on a handful."""
    monkeypatch.setattr(pretraining, "FIT_IMAGES", 24)
    monkeypatch.setattr(pretraining, "VALIDATION_IMAGES", 4)


def same_weights(one, other):
    return all(
        torch.equal(one.unet.state_dict()[key], other.unet.state_dict()[key]) for key in one.unet.state_dict()
    ) and torch.equal(
        one.text_encoder.embeddings.token_embedding.weight, other.text_encoder.embeddings.token_embedding.weight
    )


def test_scenes_do_not_depend_on_order_or_block():
    alone = procedural_images.draw_scene(3, 11, 32)
    inside = procedural_images.draw_chunk(3, 1, 8, 32)[3]
    np.testing.assert_array_equal(alone.image, inside.image)
    np.testing.assert_array_equal(alone.condition, inside.condition)
    other = procedural_images.draw_scene(4, 11, 32)
    assert not np.array_equal(alone.image, other.image)


def test_mixture_of_people_and_objects():
    scenes = procedural_images.draw_chunk(0, 0, 60, 32)
    people = [scene.condition for scene in scenes if scene.condition is not None]
    # 60 draws at 0.5: four standard deviations either way.
    assert 15 <= len(people) <= 45
    assert all(condition.any() for condition in people), "a person whose skeleton is out of the picture teaches nothing"


def test_things_are_single_objects_and_compositions():
    scenes = [procedural_images.draw_thing(np.random.default_rng([5, index]), 16) for index in range(120)]
    pairs = [parse_composition(scene.plain) for scene in scenes if " " in scene.plain]
    # 120 draws at 0.3: four standard deviations either way.
    assert 16 <= len(pairs) <= 56
    assert {pair.relation for pair in pairs} == set(RELATIONS)
    assert all(scene.condition is None for scene in scenes)


def test_held_out_motions_are_never_drawn(monkeypatch):
    drawn = []
    original = procedural_images.sample_style

    def recording(name, *arguments):
        drawn.append(name)
        return original(name, *arguments)

    monkeypatch.setattr(procedural_images, "sample_style", recording)
    procedural_images.draw_chunk(1, 0, 150, 16)
    assert len(set(drawn)) > 5
    assert not set(drawn) & set(HELD_OUT)


def test_random_poses_are_rotations():
    pose = np.stack([procedural_images.sample_pose(np.random.default_rng(seed)) for seed in range(20)])
    np.testing.assert_allclose(pose @ np.swapaxes(pose, -1, -2), np.broadcast_to(np.eye(3), pose.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(pose), 1.0, atol=1e-12)


@pytest.mark.parametrize("noun", sorted(OBJECTS))
def test_every_object_is_visible_and_its_parts_fit(noun):
    canvas = np.full((32, 32, 3), 250, np.uint8)
    image = draw_object(noun, "blue", canvas, np.random.default_rng(0))
    changed = (image != canvas).any(axis=2).mean()
    assert 0.01 < changed < 0.95
    assert (canvas == 250).all(), "the background must not be drawn on"
    for part in OBJECTS[noun]:
        assert np.abs(np.array(part.points)).max() <= 1.01


def test_captions_name_what_is_seen_and_the_tokenizer_knows_their_words():
    tokenizer = new_base_model(TINY).tokenizer
    rng = np.random.default_rng(0)
    for scene in procedural_images.draw_chunk(0, 0, 40, 16):
        image, caption = picture_styles.apply_style(scene, rng)
        assert image.dtype == np.uint8 and image.shape == (16, 16, 3)
        if scene.condition is None:
            assert scene.plain in caption or scene.coloured in caption
            assert set(scene.plain.split()) <= {*OBJECTS, *RELATIONS}
            assert set(scene.coloured.split()) - set(scene.plain.split()) <= {*COLOURS}
        words = caption.split()
        assert tokenizer.tokenize(caption) == [f"{word}</w>" for word in words]
    for word in (*OBJECTS, *COLOURS, *RELATIONS, "street", "running", "human", "motorcycle"):
        assert tokenizer.tokenize(word) == [f"{word}</w>"]
    assert tokenizer.eos_token_id == len(tokenizer) - 1, "CLIP finds the end token as the largest id"


def test_shares_of_styles_may_be_rounded():
    mixture = DataMixture(styles={"photo": 0.3333333, "lines": 0.3333333, "grey": 0.3333333})
    scene = picture_styles.Scene(np.zeros((16, 16, 3), np.uint8), None, "cat", "red cat")
    image, _ = picture_styles.apply_style(scene, np.random.default_rng(0), mixture)
    assert image.shape == (16, 16, 3)


def test_batches_put_steered_rows_first_and_follow_the_number_alone():
    base_model = new_base_model(TINY)
    stream = ImageStream(base_model, TINY)
    late = stream.fetch(5)
    batch = ImageStream(base_model, TINY).fetch(5)
    assert torch.equal(late.latents, batch.latents) and torch.equal(late.embeddings, batch.embeddings)
    steered = 0 if batch.conditions is None else len(batch.conditions)
    assert steered <= len(batch.latents) == 4
    assert not torch.equal(batch.latents, stream.fetch(6).latents)


@pytest.mark.slow
def test_a_worker_process_draws_the_same_pictures():
    base_model = new_base_model(TINY)
    stream = ImageStream(base_model, TINY.model_copy(update={"workers": 1}))
    try:
        for number in range(6):  # over two blocks
            assert torch.equal(stream.fetch(number).latents, ImageStream(base_model, TINY).fetch(number).latents)
    finally:
        stream.close()


def test_pretraining_resumes_and_writes_a_base_model(tmp_path):
    history = pretrain(TINY, tmp_path / "whole", tmp_path / "work")
    assert history.step == [1, 2, 3, 4] and history.validation_step == [2, 4]
    whole = load_base_model(tmp_path / "whole")
    assert whole.controlnet is not None and whole.image_size == (16, 16)
    # Started again on its own state, a finished run only writes its result again.
    pretrain(TINY, tmp_path / "again", tmp_path / "work")
    assert same_weights(whole, load_base_model(tmp_path / "again"))
    with pytest.raises(TrainingError, match="of another run"):
        pretrain(TINY.model_copy(update={"seed": 1}), tmp_path / "other", tmp_path / "work")


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_a_unet_alone_learns_and_two_processes_end_where_one_does(tmp_path, monkeypatch):
    monkeypatch.undo()  # other processes know nothing of it
    training = TINY.training.model_copy(update={"gradient_accumulation": 2})
    options = TINY.model_copy(
        update={"tune": "unet", "data_mixture": DataMixture(people_share=0.0), "training": training}
    )
    alone = pretrain(options, tmp_path / "alone", tmp_path / "work")
    together = pretrain(options.model_copy(update={"num_processes": 2}), tmp_path / "both", tmp_path / "work of both")
    one, both = load_base_model(tmp_path / "alone"), load_base_model(tmp_path / "both")
    assert one.controlnet is None and both.controlnet is None
    for key, value in one.unet.state_dict().items():
        # Sums in another order, 1e-7; then rounded to half precision, where two neighbours are 2e-3 of each other.
        torch.testing.assert_close(value, both.unet.state_dict()[key], rtol=2e-3, atol=1e-6)
    np.testing.assert_allclose(together.loss, alone.loss, rtol=1e-4)
    np.testing.assert_allclose(together.shuffled_loss, alone.shuffled_loss, rtol=1e-4)
    assert alone.shuffled_loss != alone.validation_loss


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"num_processes": 2}, "multiple of the 2 processes"),
        ({"num_processes": 2, "max_seconds": 5.0}, "max_seconds must be null with several processes"),
        ({"data_mixture": {"styles": {"lines": 0.5}}}, "shares of styles must sum to 1, got 0.5"),
        (
            {"chunk_scenes": 2, "chunk_passes": 3},
            "chunk_scenes x chunk_passes must be a batch_size of 8 at least, got 6",
        ),
        ({"training": {"sample_every": 1}}, "sample_every draws samples of a fine-tuning"),
        ({"widths": (10, 20)}, r"widths must be one or more positive multiples of 16, got \(10, 20\)"),
        ({"widths": ()}, r"widths must be one or more positive multiples of 16, got \(\)"),
        ({"widths": (-32, 64)}, r"widths must be one or more positive multiples of 16, got \(-32, 64\)"),
    ],
)
def test_what_does_not_go_together_is_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        PretrainingOptions(**changed)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"tune": "controlnet", "image_size": 32}, "image_size: .*small has 64, got 32"),
        ({"tune": "controlnet", "widths": (32, 32)}, r"widths: .*small has \(64, 64, 96\), got \(32, 32\)"),
        ({"tune": "controlnet", "prediction_type": "v_prediction"}, "prediction_type: .*small has sample, got v_pred"),
        ({"tune": "both", "start": BUNDLED_OBJECT_MODEL}, "small_objects has no subfolder 'controlnet'; set tune=unet"),
        ({"tune": "controlnet", "start": BUNDLED_OBJECT_MODEL}, "small_objects has no subfolder 'controlnet'"),
    ],
)
def test_a_base_model_of_another_shape_is_refused_before_training(tmp_path, asked, message):
    with pytest.raises(DataError, match=message):
        pretrain(PretrainingOptions(**asked), tmp_path / "out", tmp_path / "work")
    assert not list(tmp_path.iterdir())
    check_start(PretrainingOptions(tune="controlnet", widths=(64, 64, 96)))


def test_captions_call_things_by_their_other_names_and_pictures_stay_the_same():
    scenes = [procedural_images.draw_thing(np.random.default_rng([6, index]), 16) for index in range(200)]

    def styled(share):
        return [
            picture_styles.apply_style(
                scene, np.random.default_rng(index), DataMixture(styles={"lines": 1.0}, other_names_share=share)
            )
            for index, scene in enumerate(scenes)
        ]

    said, renamed = styled(0.0), styled(1.0)
    for scene, (picture, caption), (again, other) in zip(scenes, said, renamed, strict=True):
        np.testing.assert_array_equal(picture, again)
        nouns = [noun for noun in scene.plain.split() if noun in NAMES]
        for word, new in zip(caption.split(), other.split(), strict=False):
            if not nouns:
                assert word == new
        for noun in nouns:
            assert any(name in other for name in NAMES[noun])
    assert 40 < sum(caption != other for (_, caption), (_, other) in zip(said, renamed, strict=True)) < 180


def test_byte_pair_encoding_by_hand():
    merges = learn_merges({"low": 5, "lowest": 2, "newer": 6, "wider": 3}, 4)
    # e r</w> is seen 9 times, then l o 7 times; n e, e w and w er</w> 6 times each: by the alphabet; then ew er</w>.
    assert merges == [("e", "r</w>"), ("l", "o"), ("e", "w"), ("ew", "er</w>")]


def test_words_have_the_same_numbers_each_time(tmp_path):
    corpus = procedural_images.caption_corpus()
    once, again = (train_tokenizer(corpus, tmp_path / name).get_vocab() for name in ("once", "again"))
    assert once == again and len(once) > 1000


def test_the_text_encoder_tells_prompts_apart_and_is_not_trained(tmp_path):
    """A trained one had collapsed: its embeddings differed by 0.01, and no fine-tuning could tell classes apart."""
    before = new_base_model(TINY)
    pretrain(TINY, tmp_path / "out", tmp_path / "work")
    for base_model in (before, load_base_model(tmp_path / "out"), load_base_model()):
        prompts = [f"A photo of {name}" for name in ("person", "spot", "street", "leopard")]
        embeddings = encode_prompts(base_model, prompts)
        distances = (embeddings[:, None] - embeddings[None]).square().mean(dim=(2, 3)).sqrt()
        assert distances[~torch.eye(len(prompts), dtype=torch.bool)].min() > 0.2
    kept = load_base_model(tmp_path / "out").text_encoder.state_dict()
    for name, weight in before.text_encoder.state_dict().items():
        assert torch.equal(kept[name].half(), weight.half()), name


def test_tokens_hold_their_word_and_the_mean_of_the_words_so_far():
    """Against the definition in NumPy: layer norm, mean of the projections, one turn, layer norm."""
    base_model = new_base_model(TINY)
    tokens = base_model.tokenizer("a red cat on a blue box", padding="max_length", return_tensors="pt").input_ids
    embeddings = base_model.text_encoder.embeddings
    layer = base_model.text_encoder.encoder.layers[0]
    project, turn = (weight.detach().double().numpy() for weight in (layer.self_attn.v_proj.weight,
        layer.self_attn.out_proj.weight))  # fmt: skip

    def normalised(rows):
        return (rows - rows.mean(1, keepdims=True)) / rows.std(1, keepdims=True)

    positions = embeddings.position_embedding.weight.detach().double().numpy()
    rows = embeddings.token_embedding.weight.detach().double().numpy()[tokens[0]] + positions
    means = np.cumsum(normalised(rows) @ project.T, axis=0) / np.arange(1, len(rows) + 1)[:, None]
    expected = normalised(rows + means @ turn.T)
    with torch.no_grad():
        actual = base_model.text_encoder(tokens)[0][0].numpy()
    # float32 against float64, and layer norm's epsilon of 1e-5.
    np.testing.assert_allclose(actual, expected, atol=1e-4)
    np.testing.assert_allclose(turn @ turn.T, WORD_GAIN**2 * np.eye(len(turn)), atol=1e-3)


def test_padding_says_which_words_a_prompt_has_and_words_in_which_order():
    base_model = new_base_model(TINY)
    prompts = ["a photo of a cat on box", "a photo of a box on cat", "a photo of a cat with box", ""]
    cat_on_box, box_on_cat, with_box, empty = encode_prompts(base_model, prompts)

    def distance(one, other):
        return float((one - other).square().mean().sqrt())

    assert distance(cat_on_box[-1], box_on_cat[-1]) < 0.05 < 0.2 < distance(cat_on_box[-1], with_box[-1])
    assert distance(cat_on_box[-1], empty[-1]) > 0.5
    first, second = 5, 7  # after start: a, photo, of, a, cat, on, box
    assert distance(cat_on_box[first], box_on_cat[second]) > 0.1, "the same word, but the box came before it"


def test_prediction_type_is_written_and_kept(tmp_path):
    options = TINY.model_copy(update={"prediction_type": "sample"})
    pretrain(options, tmp_path / "first", tmp_path / "work")
    assert load_base_model(tmp_path / "first").scheduler_config["prediction_type"] == "sample"
    again = TINY.model_copy(update={"start": tmp_path / "first"})
    assert new_base_model(again).scheduler_config["prediction_type"] == "sample", "that of the weights it goes on from"


def test_wall_clock_budget_ends_training(tmp_path):
    options = TINY.model_copy(update={"max_seconds": 1e-6})
    history = pretrain(options, tmp_path / "out", tmp_path / "work")
    assert history.step == [1], "one step is made before the clock is looked at"
