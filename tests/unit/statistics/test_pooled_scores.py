"""Scores pooled over draws of the training recordings, against closed forms and simulated studies."""

import time

import numpy as np
import pyarrow as pa
import pytest
from pooled_tables import samples_table, simulate_draws

from ctlev_core.statistics.pooled_scores import DrawsDiffer, PooledScores, pool_values

RECORDED, SYNTHETIC = "recorded", "recorded+synthetic"
EFFECTS = {RECORDED: 0.5, SYNTHETIC: 0.6}
CLOSE = {"recording": 0.3, "recording_of_setting": 0.1, "sample": 0.1}


def pooled(draws, generators=5, **arguments):
    return PooledScores([samples_table(values) for values in draws], "accuracy", generators, **arguments)


def with_spread(values, deviation):
    """The same numbers moved to mean zero and scaled to this standard deviation (n - 1): nothing is left to luck."""
    values = values - values.mean()
    return values * (deviation / values.std(ddof=1))


def test_intervals_have_the_width_that_the_normal_model_gives():
    """Every level's spread is exactly what it is called, so that the interval is known in closed form."""
    random = np.random.default_rng(0)
    draws, generators, seeds, recordings = 12, 6, 4, 400
    of_draw, of_recording = (with_spread(random.normal(size=n), s) for n, s in ((draws, 0.05), (recordings, 0.4)))
    found = []
    for effect in of_draw:
        tuned = with_spread(random.normal(size=generators), 0.06)
        trained = np.stack([tuned[g] + with_spread(random.normal(size=seeds), 0.04) for g in range(generators)], axis=1)
        synthetic = 0.6 + effect + trained.reshape(-1, 1) + of_recording
        real = 0.5 + with_spread(random.normal(size=generators * seeds), 0.03)[:, None] + 0 * of_recording
        found.append({RECORDED: real, SYNTHETIC: synthetic})
    scores = pooled(found, generators)
    difference = scores.difference(RECORDED, SYNTHETIC)
    assert difference.value == pytest.approx(0.1)
    # Tunings and seeds have the same means in every draw, so that the spread between draws is 0.05 alone, and contains
    # whatever trainings add to it.
    variance = 0.4**2 / recordings + 0.05**2 / draws
    freedom = variance**2 / ((0.4**2 / recordings) ** 2 / (recordings - 1) + (0.05**2 / draws) ** 2 / (draws - 1))
    assert freedom > 20
    assert difference.high - difference.low == pytest.approx(2 * 2.04 * np.sqrt(variance), rel=0.04)
    assert scores.score(SYNTHETIC).value == pytest.approx(0.6)


def test_without_a_spread_between_draws_that_of_trainings_is_covered():
    random = np.random.default_rng(1)
    generators, seeds = 5, 3
    tuned = with_spread(random.normal(size=generators), 0.06)
    seed_effects = np.stack([with_spread(random.normal(size=seeds), 0.02) for _ in range(generators)], axis=1)
    flat = np.zeros(50)
    synthetic = 0.6 + (tuned + seed_effects).reshape(-1, 1) + flat
    real = 0.5 + with_spread(random.normal(size=15), 0.03)[:, None] + flat
    found = pooled([{RECORDED: real, SYNTHETIC: synthetic}] * 3).difference(RECORDED, SYNTHETIC)
    parts = 0.06**2 / 5, 0.03**2 / 15
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / 12 + parts[1] ** 2 / 42)
    assert 13 < freedom < 15
    assert found.high - found.low == pytest.approx(2 * 2.145 * np.sqrt(sum(parts) / 3), rel=0.04)


@pytest.mark.slow
@pytest.mark.parametrize(
    "spread",
    [
        {"generator": 0.03, "seed": 0.03},
        {"draw": 0.05, "generator": 0.02, "seed": 0.02},
        {"draw": 0.015, "generator": 0.02, "seed": 0.03},
    ],
    ids=["trainings vary", "draws vary", "both vary"],
)
def test_intervals_of_three_draws_cover_the_truth(monkeypatch, spread):
    """Nominal 95 %. On these 300 studies each, differences: 97, 96 and 96 %; scores: 98, 97 and 98 %."""
    monkeypatch.setattr("ctlev_core.statistics.pooled_scores.NUM_RESAMPLES", 1000)
    random, runs = np.random.default_rng(11), 300
    covered = np.zeros(2)
    for run in range(runs):
        scores = pooled(simulate_draws(random, EFFECTS, **CLOSE, **spread), seed=run)
        difference, score = scores.difference(RECORDED, SYNTHETIC), scores.score(SYNTHETIC)
        covered += [difference.low <= 0.1 <= difference.high, score.low <= 0.6 <= score.high]
    # The binomial spread of 300 runs is 1.3 %.
    assert (covered / runs >= 0.92).all()


