"""What nobody should give to the public interface: refused by name, or an empty result, and never a wrong one."""

import os

import numpy as np
import pytest
from generated_frames import make_recorded

import ctlev_core as ctlev
from ctlev_core.trained_generator import TrainedGenerator
from data_contracts.errors import DataError
from data_contracts.events import Events


def events(t, x=None, p=None):
    x = np.arange(len(t)) if x is None else x
    columns = np.asarray(x, np.uint16), np.zeros(len(t), np.uint16), np.asarray([1] * len(t) if p is None else p)
    return Events(np.asarray(t, np.int64), *columns[:2], columns[2].astype(np.uint8), (4, 4))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (events([1, 2, 3], p=[1]), "column p has 1 rows"),
        (events([1, 2], p=[2, 0]), "p must be below 2"),
        (events([1, 2], x=[4, 0]), "x must be below 4"),
        (events([0, 100, 50]), "t decreases at event 2"),
        (Events(np.arange(2), np.array([-1, 1]), np.array([0, 0]), np.array([0, 1]), (4, 4)), "column x must be"),
    ],
)
def test_events_that_no_reader_returns_are_not_counted(given, told):
    with pytest.raises(DataError, match=f"histogram: .*{told}"):
        ctlev.histogram(given, duration_us=50)


@pytest.mark.parametrize("asked", [{"num_events": 0}, {"duration_us": -1}, {"duration_us": 1 << 64}])
def test_windows_of_nothing_are_refused(asked):
    with pytest.raises(ValueError, match=f"histogram: {next(iter(asked))} must be above 0"):
        ctlev.histogram(events([1, 2]), **asked)


def test_times_of_frames_are_whole_microseconds():
    frames = np.random.default_rng(0).uniform(0.1, 1, (3, 4, 4))
    wanted = ctlev.simulate(frames, [0, 10_000, 20_000], noise=0)
    same = ctlev.simulate(frames, np.arange(3).astype("timedelta64[ms]") * 10, noise=0)
    assert len(wanted) and np.array_equal(wanted.t, same.t)
    assert np.array_equal(wanted.t, ctlev.simulate(frames, [0.0, 10_000.0, 20_000.0], noise=0).t)
    for wrong in ([0, 0.5, 1], [0, np.nan, 1], [0, np.inf, 1], ["0", "1", "2"], [0, 1, 1 << 63], [True, True, True]):
        with pytest.raises(DataError, match="simulate: times must be whole microseconds"):
            ctlev.simulate(frames, np.array(wrong))


@pytest.mark.parametrize("seed", [-1, 1.5, None, "1", True])
def test_seeds_are_whole_numbers(seed, tmp_path):
    frames, picture = np.zeros((2, 4, 4)), np.zeros((8, 8, 3), np.uint8)
    for call in (
        lambda: ctlev.simulate(frames, [0, 10], seed=seed),
        lambda: TrainedGenerator(tmp_path, "controlnet").sample(images=picture, seed=seed),
    ):
        with pytest.raises(ValueError, match="seed must be a whole number of 0 or more"):
            call()


def test_noise_is_finite():
    with pytest.raises(ValueError, match="noise must be a factor of 0 or more, got inf"):
        ctlev.simulate(np.zeros((2, 4, 4)), [0, 10], noise=float("inf"))


@pytest.mark.parametrize("camera", [{"distance_m": 0}, {"distance_m": float("nan")}, {"yaw_deg": float("inf")}])
def test_a_camera_that_sees_nothing_is_refused(camera):
    with pytest.raises(DataError, match="normal_map: yaw, pitch and a distance above 0 m"):
        ctlev.normal_map(**camera)


def test_visible_has_the_shape_of_the_joints():
    target = np.zeros((2, 13, 2))
    target[1, 1] = [26, 0]
    hidden = np.ones((2, 13), bool)
    hidden[1, 1] = False
    assert ctlev.mpjpe(np.zeros((2, 13, 2)), target, visible=hidden) == 0.0
    assert ctlev.mpjpe(np.zeros((13, 2)), target[1], visible=hidden[1]) == 0.0
    for wrong in (hidden.T, hidden[1], hidden[None]):
        for call in (ctlev.mpjpe, lambda p, t, visible: ctlev.pck(p, t, 5, normaliser="px", visible=visible)):
            with pytest.raises(ValueError, match=r"visible must be \[2, 13\], as the joints are"):
                call(np.zeros((2, 13, 2)), target, visible=wrong)
        with pytest.raises(ValueError, match=r"skeleton_map: visible must be \[2, 13\]"):
            ctlev.skeleton_map(target, visible=wrong)


def test_options_of_other_joints_are_refused():
    with pytest.raises(ValueError, match="visible is of joints in the image"):
        ctlev.mpjpe(np.zeros((24, 3)), np.ones((24, 3)), visible=np.ones(24))
    with pytest.raises(ValueError, match="alignment is of joints in space, got 'procrustes'"):
        ctlev.mpjpe(np.zeros((13, 2)), np.ones((13, 2)), alignment="procrustes")
    with pytest.raises(ValueError, match=r"pck.*normaliser"):
        ctlev.pck(np.zeros((13, 2)), np.ones((13, 2)), normaliser="x")


def test_nothing_to_draw_is_no_picture(tmp_path):
    assert ctlev.skeleton_map(np.zeros((0, 13, 2)), image_size=(8, 6)).shape == (0, 6, 8, 3)
    assert ctlev.normal_map(pose=np.zeros((0, 72)), image_size=(8, 6)).shape == (0, 6, 8, 3)
    with pytest.raises(ValueError, match="nothing was asked for"):
        TrainedGenerator(tmp_path, "controlnet").sample(images=np.zeros((0, 8, 8, 3), np.uint8))


def test_sizes_are_whole_pixels(tmp_path):
    with pytest.raises(ValueError, match="size must be two whole numbers of px"):
        ctlev.simulate_video(tmp_path, size=(34.5, 26))


def test_a_dataset_stays_where_it_was_opened(tmp_path, monkeypatch):
    made, frames = make_recorded(tmp_path)
    monkeypatch.chdir(made.path.parent)
    dataset = ctlev.EventDataset(made.path.name)
    os.chdir(tmp_path)
    assert dataset[0]["image"].shape[1:] == frames.shape[1:3]
    for names in (["walk", "walk"], "walk"):
        with pytest.raises(ValueError, match="class_names must be different names"):
            ctlev.EventDataset(made.path, class_names=names)


def test_windows_of_a_pause_are_left_out():
    t = np.array([0, 35, 49])
    none = np.zeros(3, np.uint16)
    counts = ctlev.histogram(Events(t, none, none, np.ones(3, np.uint8), (1, 1)), duration_us=10)
    assert counts[:, 0, 0, 0].tolist() == [1, 1, 1]  # of 0 .. 9, 30 .. 39 and 40 .. 49 us
