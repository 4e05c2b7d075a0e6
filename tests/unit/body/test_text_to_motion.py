"""Sentences become motions that do what they say, are smooth, stand on the ground and do not slide."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import find_peaks

from ctlev_core.body.layer import load_body, pose_vertices
from ctlev_core.body.motion import keyframes
from ctlev_core.body.motion.clip import MotionClip, check_clip
from ctlev_core.body.motion.everyday_keyframes import EVERYDAY_MOTIONS
from ctlev_core.body.motion.ground_contact import body_path, find_contact
from ctlev_core.body.motion.procedural import CHANNELS, channels_at_phase, find_motion
from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from ctlev_core.body.text_to_motion.clauses import known_verbs
from ctlev_core.body.text_to_motion.compose import check_sentence, generate_motion
from ctlev_core.body.text_to_motion.grammar import parse_sentence
from ctlev_core.body.text_to_motion.words import WORDS
from ctlev_core.geometry.joint_sets import SMPL_JOINTS
from data_contracts.errors import DataError

BODY = load_body()
AT = {name: SMPL_JOINTS.index(name) for name in SMPL_JOINTS}
SENTENCES = (
    "a person walks, then jumps",
    "someone runs in a circle and then waves with the left hand",
    "a man walks slowly to the left, turns around and sits down",
    "a person picks up a box, kicks twice and lies down",
    "she does two push-ups, then gets up and marches",
    "he kneels, looks around, then takes two steps to the right while clapping",
)


def posed(clip: MotionClip) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [T, V, 3] and joints [T, 24, 3], m."""
    return pose_vertices(BODY, matrix_from_axis_angle(clip.pose.reshape(-1, 24, 3)), clip.betas, clip.transl)


def heading_deg(clip: MotionClip) -> np.ndarray:
    """Direction that the pelvis faces at each frame, left of +z, unwrapped."""
    forward = matrix_from_axis_angle(clip.pose[:, :3])[:, :, 2]
    return np.rad2deg(np.unwrap(np.arctan2(forward[:, 0], forward[:, 2])))


def slide_m_s(clip: MotionClip) -> np.ndarray:
    """Mean horizontal speed of the skin of the feet that touches the ground, a value a frame where any does."""
    vertices, _ = posed(clip)
    feet = np.isin(
        BODY.weight_indices[:, 0], [AT[f"{side}_{name}"] for side in ("left", "right") for name in ("ankle", "foot")]
    )
    soles = vertices[:, feet]
    down = (soles[:-1, :, 1] < 0.012) & (soles[1:, :, 1] < 0.012)
    speed = np.linalg.norm(np.diff(soles[..., ::2], axis=0), axis=-1) / np.diff(clip.time_s)[:, None]
    return np.array([speed[frame][down[frame]].mean() for frame in range(len(down)) if down[frame].any()])


def actions(sentence: str) -> list[tuple[str, int | None]]:
    return [(action.word.motion, action.count) for action in parse_sentence(sentence)]


def test_studio_keeps_its_motions():
    assert keyframes.SEEN == ("walk", "run", "punch", "jump")
    assert keyframes.HELD_OUT == ("spin_kick", "get_up", "cartwheel")
    assert keyframes.UNSEEN == (
        "wave", "squat", "jumping_jack", "bow", "dance", "spin", "lunge", "kick", "crawl", "throw", "stretch",
        "push_up", "sit_up",
    )  # fmt: skip
    assert not set(EVERYDAY_MOTIONS) & set(keyframes.MOTIONS)


@pytest.mark.parametrize("name", EVERYDAY_MOTIONS)
def test_key_poses_name_channels_that_exist(name):
    motion = find_motion(name)
    known = set(CHANNELS) | {channel[2:] for channel in CHANNELS if channel[1] == "_"}
    assert {channel for _, pose in motion.keys for channel in pose} | set(motion.base) <= known
    channels = channels_at_phase(name, np.linspace(0, 1, 50), 1.0, False)
    assert np.isfinite(channels).all() and np.abs(np.diff(channels, axis=0)).max() < 25.0