def pooled_with_own_tests(draws, generators=5, **arguments):
    tables = [samples_table(values, digest=str(number)) for number, values in enumerate(draws)]
    return PooledScores(tables, "accuracy", generators, own_tests=True, **arguments)


def test_recordings_of_each_draw_are_part_of_the_spread_between_draws():
    """Draws vary more than their recordings and trainings explain: the interval is that of the means of draws."""
    random = np.random.default_rng(0)
    of_draw = with_spread(random.normal(size=6), 0.05)
    found = []
    for number, effect in enumerate(of_draw):
        of_recording = with_spread(random.normal(size=100 + number), 0.1)
        found.append({RECORDED: np.tile(0.5 + effect + of_recording, (15, 1))})
    scores = pooled_with_own_tests(found)
    assert scores.num_recordings == scores.num_samples == 615
    score = scores.score(RECORDED)
    assert score.value == pytest.approx(0.5)
    assert score.high - score.low == pytest.approx(2 * 2.571 * 0.05 / np.sqrt(6), rel=0.04)


def test_without_a_spread_between_draws_that_of_their_recordings_is_covered():
    random = np.random.default_rng(0)
    found = [{RECORDED: np.tile(0.5 + with_spread(random.normal(size=20), 0.1), (15, 1))} for _ in range(3)]
    score = pooled_with_own_tests(found).score(RECORDED)
    # t of 57 degrees of freedom.
    assert score.high - score.low == pytest.approx(2 * 2.002 * 0.1 / np.sqrt(60), rel=0.05)


@pytest.mark.parametrize(
    "spread",
    [
        pytest.param({"seed": 0.03}, marks=pytest.mark.slow),
        pytest.param({"draw": 0.05, "seed": 0.02}, marks=pytest.mark.slow),
        {"draw": 0.02, "generator": 0.02},
    ],
    ids=str,
)
def test_intervals_of_three_draws_with_tests_of_their_own_cover_the_truth(monkeypatch, spread):
    """Nominal 95 %. On these 200 studies each, differences: 96, 96 and 93 %; scores: 95, 96 and 96 %."""
    monkeypatch.setattr("ctlev_core.statistics.pooled_scores.NUM_RESAMPLES", 500)
    random, runs = np.random.default_rng(12), 200
    covered = np.zeros(2)
    for run in range(runs):
        draws = [simulate_draws(random, EFFECTS, draws=1, recordings=40, **CLOSE, **spread)[0] for _ in range(3)]
        scores = pooled_with_own_tests(draws, seed=run)
        difference, score = scores.difference(RECORDED, SYNTHETIC), scores.score(SYNTHETIC)
        covered += [difference.low <= 0.1 <= difference.high, score.low <= 0.6 <= score.high]
    # The binomial spread of 200 runs is 1.5 %.
    assert (covered / runs >= 0.92).all()


def test_draws_that_were_to_have_tests_of_their_own_and_share_them_are_refused():
    tables = [samples_table({RECORDED: np.zeros((1, 6))}, digest=digest) for digest in ("a", "b", "a")]
    with pytest.raises(DrawsDiffer, match="tested on samples of its own, got the same for draws 0 and 2"):
        PooledScores(tables, "accuracy", 1, own_tests=True)
    with pytest.raises(DrawsDiffer, match="other images or labels"):
        PooledScores(tables, "accuracy", 1)


