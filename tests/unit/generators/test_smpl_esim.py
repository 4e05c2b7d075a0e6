"""SMPL-ESIM: events of a recorded body where, when and of the polarity that pictures of it say."""

from dataclasses import fields, replace

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from ctlev_core.body.layer import BUNDLED_BODY, load_body, pose_vertices
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.generators import smpl_esim
from ctlev_core.render.normals import render_normals
from ctlev_core.sensor.dvs_pixel import PRESETS, EventBudgetError, simulate_events
from data_contracts.errors import DataError
from data_contracts.events import check_events
from data_contracts.labels import BodyMotions, Conditions

SIZE = (40, 48)
KEYS, STEP_US, START_US = 5, 20_000, 700_000
INTRINSICS = np.array([60, 60, 20, 24], np.float32)


def motions_of(count=1, seed=0):
    """People 3 m away who wave, nod and shift by a few pixels."""
    random = np.random.default_rng(seed)
    pose = random.normal(0, 0.25, (count, 1, 72)) + np.cumsum(random.normal(0, 0.06, (count, KEYS, 72)), axis=1)
    pose[..., :3] = [np.pi, 0, 0]
    transl = np.array([0.0, 0.2, 3.0]) + np.cumsum(random.normal(0, 0.02, (count, KEYS, 3)), axis=1)
    t_us = START_US + STEP_US * np.arange(KEYS) + random.integers(0, 1000, (count, 1))
    return BodyMotions(
        t_us,
        t_us[:, KEYS // 2],
        pose.astype(np.float32),
        transl.astype(np.float32),
        random.normal(0, 1, (count, 10)).astype(np.float32),
        np.tile(INTRINSICS, (count, 1)),
    )


def take(motions, rows):
    return BodyMotions(*(getattr(motions, field.name)[rows] for field in fields(motions)))


def sideways(shift_m):
    """A T-pose that moves to the right of the picture."""
    motions = motions_of()
    pose = np.zeros_like(motions.smpl_pose)
    pose[..., 0] = np.pi
    transl = np.zeros_like(motions.smpl_transl)
    transl[..., 0] = np.linspace(-shift_m / 2, shift_m / 2, KEYS)
    transl[..., 2] = 3.0
    return replace(motions, smpl_pose=pose, smpl_transl=transl, smpl_betas=np.zeros_like(motions.smpl_betas))


def sample(motions, seeds=None, **options):
    seeds = range(len(motions)) if seeds is None else seeds
    conditions = Conditions(("",) * len(motions), None, motions)
    return list(smpl_esim.sample_events(conditions, SIZE, smpl_esim.SampleOptions(**options), seeds=seeds))


def scene_of(motions, row, seed, **options):
    return smpl_esim._scene(motions, row, SIZE, smpl_esim.SampleOptions(**options), seed, load_body())


def silhouette(motions, key):
    """Where the body of row 0 is at a key pose, [H, W] bool, from another renderer than the record's."""
    body = load_body()
    rotations = matrix_from_axis_angle(motions.smpl_pose[:, key].reshape(-1, 24, 3))
    vertices, _ = pose_vertices(body, rotations, motions.smpl_betas, motions.smpl_transl[:, key])
    return render_normals(vertices, body.faces, motions.intrinsics, SIZE)[1][0] > 0


def signed_counts(events):
    total = np.zeros(SIZE[::-1], int)
    np.add.at(total, (events.y, events.x), 2 * events.p.astype(int) - 1)
    return total


def counts(events):
    return np.bincount(events.y.astype(int) * SIZE[0] + events.x, minlength=SIZE[0] * SIZE[1])


def same_events(first, second):
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in "txyp")


