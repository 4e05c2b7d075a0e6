"""The tables of scores and the scaling curve, from rows as the stages write them."""

import numpy as np
import pyarrow as pa
import pytest
from scipy import stats

from ctlev_core import plugins
from ctlev_core.provenance.scores import paired_samples
from ctlev_core.report.page.html import Curves
from ctlev_core.report.sections.scaling import ScalePoint, scaling_figure, scaling_points
from ctlev_core.report.sections.score_tables import (
    PairedScores,
    baseline_tables,
    cell_text,
    frame_tables,
    group_tables,
    interval_over_trainings,
    score_tables,
)
from ctlev_core.report.sections.verdict import verdict
from ctlev_core.statistics.paired_differences import Difference

METRIC = "mpjpe2d_px"
NAMES = [f"s{number}" for number in range(40)]


def row(training_set, value, *, seed=0, metric=METRIC, group="all", task="pose2d", num_train=100, low=None, high=None):
    return {
        "task": task, "subject": training_set, "seed": seed, "group": group, "metric": metric, "value": value,
        "low": low, "high": high, "num_samples": 40, "num_train": num_train, 
        "model_digest": f"{training_set}{seed}", "data_digest": "d",
    }  # fmt: skip


def scored(training_set, shift, *, seed=0, noise=0.1, names=NAMES):
    """Rows, scores of samples, and a digest, of one training whose errors are those of `recorded` plus a shift."""
    random = np.random.default_rng([seed, len(training_set)])
    values = 6 + np.random.default_rng(9).normal(0, 1, len(names)) + shift + random.normal(0, noise, len(names))
    columns = {"sample_id": names, "recording_id": names, "value": values, "weight": np.ones(len(names))}
    samples = pa.table({**columns, "metric": [METRIC] * len(names)})
    return [row(training_set, float(values.mean()), seed=seed)], samples, "d"


def tables_of(*parts, more=(), training_sets=("recorded",)):
    rows = [one for rows, _, _ in parts for one in rows] + list(more)
    paired = PairedScores(paired_samples(parts))
    return score_tables(rows, training_sets, paired), paired, rows


def test_only_what_the_paired_interval_shows_is_bold():
    parts = [scored("recorded", 0, noise=0), scored("synthetic", -0.5), scored("recorded+synthetic", 0.01, noise=0.5)]
    parts += [scored("worse", 0.5)]
    (table, *_), _, _ = tables_of(*parts, training_sets=("recorded", "synthetic", "recorded+synthetic", "worse"))
    assert table.columns[:4] == ["trained on", "2D joint error (MPJPE), px ↓", "minus recorded", "trainings"]
    assert getattr(table.columns[1], "code", "") == METRIC
    assert [cells[0] for cells in table.rows] == ["recorded", "synthetic", "recorded + synthetic", "worse"]
    # Better: score and difference; undecided: neither; worse: the difference alone.
    assert set(table.bold) == {(1, 1), (1, 2), (3, 2)}
    assert table.rows[0][2] == "" and float(str(table.rows[1][2]).split()[0]) == pytest.approx(-0.5, abs=0.05)


def test_trainings_are_averaged_and_counted_and_unknown_settings_follow_the_known():
    parts = [
        scored("oracle", -1),
        scored("recorded", 0, seed=1),
        scored("recorded", 0.2, seed=2),
        scored("thing+other", 0),
    ]
    (table, *_), _, rows = tables_of(*parts, training_sets=("recorded",))
    assert [cells[0] for cells in table.rows] == ["recorded", "more recorded", "thing + other"]
    assert [cells[3] for cells in table.rows] == [2, 1, 1]
    mean = np.mean([one["value"] for one in rows if one["subject"] == "recorded"])
    assert table.rows[0][1] == f"{mean:.3f}"
    assert any("the most they can give" in note for note in table.footnotes)


def test_labels_shuffled_labels_and_distances_have_tables_of_their_own():
    more = [
        row("label agreement of synthetic", 5.0),
        row("shuffled label agreement of synthetic", 15.0),
        row("held-out recorded", 3.0, task="distance", metric="fd_event_x"),
        row("synthetic", 9.0, task="distance", metric="fd_event_x", low=8.0, high=10.0),
    ]
    (headline,), _, rows = tables_of(scored("recorded", 0), more=more)
    labels, distances = frame_tables(rows)
    assert [cells[0] for cells in headline.rows] == ["recorded"]
    names = ["held-out recorded", "synthetic", "synthetic (shuffled labels)"]
    assert [cells[0] for cells in labels.rows] == names
    assert distances.rows[1][:2] == ["synthetic", "9.00 [8.00, 10.00]"]


