"""How real are simulated recordings of pictures? They are set beside N-MNIST's, number by number, and what they are
worth.

    python benchmarks/nmnist_realism.py --nmnist FOLDER --images FILE [--set option=value ...]

FOLDER holds N-MNIST's training recordings by class, FOLDER/zero/00001.bin ...; FILE is an .npz of MNIST's `images` and
`labels`, other ones than those that were recorded. Of each class the first 40 % of the recordings by number calibrate,
the next 15 % are compared with; the rest is not looked at.

Three things are printed: a table of numbers; how well a small network tells real from simulated images of events in
three periods of time (`c2st`, area under the curve on held-out ones; 0.5 = not at all) beside how well it tells two
halves of the real ones, and two simulated sensors of one kind, whose pixels differ in their thresholds; and the
accuracy on real recordings of a small network that learnt from 500 simulated ones alone.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import yaml

from ctlev_core.conditions import picture
from ctlev_core.events.files import read_events_file
from ctlev_core.generators import picture_simulator
from data_contracts.events import Events
from data_contracts.labels import Conditions, Labels

CLASSES = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
CALIBRATION, COMPARISON = (0.0, 0.40), (0.40, 0.55)
NUM_TIMES, SIZE = 3, 34
DURATION_US = 308_000
NUM_LEARNT = 500


def read_real(folder: Path, share: tuple[float, float], limit: int | None = None) -> tuple[list[Events], list[str]]:
    """Recordings of each class from one share of their numbers to another."""
    found: list[Events] = []
    names: list[str] = []
    for name in CLASSES:
        files = sorted((folder / name).glob("*.bin"))
        some = files[int(share[0] * len(files)) : int(share[1] * len(files))][:limit]
        found += [read_events_file(file) for file in some]
        names += [name] * len(some)
    return found, names


def pictures_of(images: Path, names: list[str], seed: int) -> Conditions:
    """A random picture of each class in turn."""
    options = picture.Options(root=images, class_names=CLASSES)
    seeds = np.random.default_rng(seed).integers(2**31, size=len(names)).tolist()
    made = picture.render(Labels(tuple(names), np.zeros(len(names), np.int64)), (SIZE, SIZE), options, seeds)
    return Conditions(made.prompts, made.images, None, tuple(names))


def describe(recordings: list[Events]) -> dict[str, float]:
    """Numbers of a set of recordings."""
    from ctlev_core.realism.summary import summarise_events

    counts = np.array([len(events) for events in recordings])
    intervals = [pixel_intervals(events) for events in recordings]
    every, same = (np.concatenate(column) for column in zip(*intervals, strict=True))
    spread = np.array([[events.x.std(), events.y.std()] for events in recordings])
    per_pixel = np.concatenate([np.bincount(e.y.astype(int) * SIZE + e.x, minlength=SIZE**2) for e in recordings])
    numbers = {
        "events": counts.mean(),
        "events, sd of recordings": counts.std(),
        "share of p = 1": np.mean([events.p.mean() for events in recordings]),
        **{f"interval of a pixel, {q:.0%} quantile, ms": np.quantile(every, q) / 1e3 for q in (0.05, 0.25, 0.5, 0.75)},
        "intervals with the same polarity": same.mean(),
        "spread in x, px": spread[:, 0].mean(),
        "spread in y, px": spread[:, 1].mean(),
        "isolated events": np.mean([summarise_events(events).numbers["isolated_share"] for events in recordings]),
        "pixels without events": (per_pixel == 0).mean(),
        "pixels with one or two": ((per_pixel > 0) & (per_pixel < 3)).mean(),
        "pixels with 15 or more": (per_pixel >= 15).mean(),
    }
    run = np.concatenate([run_lengths(events) for events in recordings])
    numbers |= {f"events in a row, {low} or more": (run >= low).mean() for low in (2, 4, 6)}
    return {name: float(value) for name, value in numbers.items()}


def pixel_intervals(events: Events) -> tuple[np.ndarray, np.ndarray]:
    """Times between successive events of a pixel, us, and whether they have one polarity."""
    pixel = events.y.astype(int) * SIZE + events.x
    order = np.argsort(pixel, kind="stable")
    within = np.diff(pixel[order]) == 0
    return np.diff(events.t[order])[within], (np.diff(events.p[order].astype(int)) == 0)[within]


def run_lengths(events: Events, gap_us: int = 30_000) -> np.ndarray:
    """Numbers of successive events of a pixel, of one polarity and less than `gap_us` apart."""
    pixel = events.y.astype(int) * SIZE + events.x
    order = np.argsort(pixel, kind="stable")
    t, p = events.t[order], events.p[order].astype(int)
    ends = (np.diff(pixel[order]) != 0) | (np.diff(t) > gap_us) | (np.diff(p) != 0)
    return np.diff(np.flatnonzero(np.concatenate([[True], ends, [True]])))


def rates(recordings: list[Events]) -> np.ndarray:
    """Events a recording in each of 12 periods."""
    times = np.concatenate([events.t for events in recordings])
    return np.histogram(times, np.linspace(0, DURATION_US, 13))[0] / len(recordings)


def images_of(recordings: list[Events], polarity: bool) -> np.ndarray:
    """[N, 3 or 6, 34, 34] float32: counts in three periods, / 8, at most 1."""
    images = np.zeros((len(recordings), NUM_TIMES, 2, SIZE, SIZE), np.float32)
    for image, events in zip(images, recordings, strict=True):
        period = np.minimum(events.t * NUM_TIMES // DURATION_US, NUM_TIMES - 1)
        np.add.at(image, (period, events.p, events.y, events.x), 1)
    images = images.reshape(len(images), -1, SIZE, SIZE) if polarity else images.sum(axis=2)
    return np.clip(images / 8, 0, 1)


def network(channels: int, outputs: int):
    """A small convolutional network."""
    from torch import nn

    return nn.Sequential(
        nn.Conv2d(channels, 16, 5, padding=2), nn.BatchNorm2d(16), nn.ReLU(), nn.MaxPool2d(2),
        nn.Conv2d(16, 32, 3, padding=1), nn.BatchNorm2d(32), nn.ReLU(), nn.MaxPool2d(2),
        nn.Conv2d(32, 32, 3, padding=1), nn.BatchNorm2d(32), nn.ReLU(), nn.MaxPool2d(2),
        nn.Flatten(), nn.Dropout(0.3), nn.Linear(512, outputs),
    )  # fmt: skip


def learn(images: np.ndarray, labels: np.ndarray, outputs: int, seed: int, epochs: int):
    """Train a network on images that are shifted by up to a pixel."""
    import torch

    torch.manual_seed(seed)
    model = network(images.shape[1], outputs)
    x, y = torch.from_numpy(images), torch.from_numpy(labels)
    steps = epochs * -(-len(x) // 50)
    optimizer = torch.optim.AdamW(model.parameters(), 3e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total_steps=steps)
    for _ in range(epochs):
        for rows in torch.randperm(len(x)).split(50):
            dy, dx = torch.randint(-1, 2, (2,)).tolist()
            loss = torch.nn.functional.cross_entropy(model(x[rows].roll((dy, dx), (2, 3))), y[rows])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return model.eval()


def predict(model, images: np.ndarray) -> np.ndarray:
    """[N, outputs] scores."""
    import torch

    with torch.no_grad():
        return model(torch.from_numpy(images)).numpy()


def told_apart(first: np.ndarray, second: np.ndarray, folds: int = 4) -> tuple[float, float]:
    """Area under the curve of a network (`ctlev_core.realism.two_sample`) and of a logistic regression."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.model_selection import StratifiedKFold, cross_val_predict

    from ctlev_core.realism.roc import area_under_roc
    from ctlev_core.realism.two_sample import compare_frames

    frames = [np.rint(np.moveaxis(images, 1, 3) * 255).astype(np.uint8) for images in (first, second)]
    recordings = np.split(np.arange(len(first) + len(second)), [len(first)])
    network = compare_frames(*frames, first_groups=recordings[0], second_groups=recordings[1]).value
    images = np.concatenate([first, second])
    labels = np.repeat([1, 0], [len(first), len(second)])
    splits = StratifiedKFold(folds, shuffle=True, random_state=0)
    regression = LogisticRegression(C=0.01, max_iter=500)
    flat = images.reshape(len(images), -1)
    linear = np.asarray(cross_val_predict(regression, flat, labels, cv=splits, method="decision_function"))
    return network, area_under_roc(linear[labels == 1], linear[labels == 0])