def test_equal_settings_differ_by_exactly_zero():
    random = np.random.default_rng(0)
    shared = random.normal(size=(3, 1, 40)).repeat(15, axis=1)
    scores = pooled([{RECORDED: values, "copy": values, SYNTHETIC: values + 0.1} for values in shared])
    for before, after in ((RECORDED, RECORDED), (RECORDED, "copy")):
        found = scores.difference(before, after)
        assert (found.value, found.low, found.high) == (0, 0, 0)
        assert scores.probability(after, before) == 0.5
    # Draws and recordings are paired: what all training sets share is in no difference.
    gained = scores.difference(RECORDED, SYNTHETIC)
    assert (gained.value, gained.low, gained.high) == pytest.approx((0.1, 0.1, 0.1))
    assert scores.score(SYNTHETIC).high - scores.score(SYNTHETIC).low > 0.2
    noisy = pooled(simulate_draws(random, EFFECTS, seed=0.1, **CLOSE))
    assert noisy.difference(RECORDED, RECORDED).text() == "+0.000 [+0.000, +0.000]"


def test_probabilities_say_what_intervals_say():
    scores = pooled(simulate_draws(np.random.default_rng(3), EFFECTS | {"other": 0.6}, seed=0.02, **CLOSE))
    assert scores.difference(RECORDED, SYNTHETIC).is_certain and scores.probability(SYNTHETIC, RECORDED) > 0.97
    assert scores.probability(SYNTHETIC, RECORDED, lower_is_better=True) < 0.03
    assert scores.probability(RECORDED, SYNTHETIC) == pytest.approx(1 - scores.probability(SYNTHETIC, RECORDED))
    assert 0.025 < scores.probability(SYNTHETIC, "other") < 0.975


def test_the_share_of_a_gain():
    effects = {RECORDED: 0.5, SYNTHETIC: 0.56, "recorded+oracle": 0.6}
    draws = simulate_draws(np.random.default_rng(0), effects, recording=0.4, seed=0.01)
    scores = pooled(draws)
    share = scores.share_of_gain(RECORDED, SYNTHETIC, "recorded+oracle")
    gained, most = scores.difference(RECORDED, SYNTHETIC), scores.difference(RECORDED, "recorded+oracle")
    assert share.value == pytest.approx(gained.value / most.value) and 0.4 < share.low < share.value < share.high < 0.8
    # Where the gain is much larger than its error, the interval is about that of the delta method.
    errors = [(d.high - d.low) / 2 for d in (gained, most)]
    assert share.high - share.value < np.hypot(errors[0], errors[1]) / most.value
    unchanged = [values | {"recorded+oracle": values[RECORDED]} for values in draws]
    assert pooled(unchanged).share_of_gain(RECORDED, SYNTHETIC, "recorded+oracle") is None


def test_the_order_of_rows_changes_nothing():
    draws = simulate_draws(np.random.default_rng(0), EFFECTS, seed=0.1, generator=0.1, **CLOSE)
    tables = [samples_table(values, per_recording=3) for values in draws]
    shuffled = [table.take(np.random.default_rng(n).permutation(len(table))) for n, table in enumerate(tables)]
    one, other = (PooledScores(given, "accuracy", 5) for given in (tables, shuffled))
    assert one.difference(RECORDED, SYNTHETIC) == other.difference(RECORDED, SYNTHETIC)
    assert one.score(RECORDED) == other.score(RECORDED) and one.num_recordings == other.num_recordings == 20
    assert one.probability(SYNTHETIC, RECORDED) == other.probability(SYNTHETIC, RECORDED)


def test_samples_of_a_recording_are_drawn_together():
    values = np.repeat(np.random.default_rng(0).normal(size=30), 4)[None]
    scores = PooledScores([samples_table({RECORDED: values}, per_recording=4)] * 2, "accuracy", 1).score(RECORDED)
    error = values[0, ::4].std(ddof=1) / np.sqrt(30)
    assert scores.high - scores.low == pytest.approx(2 * 2.05 * error, rel=0.06)


def test_few_recordings_give_no_interval():
    scores = pooled([{RECORDED: np.full((15, 4), 0.5), SYNTHETIC: np.full((15, 4), 0.7)}] * 3)
    assert scores.difference(RECORDED, SYNTHETIC).text() == "+0.200"
    assert (
        np.isnan(scores.probability(RECORDED, SYNTHETIC))
        and scores.share_of_gain(RECORDED, RECORDED, SYNTHETIC) is None
    )