def test_two_tasks_are_two_tables_and_classes_against_the_rest_a_third():
    more = [
        row("recorded", 0.7, task="classifier", metric="accuracy"),
        row("recorded", 0.1, task="classifier", metric="chance_accuracy"),
        row("recorded", 0.8, task="classifier", metric="binary_accuracy_mean"),
        row("recorded", 0.9, task="classifier", metric="binary_accuracy_bonsai"),
    ]
    (_, classes, others, binary), _, _ = tables_of(scored("recorded", 0), more=more)
    assert classes.title == "classifier: Does synthetic data help?"
    assert (classes.columns[1], others.columns[1:]) == ("accuracy ↑", ["one-against-rest accuracy ↑"])
    assert others.folded and not classes.folded
    assert "accuracy by chance: 0.100" in others.footnotes
    assert binary.rows == [["bonsai", "0.900", 40]]


def test_scores_of_other_samples_are_not_paired():
    parts = [scored("recorded", 0), scored("synthetic", -0.5, names=NAMES[::-1])]
    (table, *_), paired, _ = tables_of(*parts, training_sets=("recorded", "synthetic"))
    assert paired.difference("recorded", "synthetic", METRIC) is None and not table.bold


def test_baselines_stand_beside_the_first_generator():
    training_sets = {"recorded": 0, "synthetic": 0.3, "gan": 0.6, "recorded+synthetic": -0.5, "recorded+gan": -0.2}
    _, paired, _ = tables_of(*(scored(name, shift) for name, shift in training_sets.items()))
    (table,) = baseline_tables(["synthetic", "gan", "absent"], METRIC, paired)
    # Means of 40 samples, each with noise of 0.1 in both training sets.
    found = [float(str(cell).split()[0]) for cell in table.rows[0][1:]]
    assert found == pytest.approx([-0.3, -0.3, -0.2], abs=0.08) and table.bold == {(0, 1), (0, 2), (0, 3)}
    assert table.rows[1] == ["absent", "", "", ""]
    assert baseline_tables(["synthetic"], METRIC, paired) == []


def test_groups_by_origin_and_by_class_are_apart():
    groups = ("walk", "classes with recorded training frames", "classes without training frames")
    rows = [row(training_set, 5.0, group=group) for training_set in ("recorded", "new") for group in groups]
    (origins,), (classes,) = group_tables([row("recorded", 5.0), *rows], ["recorded"])
    assert [cells[0] for cells in origins.rows] == [*groups[1:]]
    assert classes.columns == ["classes", "recorded", "new", "frames scored"]
    assert classes.rows == [["walk", "5.000", "5.000", 40]]
    assert group_tables([row("recorded", 5.0)], ["recorded"]) == ([], [])


def test_many_training_sets_are_several_tables_each_beside_recorded_frames():
    names = ["recorded", *(f"new{number}" for number in range(10))]
    rows = [row(training_set, 5.0, group="walk") for training_set in names]
    _, classes = group_tables([row("recorded", 5.0), *rows], names)
    assert len(classes) == 2 and len({table.title for table in classes}) == 2
    assert all(table.columns[1] == "recorded" and len(table.columns) <= 9 for table in classes)
    assert [name for table in classes for name in table.columns[2:-1]] == names[1:]


def test_subjects_have_a_table_of_their_own():
    groups = ("walk", "subject 14", "subjects not learnt from")
    rows = [row(training_set, 5.0, group=group) for training_set in ("recorded", "new") for group in groups]
    (subjects,), (classes,) = group_tables(rows, ["recorded", "new"])
    assert subjects.columns == ["subjects", "recorded", "new", "frames scored"]
    assert [cells[0] for cells in subjects.rows] == [*groups[1:]]
    assert [cells[0] for cells in classes.rows] == ["walk"]


