"""The endless stream of captioned pictures the small base model is pre-trained on. Never events, never a data set.

Half of the pictures are people: colour renderings of the procedural body in random poses and in poses of the procedural
motions that are not held out for tests, with what a ControlNet is steered by: the skeleton in the manner of OpenPose,
or the map of the body's normals. The others are everyday objects (`ctlev_core.studio.objects`), alone or two together
as a `Composition` says, without such a condition. A scene is drawn once and shown in several styles: photograph, grey
photograph, line drawing on black, coloured line drawing. A network that knows outlines needs far fewer event images to
learn what an event camera sees.

Scene i is a function of (seed, i) alone, style s of scene i of (seed, i, s).
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ctlev_core.body.layer import joint_transforms, load_body
from ctlev_core.body.motion.procedural import SEEN, UNSEEN, pose_at, sample_style
from ctlev_core.body.rotations import matrix_from_euler
from ctlev_core.conditions import normals
from ctlev_core.diffusion.pretraining.picture_styles import (
    DEFAULT_MIXTURE,
    OBJECT_CAPTIONS,
    PERSON_CAPTIONS,
    STYLE_CAPTIONS,
    DataMixture,
    Scene,
)
from ctlev_core.geometry.camera import is_inside, project
from ctlev_core.geometry.joint_sets import SMPL_JOINTS, SMPL_TO_DHP19
from ctlev_core.geometry.random_cameras import CameraRange, sample_camera
from ctlev_core.labels.body_views import labels_in_camera
from ctlev_core.render.skeleton import draw_skeleton
from ctlev_core.studio.compositions import RELATIONS, all_compositions
from ctlev_core.studio.object_drawing import draw_composition, draw_object
from ctlev_core.studio.objects import COLOURS, OBJECTS
from ctlev_core.studio.scene import render_person, sample_background, sample_subject

ConditionKind = Literal["skeleton", "normals"]
MOTION_SHARE = 0.55
"""Of the people, how many take their pose from a procedural motion, never a held-out one; the others' is random."""
POSE_NOISE_RAD = 0.15
PLAIN_PEOPLE_SHARE = 0.4
"""How many people stand before a plain background, so that their line drawings are clean."""
THING_SIZE = (0.6, 0.95)
CAMERA = CameraRange(distance_m=(3.0, 4.2), pitch_rad=(-0.3, 0.5), focal_per_side=(1.3, 1.9))
COMPOSITIONS = all_compositions()
# Words that captions never use, so that users' prompts find them in the vocabulary as whole words.
EXTRA_WORDS = """
    event events camera image images recording motion moving walking running jumping kicking punching dancing waving
    sitting standing turning lifting throwing reaching bending stretching hopping crouching crawling climbing
    falling people child boy girl player runner dancer animal vehicle plane aircraft sedan taxi van train motorcycle
    motorbike ship sailboat building home church castle barn door window wall tower plant leaf grass rose fruit pear
    orange lemon strawberry bread pizza mug glass jug pot kettle spoon fork knife plate bowl sofa couch bed desk
    stool bench mirror picture frame candle torch lantern watch bell drum piano violin trumpet flute laptop computer
    keyboard screen mouse horse cow sheep pig elephant lion tiger bear rabbit turtle snake frog duck chicken owl
    penguin shark dolphin whale crab spider ant bee beetle dragonfly leopard panda kangaroo crocodile dinosaur
    anchor barrel wrench saw pliers axe rocket helicopter balloon kite ball football basketball tennis racket
    skateboard helmet glove shirt dress trousers moth automobile kitten kitty seat timepiece teacup puppy hound goldfish
    blossom bloom acoustic mallet cottage latchkey stepladder fir shears sneaker trainer pentagram parasol mill
    small large big tall round square bright dark old new fast slow left right front back side view of the in on with
"""


def sample_pose(rng: np.random.Generator) -> np.ndarray:
    """A random pose [24, 3, 3] within rough human ranges, from relaxed standing to acrobatics."""
    angles = {name: np.zeros(3) for name in SMPL_JOINTS}  # degrees about x (first), y, z
    strength = rng.uniform(0.15, 1.0)

    def draw(low: float, high: float) -> float:
        return strength * rng.triangular(low, min(max(0.0, low), high), high)

    together = rng.random() < 0.25  # both legs alike: sitting, squatting, jumping
    hip, knee = draw(-100, 25), draw(0, 135)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        if not together:
            hip, knee = draw(-110, 35), draw(0, 130)
        angles[f"{side}_hip"] = np.array([hip, draw(-30, 30), sign * draw(-15, 50)])
        angles[f"{side}_knee"] = np.array([knee, 0.0, 0.0])
        angles[f"{side}_ankle"] = np.array([draw(-25, 35), 0.0, 0.0])
        # Arms hang at the sides by default; the rest pose is a T.
        elevation = -78 + strength * rng.beta(1.1, 1.6) * 160
        angles[f"{side}_shoulder"] = np.array([draw(-40, 40), -sign * draw(-40, 110), sign * elevation])
        angles[f"{side}_elbow"] = np.array([draw(-60, 60), -sign * strength * rng.uniform(0, 140), 0.0])
    bend, twist, lean = draw(-25, 60), draw(-45, 45), draw(-30, 30)
    for name in ("spine1", "spine2", "spine3"):
        angles[name] = np.array([bend, twist, lean]) / 3
    angles["neck"] = np.array([draw(-20, 30), draw(-40, 40), draw(-15, 15)])
    if rng.random() < 0.2:
        angles["pelvis"] = rng.uniform(-180, 180, 3)
    else:
        angles["pelvis"] = np.array([draw(-15, 30), 0.0, draw(-15, 15)])
    # Intrinsic Y X Z: swing forward and up first, twist last.
    return matrix_from_euler("YXZ", np.array([angles[name][[1, 0, 2]] for name in SMPL_JOINTS]))


