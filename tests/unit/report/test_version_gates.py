"""Gates before a version becomes the latest: each at, below and above its limit."""

import numpy as np
import pytest
from pydantic import ValidationError

from ctlev_core.realism.distances import FRAME_DISTANCES, estimate_distances
from ctlev_core.realism.summary import summarise_frames
from ctlev_core.report.version_gates import check_asked, check_gates
from data_contracts.errors import DataError
from data_contracts.regeneration import Gates, Regeneration

OFF = dict.fromkeys(Gates.model_fields)
DIGEST = "0123abcd"


def row(task, training_set, metric, value, group="all"):
    return {
        "task": task,
        "subject": training_set,
        "metric": metric,
        "value": value,
        "group": group,
        "num_samples": 1000,
    }


def scores(distance=6.0, error=9.0, copies=(0.01, 0.02), metric="mpjpe2d_px", realism=(0.75, 0.1)):
    real_error = 6.0 if metric == "mpjpe2d_px" else 0.75
    return [
        row("distance", "held-out recorded", f"fd_event_classifier_{DIGEST}", 3.0),
        row("distance", "held-out recorded", f"kid_event_classifier_{DIGEST}", -0.1),
        row("distance", "synthetic", f"kid_event_classifier_{DIGEST}", 99.0),
        row("distance", "synthetic", f"fd_event_classifier_{DIGEST}", distance),
        row("memorisation", "synthetic", "duplicates", 5.0, "small pictures"),
        row("memorisation", "synthetic", "close_share", copies[0], "small pictures"),
        row("memorisation", "synthetic", "close_share", copies[1], "features of classifier"),
        row("net", "recorded", metric, real_error),
        row("net", "recorded", metric, 100.0, "walk"),
        row("net", "recorded", "pck_px4", 0.9),
        row("net", "label agreement of synthetic", metric, error),
        row("net", "label agreement of synthetic", "pck_px4", 0.1),
        row("realism", "synthetic against recorded", "c2st", 0.99, "frames"),
        row("realism", "synthetic against test", "c2st", realism[0], "frames"),
        row("realism", "recorded against recorded", "isolated_pixel_share", 0.9, "frames"),
        row("realism", "synthetic", "isolated_pixel_share", 0.9, "frames"),
        row("realism", "synthetic against recorded", "isolated_pixel_share", realism[1], "frames"),
    ]


@pytest.mark.parametrize(
    ("gates", "num_frames", "message"),
    [
        ({"max_realism_distances": {"isolated_pixels": 1}}, 100, "no distance 'isolated_pixels'; known: active_pixel_"),
        ({"max_c2st": 0.8}, 39, "max_c2st: needs num_synthetic of 40 or more, got 39"),
    ],
)
def test_what_will_never_be_measured_is_refused_before_anything_runs(gates, num_frames, message):
    with pytest.raises(DataError, match=message):
        check_asked(Gates(**gates), num_frames)
    check_asked(Gates(max_c2st=0.8, max_realism_distances={"value_js_bits": 0.1}), 40)


def test_every_distance_of_frames_has_a_name():
    frames = np.random.default_rng(0).integers(0, 256, (4, 16, 16, 3), dtype=np.uint8)
    summaries = [summarise_frames(frames)] * 2
    assert set(estimate_distances(summaries, summaries)) == set(FRAME_DISTANCES)


def check(gates, found, rejected_share=0.0):
    return check_gates(
        Gates(**{**OFF, **gates}),
        found,
        task="net",
        labels_of="label agreement of synthetic",
        rejected_share=rejected_share,
    )