def test_intervals_join_recordings_and_trainings():
    rows = [row("a", value, seed=seed, low=value - 0.3, high=value + 0.4) for seed, value in enumerate((5.0, 5.2, 5.4))]
    value, low, high = interval_over_trainings(rows)
    # Satterthwaite: recordings, with the normal quantile in their half width, and three trainings of deviation 0.2.
    for end, half in ((5.2 - low, 0.3), (high - 5.2, 0.4)):
        of_recordings, of_trainings = (half / stats.norm.ppf(0.975)) ** 2, 0.2**2 / 3
        freedom = (of_recordings + of_trainings) ** 2 / (of_trainings**2 / 2)
        expected = stats.t.ppf(0.975, freedom) * np.sqrt(of_recordings + of_trainings)
        assert end == pytest.approx(expected, rel=1e-9)
    assert value == pytest.approx(5.2)
    equal = [row("a", 5.0, seed=seed, low=4.7, high=5.4) for seed in range(3)]
    assert interval_over_trainings(equal) == pytest.approx((5.0, 4.7, 5.4))
    assert cell_text(rows[:1]) == "5.000 [4.700, 5.400]"
    assert cell_text([row("a", 5.0)]) == "5.000" and cell_text([]) == ""


def test_scaling_points_are_amounts_for_each_real_frame():
    rows = [
        row("recorded", 7.0, num_train=100), row("recorded+synthetic@0.5", 6.5, num_train=150, low=6.4, high=6.6),
        row("recorded+synthetic", 6.0, num_train=200), row("recorded+gan", 5.0, num_train=200),
        row("synthetic@0.5", 9.0),
    ]  # fmt: skip
    points = scaling_points(rows, METRIC)
    assert [(p.series, p.ratio, p.value) for p in sorted(points, key=lambda p: p.ratio)] == [
        ("synthetic", 0.0, 7.0), ("synthetic", 0.5, 6.5), ("synthetic", 1.0, 6.0),
    ]  # fmt: skip
    figure = scaling_figure(points, METRIC)
    assert isinstance(figure, Curves)
    assert figure.series == {"synthetic": ([0.0, 0.5, 1.0], [7.0, 6.5, 6.0])}
    np.testing.assert_array_equal(figure.spans["synthetic"][0], [np.nan, 6.4, np.nan])
    assert scaling_points(rows[:1], METRIC) == [] == scaling_points([], METRIC)
    assert scaling_figure([ScalePoint("a", 1.0, 2.0)]).series == {"a": ([1.0], [2.0])}


def test_the_verdict_says_how_much_of_the_oracles_gain_was_reached_and_whether_labels_hold():
    rows = [
        row(name, value) for name, value in (("recorded", 7.0), ("recorded+synthetic", 6.4), ("recorded+oracle", 6.0))
    ]
    rows += [row("label agreement of synthetic", 5.5), row("shuffled label agreement of synthetic", 15.0)]
    training_sets = ("recorded", "recorded+synthetic", "recorded+oracle")
    difference, gain = Difference(-0.6, -0.8, -0.4), Difference(-1.0, -1.2, -0.8)
    text = str(verdict(rows, training_sets, difference, oracle=(gain, Difference(0.6, 0.45, 0.75))))
    assert "Adding synthetic frames to the recorded ones helped" in text
    assert "from 7.000 to 6.400 px, a difference of -0.600 [-0.800, -0.400] (9 %)." in text
    assert "synthetic ones give 60 [45, 75] % of that." in text
    assert "scores 5.500 on synthetic frames against their labels, and 15.00 on them with shuffled labels." in text
    unsure = str(verdict(rows, training_sets, difference, oracle=(Difference(-0.1, -0.3, 0.1), None)))
    assert "change it by -0.100 [-0.300, +0.100]." in unsure and "of that" not in unsure


def test_many_classes_cost_in_proportion_to_their_number(monkeypatch):
    class Counted(dict):
        asked = 0

        def __getitem__(self, name):
            Counted.asked += name == "group"
            return dict.__getitem__(self, name)

    looks = []
    names_of = plugins.names
    monkeypatch.setattr(plugins, "names", lambda kind: looks.append(kind) or names_of(kind))
    sets = ["recorded", "recorded+synthetic"]
    rows = [Counted(row(name, float(number), group=f"class{number}")) for number in range(300) for name in sets]
    _, (table,) = group_tables(rows, sets)
    assert len(table.rows) == 300 and table.rows[7] == ["class7", "7.000", "7.000", 40]
    assert Counted.asked < 12 * len(rows) and len(looks) < 10
