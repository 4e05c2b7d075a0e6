"""The shared training loop on a model small enough to know the answer: a line through points."""

import math

import numpy as np
import pytest
import torch

from ctlev_core.supervised import loop, models
from ctlev_core.supervised.batches import plan_rows
from ctlev_core.supervised.loop import learning_rate_at, train_model
from ctlev_core.supervised.options import SupervisedOptions
from data_contracts.errors import TrainingError

COUNT = 24
INPUTS = torch.linspace(-1, 1, COUNT)[:, None]
TARGETS = 3 * INPUTS - 0.5
FAST = {"learning_rate": 0.1, "warmup_steps": 0, "batch_size": 6, "weight_decay": 0.0, "log_every": 4, "device": "cpu"}


def build():
    """A line behind batch normalisation, whose running means a careless step would spoil."""
    norm = torch.nn.BatchNorm1d(1)
    return models.build_seeded(lambda: torch.nn.Sequential(norm, torch.nn.Linear(1, 1)), 0)


def squared_error(model, spoil=None):
    def compute_loss(rows, generator):
        inputs = INPUTS[rows]
        if spoil is not None and generator is not None:
            inputs = spoil(inputs, generator)
        return (model(inputs) - TARGETS[rows]).square().mean()

    return compute_loss


def train(work, options, *, compute_loss=None, model=None, seed=0, groups=()):
    model = model or build()
    chosen = SupervisedOptions(**{**FAST, **options})
    rows = plan_rows(COUNT, chosen, seed=seed, groups=groups)
    loss = compute_loss or squared_error(model)
    result = train_model(model, loss, rows, chosen, seed=seed, work=work, run_digest="line", description="train line")
    return model, result


def same(first, second):
    states = first.state_dict(), second.state_dict()
    return all(torch.equal(states[0][name], states[1][name]) for name in states[0])


def spoil_at(steps, value=math.nan):
    """Inputs of the given steps that are not finite; counts the calls."""
    calls = iter(range(10**6))
    return lambda inputs, _: inputs * value if next(calls) in steps else inputs


def test_learning_rate_warms_up_and_falls():
    schedule = SupervisedOptions(num_steps=100, learning_rate=0.5, warmup_steps=10)
    rates = [learning_rate_at(step, schedule) for step in range(100)]
    assert rates[0] == pytest.approx(0.05) and max(rates) == rates[9] and min(rates[9:]) == rates[-1] > 0
    assert learning_rate_at(0, SupervisedOptions(num_steps=100, learning_rate=0.5, warmup_steps=0)) == 0.5


def test_the_line_is_found(tmp_path):
    model, result = train(tmp_path, {"num_steps": 300, "batch_size": COUNT})
    model.eval()
    # The running variance is that of a sample, 24 / 23 of the batch's own: 2 % of a slope of 3.
    torch.testing.assert_close(model(INPUTS), TARGETS, atol=0.08, rtol=0)
    assert result.record == {"num_steps": 300, "skipped_steps": 0, "kept_step": 300, "held_back_rows": 0}
    assert result.history.step == list(range(4, 301, 4)) and result.history.validation_loss == []


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_step_that_is_not_finite_is_skipped_without_a_trace(tmp_path, value):
    """The same run with the bad steps' updates left out by hand ends in the same weights."""
    model = build()
    _, result = train(
        tmp_path / "a", {"num_steps": 20}, model=model, compute_loss=squared_error(model, spoil_at({3, 4, 11}, value))
    )
    assert result.record["skipped_steps"] == 3
    assert all(torch.isfinite(tensor).all() for tensor in model.state_dict().values())
    assert result.history.step[-1] == 20 and np.isfinite(result.history.loss).all()
    expected = build()
    options = SupervisedOptions(**FAST, num_steps=20)
    optimizer = torch.optim.AdamW(expected.parameters(), lr=0.1, weight_decay=0)
    rows = plan_rows(COUNT, options, seed=0)
    for step in set(range(20)) - {3, 4, 11}:
        optimizer.param_groups[0]["lr"] = learning_rate_at(step, options)
        optimizer.zero_grad()
        squared_error(expected)(rows.batch(6, 0, step), None).backward()
        optimizer.step()
    assert same(model, expected)