@pytest.mark.parametrize(
    ("sentence", "expected"),
    [
        ("a person walks, then jumps", [("walk", None), ("jump", None)]),
        ("Someone is jogging and then stopped.", [("run", None), ("stand", None)]),
        ("the man strolled; he kicked twice", [("walk", None), ("kick", 2)]),
        ("she does ten jumping jacks before sitting down", [("jumping_jack", 10), ("sit_down", None)]),
        ("after walking, he lay down", [("walk", None), ("lie_down", None)]),
        ("throws a punch three times", [("punch", 3)]),
        ("throws a ball", [("throw", None)]),
        ("a person takes 4 steps backwards", [("walk", 4)]),
        ("walks 5 steps", [("walk", 5)]),
        ("starts to run, then begins spinning", [("run", None), ("spin", None)]),
        ("shakes his head", [("shake_head", None)]),
        ("waves with one hand", [("wave", None)]),
        ("looks left and right", [("look", None)]),
        ("slowly, a person bends over", [("bow", None)]),
    ],
)  # fmt: skip
def test_sentences_are_taken_apart(sentence, expected):
    assert actions(sentence) == expected


def test_details_go_to_their_action():
    first, second, third = parse_sentence(
        "a woman walks very slowly for 2.5 seconds, turns 45 degrees to the left and waves with her right hand"
    )
    assert first.duration_s == 2.5 and first.speed == pytest.approx(0.65**1.6)
    assert second.angle_deg == 45 and second.directions == {"left"} and not second.limbs
    assert third.limbs == "right" and not third.directions
    (both,) = parse_sentence("walks while waving")
    assert both.meanwhile is not None and both.meanwhile.verb == "wave"
    for same in ("waves and walks at the same time", "while walking, he waves"):
        assert parse_sentence(same) == parse_sentence("waves while walking")


@pytest.mark.parametrize(
    ("sentence", "message"),
    [
        ("a person moonwalks", r"unknown word 'moonwalks' \(nearest known: .*walk.*\); known actions: amble, .*wave"),
        ("a person walks sadly", "unknown word 'sadly'"),
        ("a person", "names no action; known: amble"),
        ("", "expected words"),
        ("walks jumps", "'jumps' follows 'walk' without"),
        ("kicks with his hand", "'kick' does not know what to do with arms"),
        ("kicks backward", "'kick' cannot go 'backward'; possible: forward"),
        ("walks left and right", "cannot go left and right at once"),
        ("jumps 3 times for 4 seconds", "a count and a duration"),
        ("walks three times", "say for how many steps"),
        ("sits down twice", "cannot be counted"),
        ("jumps 0 times", "0 count: expected a whole number"),
        ("walks for 1000 seconds", "1000 duration: expected more than 0 and at most 120"),
        ("sits after walking", "turns the order round"),
        ("before walking he sits", "turns the order round"),
        ("while walking he waves", "'waves' follows 'walk' without"),
        ("while walking", "nothing that is done meanwhile"),
        ("walks at the same time", "as what"),
        ("kicks while jumping", "cannot be done at the same time"),
        ("walks while waving while nodding", "third thing"),
        ("crawls while drinking", "'crawl' needs the hands"),
        ("walks #3", "'#' is neither"),
        ("raises", "needs an arm"),
        ("\N{GREEK SMALL LETTER ALPHA} walks", "is neither a word nor a number"),
        ("kicks 80 times, then kicks 80 times", "more than the limit of 120 s"),
        ("waves with both hands", "'wave' is done with one arm; say left, right, or neither"),
        ("waves his hands", "'wave' is done with one arm"),
        ("kicks with both legs", "'kick' is done with one leg"),
        ("punches once with the left hand", "'punch' is done with both arms in turn"),
        ("jumps once, then three times", "'jump' has two values of count"),
    ],
)  # fmt: skip
def test_what_is_not_understood_is_named_and_never_passed_over(sentence, message):
    with pytest.raises(DataError, match=message) as error:
        check_sentence(sentence)
    assert str(error.value).startswith(f"sentence {sentence!r}: ")


