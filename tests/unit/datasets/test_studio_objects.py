"""The drawn objects: splits, names, reproducibility, and events that lie on outlines."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from tokenizers import Tokenizer

from ctlev_core.conditions import text
from ctlev_core.datasets import studio_objects
from ctlev_core.datasets.studio_objects import CLASSES, COMPOSITIONS, HELD_OUT, UNSEEN, Options
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL
from ctlev_core.sensor.choice import read_sensor
from ctlev_core.sensor.options import PRESETS
from ctlev_core.studio.compositions import NOUNS, Composition, all_compositions, parse_composition
from ctlev_core.studio.object_drawing import draw_composition, draw_object
from ctlev_core.studio.objects import COLOURS, OBJECTS
from data_contracts.errors import DataError
from data_contracts.events import Events, check_events
from data_contracts.labels import Recording, check_image_track, check_labels

SMALL = Options(num_train_per_class=2, num_test_per_class=1)


def test_validation_recordings_change_no_others():
    plain, more = SMALL, SMALL.model_copy(update={"num_validation_per_class": 2})
    recordings = studio_objects.list_recordings(more)
    assert [r for r in recordings if r.parts[0].split != "validation"] == studio_objects.list_recordings(plain)
    added = [r for r in recordings if r.parts[0].split == "validation"]
    assert len(added) == 2 * len({r.class_name for r in recordings})
    assert len(studio_objects.read_events(added[0], more)) > 0


def of_split(split: str, options: Options = SMALL) -> list[Recording]:
    return [r for r in studio_objects.list_recordings(options) if r.parts[0].split == split]


def first_of(class_name: str, options: Options = SMALL) -> Recording:
    return next(r for r in studio_objects.list_recordings(options) if r.class_name == class_name and r.has_events)


def same_events(first: Events, second: Events) -> bool:
    return len(first) == len(second) and all(
        np.array_equal(getattr(first, name), getattr(second, name)) for name in ("t", "x", "y", "p")
    )


def test_there_are_classes_enough_with_two_to_five_names_that_no_other_has():
    assert len(CLASSES) >= 20 and len(UNSEEN) == len(COMPOSITIONS) == 10
    assert set(CLASSES + UNSEEN) <= set(OBJECTS) and not set(CLASSES) & set(UNSEEN)
    names = studio_objects.read_synonyms(SMALL)
    assert list(names) == list(CLASSES)
    assert all(2 <= len(names[name]) <= 5 and names[name][0] == name for name in CLASSES)
    every = [name for of_class in names.values() for name in of_class]
    assert len(set(every)) == len(every)
    # A name must not mean what the base model draws as something else.
    assert not {name for name in every if name not in CLASSES} & set(OBJECTS)


def test_the_base_model_has_class_names_and_held_out_names_as_whole_words():
    tokenizer = Tokenizer.from_file(str(BUNDLED_BASE_MODEL / "tokenizer" / "tokenizer.json"))
    tokenizer.no_padding()
    for name in CLASSES + HELD_OUT:
        tokens = tokenizer.encode(name, add_special_tokens=False).tokens
        assert tokens == [f"{word}</w>" for word in name.split()]
    # A photo of ... of the longest name fits between start and end.
    longest = max(
        len(tokenizer.encode(f"A photo of {name}").tokens) for n in studio_objects.NAMES.values() for name in n
    )
    assert longest <= 24


def test_compositions_are_those_that_the_grammar_has():
    grammar = {composition.name: composition for composition in all_compositions()}
    assert len(grammar) == len(all_compositions()) == 2 * len(NOUNS) * (len(NOUNS) - 1)
    assert all(parse_composition(name) == grammar[name] for name in COMPOSITIONS)
    # Two of them differ in nothing but the arrangement.
    assert {"star on house", "house with star"} <= set(COMPOSITIONS)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("cat", "expected `<noun> <relation> <noun>`"),
        ("cat under box", "expected one of on, with, got 'under'"),
        ("cat on street", "'street' is no noun"),
        ("cat on cat", "two different nouns"),
    ],
)
def test_other_sentences_are_refused(name, message):
    with pytest.raises(ValueError, match=message):
        parse_composition(name)


@pytest.mark.parametrize("relation", ["on", "with"])
def test_compositions_are_arranged_as_they_say(relation):
    """Two colours on white: the first is above the second, or left of it, and neither is cut off."""
    for seed in range(20):
        canvas = np.full((96, 96, 3), 235, np.uint8)
        rng = np.random.default_rng(seed)
        image = draw_composition(
            Composition("star", relation, "heart"), ("red", "blue"), canvas, rng, (0.6, 0.6)
        ).astype(int)
        rows, columns = np.mgrid[0:96, 0:96]
        red, blue = image[..., 0] - image[..., 2] > 60, image[..., 2] - image[..., 0] > 60
        assert red.sum() > 100 and blue.sum() > 100
        if relation == "on":
            assert rows[red].max() <= rows[blue].min() + 1
            assert abs(columns[red].mean() - columns[blue].mean()) < 8
        else:
            assert columns[red].max() <= columns[blue].min()
            assert abs(rows[red].max() - rows[blue].max()) <= 4
        drawn = (image != 235).any(axis=2)
        assert not drawn[[0, -1]].any() and not drawn[:, [0, -1]].any()


def test_drawings_take_any_shape_of_canvas_and_leave_it_alone():
    canvas = np.full((40, 90, 3), 200, np.uint8)
    rng = np.random.default_rng(0)
    for image in (
        draw_object("star", "red", canvas, rng, (0.9, 0.9)),
        draw_composition(Composition("cat", "with", "key"), ("red", "blue"), canvas, rng),
    ):
        assert image.shape == canvas.shape and image.dtype == np.uint8 and (canvas == 200).all()
        assert 0.05 < (image != canvas).any(axis=2).mean() < 0.5


def test_ordinary_classes_are_learnt_tested_and_sampled():
    assert [r.class_name for r in of_split("train")] == [name for name in CLASSES for _ in range(2)]
    assert [r.class_name for r in of_split("test")] == list(CLASSES)
    assert [r.class_name for r in of_split("condition")] == list(CLASSES)
    recordings = studio_objects.list_recordings(SMALL)
    assert len({r.recording_id for r in recordings}) == len({r.subject for r in recordings}) == len(recordings)
    assert all(r.has_events == (r.parts[0].split != "condition") and not r.has_intensity for r in recordings)
    assert recordings[0].recording_id == "train/airplane_00000" and recordings[0].sensor_size == (64, 64)


def test_held_out_classes_are_there_only_when_asked_for():
    assert not {r.class_name for r in studio_objects.list_recordings(SMALL)} & set(HELD_OUT)
    options = SMALL.model_copy(update={"classes": HELD_OUT})
    for split in ("train", "test", "condition"):
        assert list(dict.fromkeys(r.class_name for r in of_split(split, options))) == list(HELD_OUT)


def test_a_recording_depends_on_nothing_but_seed_split_class_and_index():
    chosen = [first_of(name) for name in ("cat", "windmill", "shoe")]
    alone = [studio_objects.read_events(recording, SMALL) for recording in chosen]
    with ThreadPoolExecutor(3) as threads:
        together = list(threads.map(lambda recording: studio_objects.read_events(recording, SMALL), chosen[::-1]))
    assert all(same_events(a, b) for a, b in zip(alone, together[::-1], strict=True))
    other = SMALL.model_copy(update={"classes": ("shoe", "cat"), "num_train_per_class": 9})
    assert same_events(studio_objects.read_events(chosen[0], other), alone[0])
    reseeded = SMALL.model_copy(update={"seed": 1})
    assert not same_events(studio_objects.read_events(chosen[0], reseeded), alone[0])
    second = of_split("train")[1]
    assert not same_events(
        studio_objects.read_events(second, SMALL), studio_objects.read_events(of_split("train")[0], SMALL)
    )


@pytest.mark.parametrize("class_name", ["airplane", "key", "umbrella", *UNSEEN, *COMPOSITIONS[:3]])
@pytest.mark.parametrize("motion", ["saccades", "square", "circle", "drift"])
def test_events_and_labels_keep_their_contracts(class_name, motion):
    options = Options(classes=(class_name,), num_train_per_class=1, motion=motion)
    recording = first_of(class_name, options)
    events = check_events(studio_objects.read_events(recording, options), recording.recording_id)
    labels = check_labels(studio_objects.read_labels(recording, options), recording.recording_id)
    assert labels.class_names == (class_name,) and labels.t_us.tolist() == [0]
    assert events.sensor_size == (64, 64) and events.t[-1] <= 300_000
    assert 500 < len(events) < 50_000


def test_events_lie_on_the_edges_of_the_drawing():
    """Without noise: an ideal pixel that sent an event saw the light change, by at least a threshold."""
    options = SMALL.model_copy(update={"sensor_preset": "ideal"})
    for class_name in ("star", "house", "fish"):
        recording = first_of(class_name, options)
        events, screen = (
            studio_objects.read_events(recording, options),
            studio_objects.moving_screen(recording, options),
        )
        seen = np.log(np.stack([screen(t) for t in np.linspace(0, 0.3, 301)]))
        counts = np.bincount(events.y.astype(int) * 64 + events.x, minlength=4096).reshape(64, 64)
        change = np.ptp(seen, axis=0)
        threshold = PRESETS["ideal"].threshold
        # 301 samples miss an extreme by little; twice the threshold allows for where the reference lies.
        assert (change[counts > 0] > 0.95 * threshold).all() and (counts[change > 2 * threshold] > 0).all()
        assert counts.sum() > 500


def test_any_background_leaves_two_colours_that_stand_out():
    for level in range(256):
        canvas = np.full((2, 2, 3), level, np.uint8)
        colours = studio_objects._visible_colours(canvas)
        assert len(colours) >= 2
        for colour in colours:
            shown = [studio_objects._luminance(np.array(c, np.uint8)) for c in (COLOURS[colour], canvas[0, 0])]
            assert abs(np.log(shown[0] / shown[1])) >= 0.799


def test_noise_and_size_are_difficulty():
    quiet, usual, loud = (SMALL.model_copy(update={"noise": noise}) for noise in (0.0, 1.0, 5.0))
    recording = first_of("moon with tower", options := SMALL.model_copy(update={"classes": HELD_OUT}))
    noisy = [
        len(studio_objects.read_events(recording, o.model_copy(update={"classes": options.classes})))
        for o in (quiet, usual, loud)
    ]
    assert noisy[0] < noisy[1] < noisy[2]
    still = read_sensor("noisy", 0.0)
    assert still.threshold_sigma == still.leak_rate_hz == still.shot_noise_rate_hz == still.hot_pixel_fraction == 0
    assert still.threshold == PRESETS["noisy"].threshold and read_sensor("noisy", 1e6).hot_pixel_fraction == 1
    small, large = (Options(object_size=size, sensor_preset="ideal") for size in ((0.2, 0.2), (0.8, 0.8)))
    extents = []
    for options in (small, large):
        events = studio_objects.read_events(first_of("star", options), options)
        counts = np.bincount(events.x, minlength=64)
        extents.append((counts > counts.max() / 8).sum())
    assert extents[0] < 0.5 * extents[1]


def test_intensity_frames_are_what_the_sensor_sees():
    options = SMALL.model_copy(update={"intensity_rate_hz": 50.0})
    recording = first_of("clock", options)
    assert recording.has_intensity and not of_split("condition", options)[0].has_intensity
    track = check_image_track(studio_objects.read_intensity_frames(recording, options), "clock")
    assert track.images.shape == (16, 64, 64) and track.t_us[1] == 20_000 and track.t_us[-1] == 300_000
    screen = studio_objects.moving_screen(recording, options)
    np.testing.assert_allclose(track.images[3] / 255, screen(0.06), atol=0.5 / 255 + 1e-6)
    with pytest.raises(DataError, match="asks for no pictures"):
        studio_objects.read_intensity_frames(first_of("clock"), SMALL)


@pytest.mark.parametrize(
    ("duration_us", "rate_hz", "count"), [(100_000, 10.0, 2), (70_000, 100.0, 8), (99_000, 10.0, 1)]
)
def test_there_is_a_picture_at_the_end_where_the_rate_says_so(duration_us, rate_hz, count):
    options = SMALL.model_copy(update={"recording_duration_us": duration_us, "intensity_rate_hz": rate_hz})
    track = studio_objects.read_intensity_frames(first_of("clock", options), options)
    assert track.t_us.tolist() == np.rint(1e6 * np.arange(count) / rate_hz).tolist()


def test_other_sensor_sizes_have_objects_of_the_same_share():
    options = Options(sensor_size=(120, 80), classes=("star",), sensor_preset="ideal")
    events = studio_objects.read_events(first_of("star", options), options)
    assert events.sensor_size == (120, 80) and np.ptp(events.y) > 35
    # The object stays in the square in the middle.
    counts = np.bincount(events.x, minlength=120)
    assert counts[20:100].sum() > 0.9 * counts.sum()


def test_a_sensor_may_come_from_a_file(tmp_path):
    file = tmp_path / "sensor.yaml"
    file.write_text("threshold: 0.6\n")
    options = SMALL.model_copy(update={"sensor_preset": str(file)})
    recording = first_of("star", options)
    assert recording.files == (file,) and of_split("condition", options)[0].files == ()
    ideal = SMALL.model_copy(update={"sensor_preset": "ideal"})
    assert (
        100
        < len(studio_objects.read_events(recording, options))
        < len(studio_objects.read_events(first_of("star", ideal), ideal))
    )
    file.write_text("threshold: -1\n")
    with pytest.raises(DataError, match="not a sensor preset"):
        studio_objects.list_recordings(options)
    file.unlink()
    with pytest.raises(DataError, match="No such file"):
        studio_objects.list_recordings(options)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"sensor_preset": "loud"}, f"expected one of {', '.join(PRESETS)}, or a file"),
        ({"classes": ("cat", "unicorn")}, "no class 'unicorn'; there are: airplane"),
        ({"classes": ("cat", "cat")}, "a class is named twice"),
        ({"object_size": (0.9, 0.5)}, "the lower first"),
        ({"motion": "jump"}, "saccades"),
        ({"sensor_size": (8, 64)}, "greater than or equal to 16"),
    ],
)
def test_wrong_options_are_named(wrong, message):
    with pytest.raises(ValidationError, match=message):
        Options(**wrong)


def test_unknown_recordings_are_refused():
    good = first_of("cat")
    held_out = first_of(HELD_OUT[0], Options(classes=HELD_OUT))
    wrong = [
        replace(good, recording_id="train/cat_x"),
        replace(good, class_name="dog"),
        replace(good, recording_id="nothing"),
        replace(good, sensor_size=(32, 32)),
        held_out,
    ]
    for recording in wrong:
        with pytest.raises(DataError, match="has no recording"):
            studio_objects.read_events(recording, SMALL)
    with pytest.raises(DataError, match="labels only"):
        studio_objects.read_events(of_split("condition")[0], SMALL)


def test_prompts_draw_from_the_names_of_a_class():
    options = text.Options(synonyms=studio_objects.read_synonyms(SMALL))
    for class_name, expected in (("boat", {"boat", "sailboat", "ship"}), ("cat on box", {"cat on box"})):
        recording = first_of(class_name, Options(classes=(class_name,)))
        labels = studio_objects.read_labels(recording, SMALL).take([0] * 40)
        prompts = text.render(labels, (64, 64), options, range(40)).prompts
        assert set(prompts) == {f"A photo of {name}" for name in expected}


def test_importing_the_plugin_is_cheap():
    code = "import sys; import ctlev_core.datasets.studio_objects;"
    code += "print([name for name in ('torch', 'numba', 'cv2', 'scipy') if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