def test_a_gradient_that_is_not_finite_is_skipped_too(tmp_path):
    """The square root of 0 is finite, its slope is not."""
    model = build()
    calls = iter(range(100))

    def compute_loss(rows, _):
        loss = (model(INPUTS[rows]) - TARGETS[rows]).square().mean()
        return loss + (0 * loss).sqrt() if next(calls) == 2 else loss

    _, result = train(tmp_path, {"num_steps": 8}, model=model, compute_loss=compute_loss)
    assert result.record["skipped_steps"] == 1
    assert all(torch.isfinite(parameter).all() for parameter in model.parameters())


def test_ten_steps_in_a_row_that_are_not_finite_end_the_run(tmp_path):
    model = build()
    loss = squared_error(model, spoil_at(range(5, 14)))
    assert train(tmp_path / "a", {"num_steps": 40}, model=model, compute_loss=loss)[1].record["skipped_steps"] == 9
    model = build()
    loss = squared_error(model, spoil_at(range(5, 15)))
    with pytest.raises(TrainingError, match="nan at step 14 of 40, not finite for 10 steps in a row"):
        train(tmp_path / "b", {"num_steps": 40}, model=model, compute_loss=loss)


def test_a_window_of_the_log_without_a_finite_loss_has_no_row(tmp_path):
    model = build()
    loss = squared_error(model, spoil_at({4, 5, 6, 7}))
    _, result = train(tmp_path, {"num_steps": 12}, model=model, compute_loss=loss)
    assert result.history.step == [4, 12]


class Killed(Exception):
    pass


@pytest.mark.parametrize("stop", [3, 17, 26])
def test_a_killed_run_ends_as_if_nothing_had_been(tmp_path, stop):
    """With everything that has a state: skipped steps, rows held back, best weights, patience."""
    options = {"num_steps": 40, "validation_share": 0.25, "validation_every": 5, "patience": 4, "checkpoint_every_s": 0}
    # Noise makes later weights worse now and then, so that the best are not the last.
    bad = {2, 3, 14, 15, 21}

    def noisy(model, killed_at=None):
        def compute_loss(rows, generator):
            if generator is None:
                return squared_error(model)(rows, None)
            marker = generator.random()
            step = steps[round(marker, 12)]
            if step == killed_at:
                raise Killed
            factor = math.nan if step in bad else 1 + 3 * marker
            return (model(INPUTS[rows]) - factor * TARGETS[rows]).square().mean()

        return compute_loss

    steps = {round(np.random.default_rng([0, 1, step]).random(), 12): step for step in range(40)}
    model = build()
    whole, expected = train(tmp_path / "whole", options, model=model, compute_loss=noisy(model))
    model = build()
    with pytest.raises(Killed):
        train(tmp_path / "parts", options, model=model, compute_loss=noisy(model, killed_at=stop))
    model = build()
    again, resumed = train(tmp_path / "parts", options, model=model, compute_loss=noisy(model))
    assert same(again, whole) and resumed == expected
    assert expected.record["skipped_steps"] >= 2


def test_dropout_is_drawn_from_the_seed_also_where_a_run_goes_on(tmp_path):
    """And leaves torch's global stream, which other code may have advanced, as it was."""
    options = {"num_steps": 12, "checkpoint_every_s": 0}

    def with_dropout():
        return models.build_seeded(
            lambda: torch.nn.Sequential(torch.nn.Linear(1, 8), torch.nn.Dropout(), torch.nn.Linear(8, 1)), 0
        )

    def killed_at(model, stop):
        calls = iter(range(100))

        def compute_loss(rows, generator):
            if next(calls) == stop:
                raise Killed
            return squared_error(model)(rows, generator)

        return compute_loss

    whole, _ = train(tmp_path / "whole", options, model=with_dropout())
    torch.rand(5)
    before = torch.get_rng_state()
    model = with_dropout()
    with pytest.raises(Killed):
        train(tmp_path / "parts", options, model=model, compute_loss=killed_at(model, 7))
    again, _ = train(tmp_path / "parts", options, model=with_dropout())
    assert same(again, whole) and torch.equal(torch.get_rng_state(), before)
    other, _ = train(tmp_path / "other", options, model=with_dropout(), seed=1)
    assert not same(other, whole)