@given(
    st.text(max_size=60)
    | st.lists(st.sampled_from([*known_verbs(), "then", "while", "left", "3", "twice"])).map(" ".join)
)
def test_any_text_is_understood_or_refused(sentence):
    try:
        check_sentence(sentence)
    except DataError as error:
        assert "sentence" in str(error)


@pytest.mark.parametrize("word", WORDS, ids=[f"{word.motion}-{word.kind}" for word in WORDS])
def test_every_word_of_the_vocabulary_makes_a_motion(word):
    limb = " the left hand" if word.motion == "raise_arm" else ""
    for phrase in word.phrases:
        check_sentence(f"a person {phrase}{limb}")
    clip = generate_motion(f"{word.phrases[0]}{limb}", rate_hz=20)
    assert 0.3 < clip.time_s[-1] < 15 and np.abs(np.diff(clip.pose[:, 3:], axis=0)).max() > 1e-3


@pytest.mark.parametrize("sentence", SENTENCES)
def test_motions_are_smooth_and_stay_on_the_ground(sentence):
    clip = check_clip(generate_motion(sentence), sentence)
    vertices, joints = posed(clip)
    lowest = vertices[..., 1].min(axis=1)
    # Soft contact lets the lowest vertices sink in by about its softness of 4 mm.
    assert lowest.min() > -0.02
    if "jump" not in sentence and "run" not in sentence:
        # Knees that take up the shock of a step let the body be up to 15 mm off, smoothed legs as much again.
        assert lowest.max() < 0.03
    # A kicking foot reaches 10 m/s; a gap between two clips would be several decimetres in a frame, 20 m/s and more.
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1) * 60
    assert speed.max() < 12.0
    turns = matrix_from_axis_angle(clip.pose.reshape(-1, 24, 3))
    steps = axis_angle_from_matrix(np.swapaxes(turns[:-1], -1, -2) @ turns[1:])
    # A kick's knee turns a quarter in a tenth of a second, 15 degrees a frame.
    assert np.rad2deg(np.linalg.norm(steps, axis=-1)).max() < 25.0


@pytest.mark.parametrize("sentence", SENTENCES)
def test_planted_feet_do_not_slide(sentence):
    # 0.02 to 0.09 over these; the key poses alone, on the ground, have 0.05 to 0.15, and 0.4 set on joints.
    assert slide_m_s(generate_motion(sentence)).mean() < 0.12


def test_walking_slides_no_more_than_a_twentieth_of_its_speed():
    clip = generate_motion("a person walks for 4 seconds")
    speed = clip.transl[-1, 2] / 4
    assert 1.0 < speed < 2.0
    assert slide_m_s(clip).mean() < 0.05 * speed


def test_bodies_have_inertia():
    walking = generate_motion("a person walks for 4 seconds", rate_hz=100)
    pelvis = posed(walking)[1][:, 0]
    acceleration = np.linalg.norm(np.diff(pelvis, 2, axis=0), axis=-1) * 100**2
    # A walker's trunk has a few m/s2. The steps of these key poses make 36 at a heel strike, and 130 without inertia.
    assert acceleration.max() < 50.0 and acceleration.mean() < 12.0