def main() -> None:
    """Calibrate, simulate, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nmnist", type=Path, required=True)
    parser.add_argument("--images", type=Path, required=True)
    parser.add_argument("--set", action="append", default=[], help="a sampling option, name=value")
    parser.add_argument("--calibrate-with", type=int, default=None, help="recordings a class; all of the first 40 %%")
    parser.add_argument("--quick", action="store_true", help="the table alone")
    chosen = parser.parse_args()
    given = {name: yaml.safe_load(value) for name, _, value in (text.partition("=") for text in chosen.set)}
    options = picture_simulator.SampleOptions(**given)

    known, names = read_real(chosen.nmnist, CALIBRATION, chosen.calibrate_with)
    started = time.perf_counter()
    options, measured = picture_simulator.calibrate(known, names, pictures_of(chosen.images, names, 1), options)
    print(f"calibration: {time.perf_counter() - started:.1f} s of {len(known)} recordings")
    print({name: getattr(options, name) for name in picture_simulator.UNCALIBRATED})
    print({name: round(value, 4) for name, value in measured.items()})

    real, real_names = read_real(chosen.nmnist, COMPARISON)
    asked = pictures_of(chosen.images, [CLASSES[row % 10] for row in range(NUM_LEARNT)], 2)
    started = time.perf_counter()
    made = list(picture_simulator.sample_events(asked, (SIZE, SIZE), options, seeds=range(NUM_LEARNT)))
    seconds = time.perf_counter() - started
    print(f"simulation: {len(made) / seconds:.0f} recordings/s, {sum(map(len, made)) / seconds / 1e6:.2f} M events/s")

    # The pictures are of classes in equal parts; so are, nearly, those that are compared with.
    columns = [describe(known), describe(real), describe(made)]
    print(f"{'':40} {'real 0-40 %':>12} {'real 40-55 %':>12} {'simulated':>12}")
    for name in columns[0]:
        print(f"{name:40} " + " ".join(f"{column[name]:12.3f}" for column in columns))
    for number, row in enumerate(zip(*map(rates, (known, real, made)), strict=True)):
        print(f"{f'events in period {number + 1} of 12':40} " + " ".join(f"{value:12.0f}" for value in row))
    if chosen.quick:
        return

    import torch

    torch.set_num_threads(1)
    another = options.model_copy(update={"sensor_seed": 1})
    other = list(picture_simulator.sample_events(asked, (SIZE, SIZE), another, seeds=range(NUM_LEARNT, 2 * NUM_LEARNT)))
    for polarity in (False, True):
        x_known, x_real, x_made, x_other = (images_of(some, polarity) for some in (known, real, made, other))
        x_every = np.concatenate([x_known, x_real])
        order = np.random.default_rng(0).permutation(len(x_every))
        half = len(order) // 2
        floor = told_apart(x_every[order[:half]], x_every[order[half:]])
        apart = told_apart(x_every, x_made[: len(x_every)])
        sensors = told_apart(x_other[: len(x_every)], x_made[: len(x_every)])
        what = "two polarities" if polarity else "polarities summed"
        pairs = {"real from simulated": apart, "real from real": floor, "two simulated sensors": sensors}
        told = "; ".join(f"{name} {auc:.3f} / {linear:.3f}" for name, (auc, linear) in pairs.items())
        print(f"AUC, network / linear, {what}: {told}")
    labels_made = np.array([row % 10 for row in range(NUM_LEARNT)])
    labels_real = np.array([CLASSES.index(name) for name in real_names])
    x_made, x_real = images_of(made, False), images_of(real, False)

    def accuracies(images: np.ndarray, labels: np.ndarray) -> list[float]:
        models = [learn(images, labels, 10, seed, 40) for seed in range(3)]
        return [round(float(np.mean(predict(model, x_real).argmax(1) == labels_real)), 3) for model in models]

    print(f"learnt from {NUM_LEARNT} simulated, tested on {len(real)} real: {accuracies(x_made, labels_made)}")
    labels_known = np.array([CLASSES.index(name) for name in names])
    print(f"learnt from {len(known)} real: {accuracies(images_of(known, False), labels_known)}")


if __name__ == "__main__":
    main()