def test_state_of_other_rows_is_not_continued_and_a_broken_one_is_named(tmp_path):
    options = {"num_steps": 6, "checkpoint_every_s": 0}
    train(tmp_path / "shared", options)
    other, _ = train(tmp_path / "shared", {**options, "validation_share": 0.25})
    fresh, _ = train(tmp_path / "fresh", {**options, "validation_share": 0.25})
    assert same(other, fresh)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "training.pt").write_bytes(b"half a file")
    with pytest.raises(TrainingError, match=r"broken/training.pt: saved state cannot be read, delete it"):
        train(tmp_path / "broken", options)


def test_saves_are_as_far_apart_as_asked(tmp_path, monkeypatch):
    clock, saved = iter(range(0, 10_000, 7)), []
    monkeypatch.setattr(loop.time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(loop._Run, "save", lambda run, path: saved.append(run.state.step))
    train(tmp_path, {"num_steps": 12, "checkpoint_every_s": 20.0})
    # A look at the clock each step, 7 s apart, and one more after each save; none after the last step.
    assert saved == [3, 6, 9]


def test_the_best_weights_on_rows_held_back_are_kept(tmp_path):
    """A learning rate that throws the line about: the last weights are not the best."""
    options = {"num_steps": 60, "validation_share": 0.25, "validation_every": 3, "learning_rate": 2.0}
    model, result = train(tmp_path, options)
    losses = result.history.validation_loss
    best = int(np.argmin(losses))
    assert result.record["kept_step"] == result.history.validation_step[best]
    assert result.record["held_back_rows"] == 6
    rows = plan_rows(COUNT, SupervisedOptions(**{**FAST, **options}), seed=0)
    model.eval()
    assert squared_error(model)(rows.held_back, None).item() == pytest.approx(losses[best], rel=1e-6)
    assert best < len(losses) - 1 and losses[-1] > 1.1 * losses[best]


def test_patience_ends_a_run_that_gets_no_better(tmp_path):
    model = build()
    looks = iter([5.0, 4.0, 4.5, 4.0, 4.2, 1.0])

    def compute_loss(rows, generator):
        return squared_error(model)(rows, generator) if generator is not None else torch.tensor(next(looks))

    options = {"num_steps": 90, "validation_share": 0.25, "validation_every": 2, "patience": 3}
    _, result = train(tmp_path, options, model=model, compute_loss=compute_loss)
    assert result.history.validation_loss == pytest.approx([5.0, 4.0, 4.5, 4.0, 4.2])
    assert result.record["num_steps"] == 10 and result.record["kept_step"] == 4


def test_rows_held_back_change_nothing_but_what_is_drawn(tmp_path):
    """Looking at the rows held back leaves running means, and the random streams of the steps, alone."""
    options = {"num_steps": 20, "validation_share": 0.25}
    often, few = (train(tmp_path / str(n), {**options, "validation_every": n}) for n in (1, 20))
    assert often[1].history.loss == few[1].history.loss


def test_whole_groups_are_held_back(tmp_path):
    groups = [f"subject {row // 6}" for row in range(COUNT)]
    _, result = train(tmp_path, {"num_steps": 4, "validation_share": 0.1}, groups=groups)
    assert result.record["held_back_rows"] == 6


@pytest.mark.usefixtures("native_bfloat16")
def test_half_precision_trains_with_weights_and_losses_in_float32(tmp_path):
    options = SupervisedOptions(**FAST, num_steps=100, precision="bfloat16")
    device = torch.device("cpu")
    model = models.build_seeded(lambda: torch.nn.Linear(1, 1), 0)
    kinds = set()

    def compute_loss(rows, _):
        with models.mixed_precision(options, device):
            found = model(INPUTS[rows])
        kinds.add(found.dtype)
        return (found.float() - TARGETS[rows]).square().mean()

    rows = plan_rows(COUNT, options, seed=0)
    train_model(model, compute_loss, rows, options, seed=0, work=tmp_path, run_digest="", description="line")
    assert kinds == {torch.bfloat16} and model.weight.dtype == torch.float32
    # bfloat16 keeps three digits.
    torch.testing.assert_close(model(INPUTS), TARGETS, atol=0.05, rtol=0)