@pytest.mark.parametrize(
    ("gate", "at_limit", "above", "limit"),
    [
        ({"max_distance_ratio": 2}, scores(distance=6.0), scores(distance=6.01), 6.0),
        ({"max_label_error_ratio": 1.5}, scores(error=9.0), scores(error=9.01), 9.0),
        # Accuracy .75 is an error of .25, and twice that an accuracy of .5.
        (
            {"max_label_error_ratio": 2},
            scores(error=0.5, metric="accuracy"),
            scores(error=0.49, metric="accuracy"),
            0.5,
        ),
        ({"max_memorised_share": 0.02}, scores(), scores(copies=(0.03, 0.0)), 0.02),
        ({"max_c2st": 0.75}, scores(), scores(realism=(0.76, 0.1)), 0.75),
        ({"max_realism_distances": {"isolated_pixel_share": 0.1}}, scores(), scores(realism=(0.5, 0.11)), 0.1),
    ],
)
def test_each_gate_is_kept_up_to_its_limit(gate, at_limit, above, limit):
    (kept,), (broken,) = check(gate, at_limit), check(gate, above)
    assert kept.passed and not broken.passed
    assert kept.gate == next(iter(gate)) and kept.limit == broken.limit == limit


def test_refused_frames_are_judged_by_their_share():
    assert [check({"max_rejected_share": 0.1}, [], share)[0].passed for share in (0.1, 0.11)] == [True, False]


def test_gates_that_are_not_asked_need_no_scores():
    assert check({}, []) == []


@pytest.mark.parametrize(
    ("gate", "without"),
    [
        ({"max_distance_ratio": 2}, ("distance", "synthetic", "fd_")),
        ({"max_distance_ratio": 2}, ("distance", "held-out recorded", "fd_")),
        ({"max_label_error_ratio": 2}, ("net", "recorded", "")),
        ({"max_memorised_share": 1}, ("memorisation", "synthetic", "close")),
        ({"max_c2st": 1}, ("realism", "synthetic against test", "c2st")),
        ({"max_realism_distances": {"isolated_pixel_share": 1}}, ("realism", "synthetic against recorded", "isolated")),
    ],
)
def test_a_gate_without_its_score_is_no_gate_that_was_kept(gate, without):
    task, training_set, metric = without
    found = [
        r
        for r in scores()
        if not (r["task"] == task and r["subject"] == training_set and r["metric"].startswith(metric))
    ]
    with pytest.raises(DataError, match="gate"):
        check(gate, found)


def test_no_error_of_real_frames_leaves_no_room():
    found = [r | {"value": 0.0} if (r["task"], r["subject"]) == ("net", "recorded") else r for r in scores(error=0.1)]
    assert not check({"max_label_error_ratio": 100}, found)[0].passed


EXPERIMENT = {
    "name": "x",
    **{part: {"name": "x"} for part in ("dataset", "encoding", "condition", "generator", "downstream")},
    "num_synthetic": 1,
    "metrics": [{"name": "x"}],
}
WITH_FEATURES = EXPERIMENT | {"feature_extractor": {"name": "x"}}


def test_a_distance_that_cannot_be_measured_is_refused_unless_it_is_not_asked_for():
    with pytest.raises(ValidationError, match="needs a feature_extractor"):
        Regeneration.model_validate(EXPERIMENT)
    with pytest.raises(ValidationError, match="frechet among the distances"):
        Regeneration.model_validate(WITH_FEATURES | {"distances": [{"name": "kid"}]})
    assert Regeneration.model_validate(WITH_FEATURES).gates == Gates()
    assert Regeneration.model_validate(EXPERIMENT | {"gates": {"max_distance_ratio": None}}).new_poses


def test_exact_copies_count_even_where_real_frames_are_alike():
    found = [r for r in scores() if r["metric"] != "duplicates"]
    found.append(row("memorisation", "synthetic", "duplicates", 100.0, "small pictures"))
    (judged,) = check({"max_memorised_share": 0.05}, found)
    assert judged.value == 0.1 and judged.value > judged.limit


def test_what_held_out_frames_score_as_copies_is_no_gate():
    found = scores()
    kept = check({"max_memorised_share": 0.05}, found)
    assert kept == check(
        {"max_memorised_share": 0.05},
        [*found, row("memorisation", "held-out recorded", "close_share", 0.9, "small pictures")],
    )


def test_new_versions_of_covering_poses_have_to_say_that_poses_stay():
    covering = WITH_FEATURES | {"labels": "coverage"}
    with pytest.raises(ValidationError, match="the same poses for every version; set new_poses to false"):
        Regeneration.model_validate(covering)
    assert Regeneration.model_validate(covering | {"new_poses": False}).labels == "coverage"
