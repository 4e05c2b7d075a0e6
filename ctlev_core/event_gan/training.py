"""Training of Event-GAN: alternating updates, an averaged generator, the best of its checkpoints.

Everything random is a function of (seed, batch), and the state holds both networks, both optimisers, the average and
the best checkpoint so far: a run that is killed and resumed ends in the same weights as one that was not.
"""

from __future__ import annotations

import copy
import math
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from ctlev_core.determinism import deterministic
from ctlev_core.event_gan import losses
from ctlev_core.event_gan.batches import Batch, Pairs, make_batch, split_rows
from ctlev_core.event_gan.event_images import NUM_CHANNELS, pairs_to_tensor
from ctlev_core.event_gan.local_statistics import local_statistics_error
from ctlev_core.event_gan.networks import EventVolumeUNet, build_discriminator, generator_arguments
from ctlev_core.event_gan.options import SamplingOptions, TrainingOptions
from ctlev_core.event_gan.sampling import sample_frames
from ctlev_core.progress import ProgressBar
from ctlev_core.supervised.batches import batch_rows
from ctlev_core.supervised.checkpoints import read_training_state, write_training_state
from ctlev_core.supervised.models import build_seeded, resolve_device
from data_contracts.errors import TrainingError
from data_contracts.labels import History

# Entropy that keeps random streams apart, see also `batches`.
_WEIGHT_STREAM, _CALIBRATION_STREAM = 22, 23
# What the averaged generator sees before it is judged.
CALIBRATION_BATCHES, CALIBRATION_BATCH_SIZE = 16, 16


@dataclass
class Curves:
    """What both networks did, for `History` and for the checkpoint folder."""

    history: History = field(default_factory=History)
    discriminator_loss: list[float] = field(default_factory=list)
    best_step: int = 0


