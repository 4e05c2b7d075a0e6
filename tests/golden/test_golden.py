"""The output of a plug-in is pinned to its VERSION.

A digest that differs means: the output changed. If that was meant, raise the plug-in's VERSION (so that nobody's cached
results go on being used) and write the new digest under the new version into digests.json; the failing test prints it.
Only outputs that are integers by construction are pinned here; floating-point results have tolerances elsewhere.
"""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from ctlev_core import plugins
from ctlev_core.labels.label_sampling import balanced_choice
from data_contracts.events import Events
from data_contracts.labels import Labels

DIGESTS = json.loads((Path(__file__).parent / "digests.json").read_text())


def digest(*arrays):
    content = hashlib.sha256()
    for array in arrays:
        array = np.ascontiguousarray(array)
        content.update(f"{array.dtype.str} {array.shape} ".encode() + array.tobytes())
    return content.hexdigest()[:32]


def fixed_events():
    """Made by integer arithmetic alone, so that they are the same everywhere and for ever."""
    n = np.arange(3000, dtype=np.int64)
    return Events(
        n * 7 + (n % 5),
        ((n * n * 31 + n) % 40).astype(np.uint16),
        ((n * 17 + n // 3) % 30).astype(np.uint16),
        ((n * n + n // 2) % 2).astype(np.uint8),
        (40, 30),
    )


def fixed_labels():
    n = np.arange(3 * 13, dtype=np.float32)
    joints = np.stack([(n * 7 % 61) + 0.5, (n * 11 % 59) + 1.25], -1).reshape(3, 13, 2)
    return Labels(("walk", "run", "traffic_light"), np.arange(3), joints, np.ones((3, 13), bool), "dhp19")


def histogram_counts(module):
    windows = np.array([[0, 1000], [1000, 1001], [2000, 2000], [500, 3000]])
    other_size = {"image_size": (16, 16), "fit": "crop", "resampling": "events"}
    options = [module.Options(), module.Options(polarity=False, **other_size)]
    return [module.encode(fixed_events(), windows, option) for option in options]


def written_bytes(module, tmp_path):
    module.write(tmp_path / "events", fixed_events())
    return [np.frombuffer((tmp_path / "events").read_bytes(), np.uint8)]


def prompts(module):
    options = module.Options(synonyms={"walk": ["walk", "stroll", "march"]})
    text = "\n".join(module.render(fixed_labels(), (64, 64), options, [1, 2, 3]).prompts)
    return [np.frombuffer(text.encode(), np.uint8)]


def skeletons(module):
    choices = module.Options(), module.Options(drawing="openpose"), module.Options(drawing="openpose", stick_width_px=4)
    return [module.render(fixed_labels(), (64, 64), options, [1, 2, 3]).images for options in choices]


def class_scores(module):
    """Rows right or wrong; of two equal maxima the first column wins."""
    probability = np.array([[4, 2, 2], [1, 3, 4], [3, 3, 2], [0, 8, 0]]) / 8
    predicted = {"probability": probability, "classes": np.array(["walk", "run", "jump"])}
    target = Labels(("walk", "run", "walk", "traffic_light"), np.arange(4))
    return [module.compute_rows(predicted, target, module.Options()).astype(np.uint8)]


def correct_joints(module):
    """Joints moved by 3-4-5 triangles and their multiples: ties at thresholds of 5 px are exact."""
    labels = fixed_labels()
    assert labels.joints2d is not None
    moved = labels.joints2d + np.arange(13)[:, None] % 3 * np.array([3, 4], np.float32)
    options = module.Options(normaliser="px", threshold=5)
    ((correct, count),) = module.compute_sums({"joints2d": moved}, labels, options).values()
    return [correct.astype(np.int64), count.astype(np.int64)]


CASES = {
    ("encodings", "event_histogram"): lambda module, _: histogram_counts(module),
    ("formats", "evt2"): written_bytes,
    ("formats", "evt3"): written_bytes,
    ("conditions", "skeleton"): lambda module, _: skeletons(module),
    ("conditions", "text"): lambda module, _: prompts(module),
    ("metrics", "classification"): lambda module, _: class_scores(module),
    ("metrics", "pck2d"): lambda module, _: correct_joints(module),
}


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_output_is_the_one_of_this_version(kind, name, tmp_path):
    module = plugins.load(kind, name)
    found = digest(*CASES[kind, name](module, tmp_path))
    key = f"{kind}/{name}.v{module.VERSION}"
    assert DIGESTS.get(key) == found, f'{key} is now "{found}"; see the head of this file'


def test_order_of_sampled_conditions_is_pinned():
    found = digest(balanced_choice(("a", "b", "b", "c", "a", "b"), ("r", "s", "s", "t", "u", "v"), 20, seed=7))
    assert DIGESTS.get("balanced_choice") == found, f'balanced_choice is now "{found}"; see the head of this file'