def test_directions_are_those_of_the_person():
    def moved(sentence: str) -> tuple[float, float, float]:
        clip = generate_motion(sentence, rate_hz=30)
        return clip.transl[-1, 0], clip.transl[-1, 2], heading_deg(clip)[-1]

    left, forward, heading = moved("a person walks")
    assert forward > 3.0 and abs(left) < 0.3 and abs(heading) < 8
    assert moved("a person walks backward")[1] < -2.0
    left, _, heading = moved("a person walks to the left")
    assert left > 2.0 and heading == pytest.approx(90, abs=10)
    assert moved("a person walks to the right")[0] < -2.0
    left, forward, heading = moved("a person takes three steps to the left")
    assert left > 0.5 and abs(forward) < 0.2 and abs(heading) < 8
    assert moved("a person jumps forward")[1] > 0.4 > abs(moved("a person jumps")[1])
    assert abs(moved("a person walks in place")[1]) < 0.2
    assert moved("a person walks while turning left")[2] == pytest.approx(90, abs=10)


@pytest.mark.parametrize(
    ("sentence", "degrees"),
    [
        ("turns left", 90),
        ("turns right", -90),
        ("turns 30 degrees to the right", -30),
        ("turns around to the left", 180),
    ],
)
def test_turns_turn(sentence, degrees):
    clip = generate_motion(sentence, rate_hz=30)
    assert heading_deg(clip)[-1] == pytest.approx(degrees, abs=8)
    assert np.linalg.norm(clip.transl[-1, ::2]) < 0.4


def test_a_circle_closes():
    clip = generate_motion("a person walks in a circle to the left", rate_hz=30)
    assert heading_deg(clip)[-1] == pytest.approx(360, abs=10)
    way = np.linalg.norm(np.diff(clip.transl[:, ::2], axis=0), axis=1).sum()
    assert way > 5.0 and np.linalg.norm(clip.transl[-1, ::2]) < 0.1 * way