def test_missing_scores_leave_the_sample_out():
    values = np.tile(np.arange(8.0), (5, 1))
    missing = values.copy()
    missing[2, 7] = np.nan
    scores = pooled([{RECORDED: values, SYNTHETIC: missing}, {RECORDED: values, SYNTHETIC: values}])
    assert scores.num_samples == 7 and scores.score(RECORDED).value == pytest.approx(3.0)
    with pytest.raises(ValueError, match="none of the 8 samples is scored by every training"):
        pooled([{RECORDED: values, SYNTHETIC: values * np.nan}] * 2)


def changed(table, column, values):
    return table.set_column(table.column_names.index(column), table.schema.field(column), pa.array(values))


def test_draws_tested_on_different_samples_are_refused():
    table = samples_table({RECORDED: np.zeros((1, 6))})
    ids = table["sample_id"].to_pylist()
    for column, values, message in (
        ("sample_id", [*ids[:5], "other"], r"draws 0 and 1 .* 2 of them in one alone"),
        ("recording_id", ["r"] * 6, "of other recordings"),
        ("weight", [2.0] * 6, "other weights"),
        ("samples_digest", ["e"] * 6, "other images or labels"),
        ("samples_digest", ["d"] * 5 + ["e"], "trainings of draw 1"),
        ("sample_id", [*ids[:5], ids[0]], "trainings of draw 1|once, got|must score each"),
    ):
        with pytest.raises(DrawsDiffer, match=message):
            PooledScores([table, changed(table, column, values)], "accuracy", 1)
    two = samples_table({RECORDED: np.zeros((2, 6))})
    with pytest.raises(DrawsDiffer, match=r"'recorded' of draw 0: each training must score each of the 6 samples once"):
        PooledScores([two.slice(1), two], "accuracy", 1)


def test_other_bad_input_is_refused():
    table = samples_table({RECORDED: np.zeros((4, 6)), SYNTHETIC: np.zeros((4, 6))})
    for draws, metric, generators, message in (
        ([table], "accuracy", 1, "at least two draws, got 1"),
        ([table] * 2, "error", 1, "draw 0 has no samples scored by 'error'"),
        ([table] * 2, "accuracy", 3, r"'recorded\+synthetic': .* multiple of the 3 fine-tunings, got 4"),
        ([table, samples_table({RECORDED: np.zeros((2, 6))})], "accuracy", 1, r"as many trainings .* \[4, 2\]"),
    ):
        with pytest.raises(ValueError, match=message):
            PooledScores(draws, metric, generators)
    scores = PooledScores([table] * 2, "accuracy", 2)
    with pytest.raises(KeyError):
        scores.score("nothing")
    with pytest.raises(ValueError, match="at least two draws"):
        pool_values(np.zeros((1, 4)), 2)
    with pytest.raises(ValueError, match="multiple of the 3"):
        pool_values(np.zeros((2, 4)), 3)


def test_settings_scored_on_samples_of_their_own_are_left_out():
    one = samples_table({RECORDED: np.zeros((1, 6))})
    labels = changed(samples_table({"label agreement of synthetic": np.zeros((1, 9))}), "samples_digest", ["other"] * 9)
    assert PooledScores([pa.concat_tables([one, labels])] * 2, "accuracy", 1).training_sets == (RECORDED,)


def test_pooled_values_have_the_width_of_their_spread():
    draws = with_spread(np.random.default_rng(0).normal(size=8), 0.05)
    found = pool_values(0.8 + draws[:, None].repeat(10, axis=1), 5)
    assert found.value == pytest.approx(0.8)
    assert found.high - found.low == pytest.approx(2 * 2.365 * 0.05 / np.sqrt(8), rel=0.04)


def test_a_whole_study_takes_seconds():
    names = [RECORDED, "synthetic", SYNTHETIC, *(f"{kind}{n}" for n in range(4) for kind in ("x", "recorded+x"))]
    random = np.random.default_rng(0)
    draws = simulate_draws(random, dict.fromkeys(names, 0.5), recordings=300, seed=0.1)
    tables = [samples_table(values) for values in draws]
    start = time.perf_counter()
    scores = PooledScores(tables, "accuracy", 5)
    for name in names:
        scores.difference(RECORDED, name)
    # A quarter of a study of four groups; far more than it needs, for machines that are busy.
    assert time.perf_counter() - start < 10