def grown(mask):
    """With the eight neighbours of each pixel."""
    padded = np.pad(mask, 1)
    height, width = mask.shape
    return np.any([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=0)


@pytest.mark.parametrize("wall", ["brighter", "darker"])
def test_a_body_that_moves_aside_covers_the_wall_ahead_and_uncovers_it_behind(wall):
    motions = sideways(shift_m=0.35)  # 7 px
    before, after = silhouette(motions, 0), silhouette(motions, KEYS - 1)

    def is_clear(seed):
        scene = scene_of(motions, 0, seed, textured=False)
        body, level = scene.render_frames([0.0])[0][~grown(~before)], scene.background[0, 0]
        return level > 1.3 * body.max() if wall == "brighter" else 1.3 * level < body.min()

    seed = next(seed for seed in range(500) if is_clear(seed))
    (events,) = sample(motions, [seed], textured=False)
    ahead, behind = after & ~grown(before), before & ~grown(after)
    assert min(ahead.sum(), behind.sum()) > 40
    signed = signed_counts(events) * (1 if wall == "brighter" else -1)
    # Edge pixels, which the body covers in part, may change by less than a threshold.
    assert (signed[ahead & ~grown(~after)] < 0).all() and (signed[behind & ~grown(~before)] > 0).all()
    passed = grown(np.any([silhouette(motions, key) for key in range(KEYS)], axis=0) | grown(before) | grown(after))
    assert not counts(events).reshape(SIZE[::-1])[~passed].any()


@pytest.mark.parametrize("options", [{}, {"threshold": 0.1}, {"textured": False, "max_displacement_px": 2.0}])
def test_events_add_up_to_the_change_of_each_pixel(options):
    motions = motions_of(3)
    for row, events in enumerate(sample(motions, **options)):
        check_events(events, "test")
        assert events.sensor_size == SIZE and len(events) > 50
        assert motions.t_us[row, 0] <= events.t[0] and events.t[-1] <= motions.t_us[row, -1]
        scene = scene_of(motions, row, row, **options)
        first, last = scene.render_frames([0.0, 1e-6 * (KEYS - 1) * STEP_US]).astype(np.float64)
        floor = PRESETS["ideal"].log_floor
        # The response: a logarithm, below the floor its tangent.
        before, after = (
            np.where(level > floor, np.log(np.maximum(level, floor)), np.log(floor) + level / floor - 1)
            for level in (first, last)
        )
        threshold = options.get("threshold", 0.2)
        rest = after - before - threshold * signed_counts(events)
        # What has not reached the next threshold is less than one, whatever happened in between.
        assert np.abs(rest).max() < threshold * (1 + 1e-9)


def test_events_converge_to_those_of_very_many_pictures():
    motions = motions_of(3, seed=3)
    dense_us = np.arange(0, (KEYS - 1) * STEP_US + 1, 100)
    dense = [
        simulate_events(scene.render_frames(1e-6 * dense_us), dense_us, PRESETS["ideal"], sensor_seed=0, seed=0)
        for scene in (scene_of(motions, row, row) for row in range(3))
    ]
    lost = {}
    for displacement_px in (0.5, 0.0625):
        sampled = sample(motions, max_displacement_px=displacement_px)
        lost[displacement_px] = [1 - len(few) / len(many) for few, many in zip(sampled, dense, strict=True)]
        for few, many in zip(sampled, dense, strict=True):
            assert abs(few.p.mean() - many.p.mean()) < 0.01
            assert np.corrcoef(counts(few), counts(many))[0, 1] > (0.95 if displacement_px == 0.5 else 0.99)
    # What comes and goes within half a pixel of movement is not seen: measured 10 to 15 % of events, and up to 3 %.
    assert max(lost[0.5]) < 0.2 and max(np.abs(lost[0.0625])) < 0.05


def test_a_row_depends_on_itself_and_its_seed_alone():
    motions = motions_of(5)
    seeds = [11, 12, 13, 14, 15]
    together = sample(motions, seeds)
    order = [3, 0, 4]
    for row, alone in zip(order, sample(take(motions, order), [seeds[row] for row in order]), strict=True):
        assert same_events(alone, together[row])
    other = sample(motions, [11, 12, 13, 14, 16])
    assert same_events(other[3], together[3]) and not same_events(other[4], together[4])


def test_rows_come_one_by_one():
    motions = motions_of(2)
    conditions = Conditions(("",) * 2, None, motions)
    record = smpl_esim.sample_events(conditions, SIZE, smpl_esim.SampleOptions(), seeds=[0, 1])
    assert iter(record) is record
    assert len(next(record)) > 0 and len(next(record)) > 0
    with pytest.raises(StopIteration):
        next(record)


def test_nothing_happens_where_nobody_moves():
    motions = motions_of(3)
    still = replace(
        motions,
        smpl_pose=np.repeat(motions.smpl_pose[:, :1], KEYS, axis=1),
        smpl_transl=np.repeat(motions.smpl_transl[:, :1], KEYS, axis=1),
    )
    for events in sample(still):
        assert len(check_events(events, "test")) == 0 and events.sensor_size == SIZE


@pytest.mark.parametrize(
    ("start_m", "stop_m", "expected"),
    [
        ((0.0, 0.0, -3.0), (0.3, 0.0, -2.0), "nothing"),  # behind the camera
        ((40.0, 0.0, 3.0), (41.0, 0.0, 3.0), "nothing"),  # far beside the picture
        ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), "something"),  # through the camera
        ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), "anything"),  # around the camera
    ],
)
def test_bodies_out_of_sight_or_in_the_camera_do_no_harm(start_m, stop_m, expected):
    motions = sideways(0.1)
    placed = replace(motions, smpl_transl=np.linspace(start_m, stop_m, KEYS)[None].astype(np.float32))
    (events,) = sample(placed)
    check_events(events, "test")
    assert expected == "anything" or (len(events) > 0) == (expected == "something")


def test_events_are_on_the_clock_of_the_motion():
    motions = motions_of(2)
    late = 10**15  # 31 years
    shifted = replace(motions, t_us=motions.t_us + late, moment_us=motions.moment_us + late)
    for now, then in zip(sample(motions), sample(shifted), strict=True):
        assert same_events(now, replace(then, t=then.t - late))