class EventGAN:
    """Both networks with their optimisers, the averaged generator and all else that a resumed run needs."""

    def __init__(self, data: Pairs, options: TrainingOptions, *, seed: int, identity: str) -> None:
        """Networks with first weights from `seed`; `identity` names the run, so that foreign state is refused."""
        self.options, self.seed, self.identity = options, seed, identity
        self.device = resolve_device(options.device)
        train_rows, validation_rows = split_rows(len(data.frames), options.validation_fraction, seed)
        self.data, self.validation = data.take(train_rows), data.take(validation_rows)
        num_channels = NUM_CHANNELS[data.palette]

        def build() -> nn.Module:
            networks = (
                EventVolumeUNet(num_channels, **generator_arguments(options)),
                build_discriminator(num_channels, options),
            )
            return nn.ModuleList(networks)

        weight_seed = int(np.random.SeedSequence([seed, _WEIGHT_STREAM]).generate_state(1)[0])
        self.generator, self.discriminator = build_seeded(build, weight_seed).to(self.device).children()
        self.averaged = copy.deepcopy(self.generator)
        betas = (0.0, options.beta2)
        self.generator_optimizer = torch.optim.RAdam(
            self.generator.parameters(), lr=options.generator_learning_rate, betas=betas
        )
        self.discriminator_optimizer = torch.optim.RAdam(
            self.discriminator.parameters(), lr=options.discriminator_learning_rate, betas=betas
        )
        self.step = 0
        self.curves = Curves()
        self.pending: list[tuple[float, float]] = []
        self.best: dict[str, Tensor] | None = None

    def train_discriminator(self, batch: Batch) -> float:
        """One update of the discriminator; the first half of the pairs it sees generated, the second half real."""
        half = len(batch.volumes) // 2
        with torch.no_grad():
            generated = self.generator(batch.seen[:half])
        volumes = torch.cat([generated, batch.volumes[half : 2 * half]])
        generated_logits, real_logits = self.discriminator(volumes, batch.pairs[: 2 * half]).chunk(2)
        is_flipped = torch.from_numpy(batch.random.random(real_logits.shape) < self.options.label_flip).to(self.device)
        loss = losses.discriminator_hinge_loss(*losses.flip_labels(real_logits, generated_logits, is_flipped))
        return self._update(loss, self.discriminator_optimizer, "discriminator")

    def train_generator(self, batch: Batch) -> float:
        """One update of the generator and of its moving average."""
        options = self.options
        generated = self.generator(batch.seen)
        self.discriminator.requires_grad_(False)
        loss = losses.generator_hinge_loss(self.discriminator(generated, batch.pairs))
        self.discriminator.requires_grad_(True)
        if options.reconstruction_weight:
            loss = loss + options.reconstruction_weight * losses.reconstruction_loss(generated, batch.volumes)
        value = self._update(loss, self.generator_optimizer, "generator")
        # The average forgets its random start quickly: decay rises from 0.1 to its final value.
        decay = min(options.ema_decay, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for average, parameter in zip(self.averaged.parameters(), self.generator.parameters(), strict=True):
                average.lerp_(parameter, 1 - decay)
        return value

    def _batch(self, number: int) -> Batch:
        return make_batch(self.data, self.options, self.seed, number, self.device)

    def _update(self, loss: Tensor, optimizer: torch.optim.Optimizer, name: str) -> float:
        value = loss.item()
        if not math.isfinite(value):
            raise TrainingError(
                f"Event-GAN: the {name}'s loss is {value} at step {self.step} of {self.options.num_steps}; "
                f"lower {name}_learning_rate (now {optimizer.param_groups[0]['lr']:g})"
            )
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        return value

    def train_step(self) -> None:
        """The discriminator's updates, then the generator's, each on a batch of its own."""
        rounds = self.options.discriminator_steps + 1
        first = self.step * rounds
        discriminator_losses = [self.train_discriminator(self._batch(first + part)) for part in range(rounds - 1)]
        generator_loss = self.train_generator(self._batch(first + rounds - 1))
        self.pending.append((generator_loss, float(np.mean(discriminator_losses))))
        self.step += 1

    def calibrate_average(self) -> nn.Module:
        """The averaged generator in evaluation mode.

        Batch statistics and singular vectors belong to weights; those of averaged weights are measured on
        training pairs, the same ones every time.

        Raises:
            TrainingError: a weight is not finite, which the losses show only a step later.
        """
        if not all(torch.isfinite(parameter).all() for parameter in self.averaged.parameters()):
            raise TrainingError(
                f"Event-GAN: a weight of the generator is not finite after step {self.step} of "
                f"{self.options.num_steps}; lower generator_learning_rate "
                f"(now {self.options.generator_learning_rate:g})"
            )
        self.averaged.load_state_dict({**self.averaged.state_dict(), **dict(self.generator.named_buffers())})
        for layer in self.averaged.modules():
            if isinstance(layer, nn.BatchNorm2d):
                layer.reset_running_stats()
                layer.momentum = None  # the plain mean over all batches
        self.averaged.train()
        stream = int(np.random.SeedSequence([self.seed, _CALIBRATION_STREAM]).generate_state(1)[0])
        for number in range(CALIBRATION_BATCHES):
            rows = batch_rows(len(self.data.conditions), CALIBRATION_BATCH_SIZE, stream, number)
            with torch.no_grad():
                self.averaged(pairs_to_tensor(self.data.conditions[rows]).to(self.device))
        return self.averaged.eval()

    def validate(self) -> None:
        """Judge the averaged generator on the held back pairs and keep it where it is the best so far."""
        network, data, history = self.calibrate_average(), self.validation, self.curves.history
        real = np.asarray(data.frames)
        frames = sample_frames(
            network, data.conditions, data.palette, data.one_event, SamplingOptions(), seeds=range(len(data.frames))
        )
        error = local_statistics_error(frames, real)
        if not history.validation_loss or error < min(history.validation_loss):
            self.best = {name: value.clone() for name, value in network.state_dict().items()}
            self.curves.best_step = self.step
        history.validation_step.append(self.step)
        history.validation_loss.append(error)
        history.shuffled_loss.append(local_statistics_error(np.roll(frames, 1, axis=0), real))

    def log(self) -> None:
        """A row of the loss curves: the means since the last row."""
        generator_loss, discriminator_loss = np.mean(self.pending, axis=0).tolist()
        self.curves.history.step.append(self.step)
        self.curves.history.loss.append(generator_loss)
        self.curves.discriminator_loss.append(discriminator_loss)
        self.pending = []

    def finish(self) -> nn.Module:
        """The averaged generator that is kept, in evaluation mode: the best on validation data, else the last."""
        if self.best is None:
            self.curves.best_step = self.step
            return self.calibrate_average()
        self.averaged.load_state_dict(self.best)
        return self.averaged.eval()

    def save(self, path: Path) -> None:
        """Write everything needed to go on, atomically."""
        state = {"identity": self.identity, "step": self.step, "pending": self.pending, "best": self.best}
        state["curves"] = asdict(self.curves)
        state |= {name: getattr(self, name).state_dict() for name in _STATEFUL}
        write_training_state(path, state)

    def restore(self, path: Path) -> None:
        """Go on from a saved state.

        Raises:
            TrainingError: the state is of another run or cannot be read.
        """
        state = read_training_state(path, self.device)
        if state["identity"] != self.identity:
            raise TrainingError(f"{path}: saved training state is of another run, delete it to start anew")
        for name in _STATEFUL:
            getattr(self, name).load_state_dict(state[name])
        curves = state["curves"]
        self.curves = Curves(**{**curves, "history": History(**curves["history"])})
        self.step, self.pending, self.best = state["step"], state["pending"], state["best"]


_STATEFUL = ("generator", "discriminator", "averaged", "generator_optimizer", "discriminator_optimizer")


def train_generator(data: Pairs, options: TrainingOptions, *, seed: int, work: Path, identity: str) -> EventGAN:
    """Train for `num_steps` steps of the generator; call `finish` on the result for the network to keep.

    Args:
        data: training pairs; a part is held back to choose among checkpoints.
        options: networks, losses, budget.
        seed: of first weights, order, augmentation and split.
        work: folder of the resumable state.
        identity: of data, options and seed; state of another run in `work` is refused.
    Raises:
        TrainingError: a loss is not finite, or the state in `work` is of another run.
    """
    gan, state = EventGAN(data, options, seed=seed, identity=identity), work / "state.pt"
    if state.is_file():
        gan.restore(state)
    gan.generator.train()
    gan.discriminator.train()
    saved = time.monotonic()
    progress = ProgressBar(total=options.num_steps, initial=gan.step, desc="Event-GAN", unit="step")
    with progress, deterministic(gan.device):
        while gan.step < options.num_steps:
            gan.train_step()
            progress.update()
            is_last = gan.step == options.num_steps
            if gan.step % options.log_every == 0 or is_last:
                gan.log()
                progress.note(f"generator {gan.curves.history.loss[-1]:.3f}")
            if len(gan.validation.frames) and (gan.step % options.validation_every == 0 or is_last):
                gan.validate()
            if time.monotonic() - saved > options.checkpoint_every_s or is_last:
                gan.save(state)
                saved = time.monotonic()
    return gan