def test_clips_begin_where_the_one_before_ended_and_as_it_faced():
    clip = generate_motion("a person turns left, then walks", rate_hz=30)
    walked = clip.transl[-1] - clip.transl[len(clip) // 2]
    assert walked[0] > 1.0 and abs(walked[2]) < 0.3 * walked[0]


def test_somebody_who_sits_is_at_the_height_of_a_chair_with_both_feet_down():
    clip = generate_motion("a person sits down for 2 seconds", rate_hz=30)
    vertices, joints = posed(clip)
    assert 0.85 < joints[0, 0, 1] < 1.05 and 0.35 < joints[-1, 0, 1] < 0.65
    for foot in ("left_foot", "right_foot"):
        sole = vertices[-1, BODY.weight_indices[:, 0] == AT[foot], 1]
        # Habits tilt a foot by a few degrees.
        assert abs(sole.min()) < 0.035
    assert joints[-1, 0, 2] < joints[-1, AT["left_foot"], 2] - 0.3
    up = generate_motion("a person stands up", rate_hz=30)
    heights = posed(up)[1][:, 0, 1]
    assert heights[0] < 0.65 and heights[-1] > 0.85


def test_somebody_who_sits_waves_sitting_and_rises_to_walk():
    _, seated = posed(generate_motion("sits down, then waves", rate_hz=30))
    hands = seated[:, [AT["left_hand"], AT["right_hand"]], 1].max()
    assert seated[-1, 0, 1] < 0.65 and hands > seated[-1, AT["neck"], 1]
    walking = posed(generate_motion("sits down, then walks", rate_hz=30))[1]
    assert walking[:, 0, 1].min() < 0.65 and walking[-1, 0, 1] > 0.85


def test_somebody_who_lies_touches_the_ground_with_the_back():
    vertices, joints = posed(generate_motion("a person lies down", rate_hz=30))
    assert joints[-1, [AT["pelvis"], AT["spine3"], AT["left_ankle"]], 1].max() < 0.3
    assert vertices[-1, :, 1].min() > -0.012


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_side_that_is_said_moves(side):
    other = "right" if side == "left" else "left"
    for seed in range(3):
        _, joints = posed(generate_motion(f"a person waves with the {side} hand", seed=seed, rate_hz=30))
        assert joints[:, AT[f"{side}_hand"], 1].max() > 1.3 > joints[:, AT[f"{other}_hand"], 1].max()
    _, joints = posed(generate_motion(f"a person kicks with the {side} leg", rate_hz=60))
    assert joints[:, AT[f"{side}_foot"], 1].max() > 0.8 > joints[:, AT[f"{other}_foot"], 1].max()


def test_the_arms_do_one_thing_while_the_legs_do_another():
    walk = generate_motion("a person walks for 3 seconds", rate_hz=30)
    both = generate_motion("a person walks for 3 seconds while raising both arms", rate_hz=30)
    _, joints = posed(both)
    assert joints[:, AT["left_hand"], 1].max() > 1.6 and joints[:, AT["right_hand"], 1].max() > 1.6
    assert both.transl[-1, 2] == pytest.approx(walk.transl[-1, 2], rel=0.3)  # another performance


def test_counts_and_durations_are_kept():
    _, joints = posed(generate_motion("a person jumps three times", rate_hz=60))
    airborne = joints[:, :, 1].min(axis=1) > 0.15
    assert np.count_nonzero(np.diff(airborne.astype(int)) == 1) == 3
    assert generate_motion("a person walks for 2.5 seconds").time_s[-1] == pytest.approx(2.5, abs=0.02)
    one, two = (generate_motion(f"a person squats {count}").time_s[-1] for count in ("once", "twice"))
    assert two > 1.6 * one
    slow, fast = (generate_motion(f"a person takes four steps {how}").time_s[-1] for how in ("slowly", "quickly"))
    assert slow > 1.5 * fast


@pytest.mark.parametrize(("sentence", "count"), [("punches twice", 2), ("punches 5 times", 5), ("punches", 2)])
def test_every_punch_counts(sentence, count):
    motion = generate_motion(f"a person {sentence}", rate_hz=60, seed=0)
    _, joints = posed(motion)
    punches = 0
    for side in ("left", "right"):
        wrist, shoulder = (joints[:, SMPL_JOINTS.index(f"{side}_{name}")] for name in ("wrist", "shoulder"))
        reach = np.linalg.norm(wrist - shoulder, axis=1)
        punches += len(find_peaks(reach, height=0.45, prominence=0.1)[0])
    assert punches == count


def test_the_seed_decides_and_nothing_else_does():
    first, again = (generate_motion(SENTENCES[0], seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.pose, again.pose)
    np.testing.assert_array_equal(first.transl, again.transl)
    assert first.caption == SENTENCES[0]
    other = generate_motion(SENTENCES[0], seed=4)
    rows = min(len(first), len(other))
    assert np.abs(first.pose[:rows] - other.pose[:rows])[:, 3:].max() > 0.05


def test_moments_do_not_depend_on_the_rate():
    slow, fast = (generate_motion(SENTENCES[0], rate_hz=rate) for rate in (15, 60))
    np.testing.assert_allclose(slow.pose, fast.pose[::4][: len(slow)], atol=1e-9)
    np.testing.assert_allclose(slow.transl, fast.transl[::4][: len(slow)], atol=1e-12)


def test_wrong_calls_are_refused():
    for rate_hz in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="rate_hz"):
            generate_motion("a person walks", rate_hz=rate_hz)
    with pytest.raises(ValueError, match="seed"):
        generate_motion("a person walks", seed=-1)


@settings(max_examples=5)
@given(st.integers(0, 10_000))
def test_any_pose_is_set_on_the_ground(seed):
    random = np.random.default_rng(seed)
    vectors = random.normal(0, 0.6, (1, 24, 3)) + np.linspace(0, 0.05, 6)[:, None, None] * random.normal(
        size=(1, 24, 3)
    )
    rotations = matrix_from_axis_angle(vectors)
    transl = body_path(find_contact(rotations), np.ones(6), 0.01)
    vertices, _ = pose_vertices(BODY, rotations, np.zeros(10), transl)
    # 4 mm of softness, and 15 mm by which knees may take up a shock.
    assert (np.abs(vertices[..., 1].min(axis=1)) < 0.02).all()
    assert (transl[0, ::2] == 0).all()