def test_a_larger_threshold_sends_fewer_events():
    motions = motions_of(2)
    fine, coarse = (sum(len(events) for events in sample(motions, threshold=step)) for step in (0.1, 0.4))
    # A quarter of the crossings, and less: changes below the threshold are not seen at all.
    assert 0 < coarse < fine / 3.5


def test_a_camera_with_faults_adds_their_events(tmp_path):
    still = sideways(0.0)
    assert len(sample(still)[0]) == 0 < 20 < len(sample(still, sensor_preset="noisy")[0])

    def camera(**options):
        path = tmp_path / f"{len(options)}.yaml"
        path.write_text(yaml.safe_dump(PRESETS["ideal"].model_copy(update=options).model_dump(mode="json")))
        return path

    hot = str(camera(hot_pixel_fraction=0.01, hot_rate_hz=(2000.0, 2000.0)))
    first, second = (counts(events) > 50 for events in sample(take(still, [0, 0]), [1, 2], sensor_preset=hot))
    assert 5 < first.sum() < 40
    np.testing.assert_array_equal(first, second)  # all rows are of one camera
    assert not np.array_equal(first, counts(sample(still, [1], sensor_preset=hot, sensor_seed=4)[0]) > 50)

    coarse = camera(threshold=0.4, threshold_minimum=0.4)
    moving = sideways(0.2)
    assert same_events(sample(moving, sensor_preset=str(coarse))[0], sample(moving, threshold=0.4)[0])
    assert smpl_esim.input_files(smpl_esim.SampleOptions(sensor_preset=str(coarse))) == [coarse]
    with pytest.raises(ValidationError, match="expected one of ideal"):
        smpl_esim.SampleOptions(sensor_preset="nosy")


def test_texture_is_seen_inside_the_body():
    motions = sideways(0.1)
    motions.smpl_transl[..., 2] = 1.8  # 3.3 px
    inside = ~grown(~np.all([silhouette(motions, key) for key in range(KEYS)], axis=0))
    num_events = {}
    for textured in (True, False):
        rows = [counts(sample(motions, [seed], textured=textured)[0]) for seed in range(4)]
        num_events[textured] = np.sum(rows, axis=0).reshape(SIZE[::-1])[inside].sum()
    assert inside.sum() > 20 and num_events[True] > 3 * num_events[False]


def test_another_body_file_is_used(tmp_path):
    with np.load(BUNDLED_BODY) as arrays:
        larger = dict(arrays)
    larger["v_template"] = larger["v_template"] * np.float32(1.2)
    path = tmp_path / "large.npz"
    np.savez(path, **larger)
    motions = sideways(0.35)
    heights = [np.ptp(np.nonzero(signed_counts(sample(motions, body=body)[0]))[0]) for body in (None, path)]
    assert heights[1] > heights[0]
    assert smpl_esim.input_files(smpl_esim.SampleOptions(body=path)) == [path]
    assert smpl_esim.input_files(smpl_esim.SampleOptions()) == []
    with pytest.raises(DataError, match=r"none\.pkl: no such file; expected an SMPL body"):
        smpl_esim.input_files(smpl_esim.SampleOptions(body=tmp_path / "none.pkl"))


def test_a_row_beyond_the_budget_is_named():
    motions = motions_of(2)
    most = max(len(events) for events in sample(take(motions, [0])))
    record = smpl_esim.sample_events(
        Conditions(("",) * 2, None, motions), SIZE, smpl_esim.SampleOptions(max_events=most), seeds=[0, 1]
    )
    assert len(next(record)) == most
    assert issubclass(EventBudgetError, DataError)
    with pytest.raises(DataError, match=r"'smpl_esim', row 0: .*more than max_events = 10"):
        sample(motions, max_events=10)


def test_wrong_calls_are_refused_before_the_first_row():
    motions = motions_of(2)
    options = smpl_esim.SampleOptions()
    with pytest.raises(ValueError, match="use condition 'body_motion'"):
        smpl_esim.sample_events(Conditions(("", "")), SIZE, options, seeds=[0, 1])
    with pytest.raises(ValueError, match="2 conditions but 2 motions and 1 seeds"):
        smpl_esim.sample_events(Conditions(("", ""), None, motions), SIZE, options, seeds=[0])
    with pytest.raises(ValueError, match=r"sensor_size must be .* got \(40, 0\)"):
        smpl_esim.sample_events(Conditions(("", ""), None, motions), (40, 0), options, seeds=[0, 1])
    backwards = replace(motions, t_us=motions.t_us[:, ::-1])
    with pytest.raises(DataError, match="row 0 needs ascending times"):
        smpl_esim.sample_events(Conditions(("", ""), None, backwards), SIZE, options, seeds=[0, 1])


def test_no_rows_make_no_events():
    assert sample(take(motions_of(), [])) == []