def draw_person(rng: np.random.Generator, size: int, condition: ConditionKind = "skeleton") -> Scene:
    """A rendered person with their skeleton or normals; the pose is random."""
    subject = sample_subject(rng, colour=True)
    if rng.random() < MOTION_SHARE:
        motion = str(rng.choice(SEEN + UNSEEN))
        rotations = pose_at(motion, np.zeros(1), sample_style(motion, rng, POSE_NOISE_RAD))[0][0]
    else:
        rotations = sample_pose(rng)
    transl = np.zeros(3)
    _, joints = joint_transforms(load_body(), rotations[None], subject.betas, transl[None])
    camera = sample_camera(rng, joints[0], (size, size), CAMERA)
    background = sample_background(rng, (size, size), colour=True)
    if rng.random() < PLAIN_PEOPLE_SHARE:
        background[:] = background.mean(axis=(0, 1))
    linear = render_person(rng, subject, rotations, transl, camera, background, (size, size))
    image = (np.clip(linear, 0, 1) ** (1 / 2.2) * 255).round().astype(np.uint8)
    if condition == "normals":
        body = labels_in_camera(
            rotations[None], transl[None], subject.betas, camera, class_name="", t_us=np.zeros(1, int)
        )
        drawn = normals.render(body, (size, size), normals.Options(workers=1), [0]).images
        assert drawn is not None
        return Scene(image, drawn[0], "person")
    joints2d = project(camera, joints[0])[list(SMPL_TO_DHP19)]
    visible = is_inside(joints2d, (size, size))
    if rng.random() < 0.1:  # real labels miss joints
        visible &= rng.random(len(visible)) < 0.85
    return Scene(image, draw_skeleton(joints2d, visible, "dhp19", (size, size)), "person")


def draw_thing(rng: np.random.Generator, size: int, data_mixture: DataMixture = DEFAULT_MIXTURE) -> Scene:
    """An object, or two together, on a plain or stained background, without a condition."""
    background = sample_background(rng, (size, size), colour=True) ** (1 / 2.2) * 255
    if rng.random() < data_mixture.plain_share:
        background[:] = rng.choice((8, 60, 200, 250)) if rng.random() < 0.5 else background.mean(axis=(0, 1))
    canvas = background.astype(np.uint8)
    first, second = (str(colour) for colour in rng.choice(list(COLOURS), 2))
    if rng.random() < data_mixture.composition_share:
        composition = COMPOSITIONS[rng.integers(len(COMPOSITIONS))]
        image = draw_composition(composition, (first, second), canvas, rng)
        coloured = f"{first} {composition.first} {composition.relation} {second} {composition.second}"
        return Scene(image, None, composition.name, coloured)
    noun = str(rng.choice(list(OBJECTS)))
    return Scene(draw_object(noun, first, canvas, rng, THING_SIZE), None, noun, f"{first} {noun}")


def draw_scene(
    seed: int, index: int, size: int, condition: ConditionKind = "skeleton", data_mixture: DataMixture = DEFAULT_MIXTURE
) -> Scene:
    """Scene `index` of the stream, a function of its arguments alone."""
    rng = np.random.default_rng([seed, index])
    return (
        draw_person(rng, size, condition)
        if rng.random() < data_mixture.people_share
        else draw_thing(rng, size, data_mixture)
    )


def caption_corpus() -> list[str]:
    """Every kind of caption the stream can give, and further everyday words: what the tokenizer is trained on."""
    plain = [*PERSON_CAPTIONS]
    for noun in OBJECTS:
        plain += [
            form.format(plain=noun, coloured=f"{colour} {noun}") for form in OBJECT_CAPTIONS for colour in COLOURS
        ]
    styled = [form.format(caption) for form in STYLE_CAPTIONS.values() for caption in PERSON_CAPTIONS]
    # Repeated: byte-pair encoding makes a word of its own of what it sees often enough.
    return 4 * (plain + styled) + 40 * [*RELATIONS, *EXTRA_WORDS.split()]


def draw_chunk(
    seed: int,
    chunk: int,
    chunk_size: int,
    size: int,
    condition: ConditionKind = "skeleton",
    data_mixture: DataMixture = DEFAULT_MIXTURE,
) -> list[Scene]:
    """Scenes chunk * chunk_size .. (chunk + 1) * chunk_size - 1; what a worker process makes at a time."""
    indices = range(chunk * chunk_size, (chunk + 1) * chunk_size)
    return [draw_scene(seed, index, size, condition, data_mixture) for index in indices]
