"""Solvers of the reverse diffusion for a checkpoint's noise schedule.

Of a checkpoint's scheduler config only the noise schedule is taken. What else it may hold belongs to another solver, or
is meant for images: `clip_sample` and `thresholding` clip latents, which have no bounds, and a last sigma above zero
leaves noise in them.

All solvers end in a jump to sigma zero, the network's clean latents. Spacings: with steps even in time that jump
starts at sigma 0.2 and more, and blurs exactly what event images consist of, narrow peaks on a black background; Karras
and Lu steps start it at 0.03.
"""

from __future__ import annotations

from typing import Any

import torch
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from diffusers.schedulers.scheduling_deis_multistep import DEISMultistepScheduler
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler
from diffusers.schedulers.scheduling_sasolver import SASolverScheduler
from diffusers.schedulers.scheduling_tcd import TCDScheduler
from diffusers.schedulers.scheduling_unipc_multistep import UniPCMultistepScheduler
from diffusers.schedulers.scheduling_utils import SchedulerOutput
from torch import Tensor

from ctlev_core.diffusion.flow_matching import refuse_flow, sampling_sigmas
from ctlev_core.diffusion.pretrained.model_kinds import is_flow
from ctlev_core.diffusion.sampling.options import OF_STUDENTS, SPACINGS, check_spacing
from ctlev_core.diffusion.student_files import STUDENT_SCHEDULER, evaluations_of
from data_contracts.errors import DataError

PREDICTION_TYPES = ("epsilon", "v_prediction", "sample")
MIN_ALPHA_BAR = 2.0**-24
"""Stands for no signal at all where a solver divides by it; what diffusers takes."""

THIRD_ORDER_FROM = 20
"""Steps from which UniPC is of order 3; with fewer its long steps overshoot.

Root mean square distance, in grey levels, of the images of an earlier bundled base model from those of 60 steps, order
3 and 2: 48 and 11 with 6 Karras steps, 21 and 2.9 with 8, 3.0 and 1.9 with 10, 1.2 and 0.8 with 15, 0.7 and 0.7 with
20. With a denoiser in closed form order 3 is the better one with 20 steps.
"""

_NOISE_SCHEDULE = (
    "num_train_timesteps",
    "beta_start",
    "beta_end",
    "beta_schedule",
    "trained_betas",
    "prediction_type",
    "rescale_betas_zero_snr",
)
_SPACING_SETTINGS: dict[str, dict[str, Any]] = {
    "karras": {"use_karras_sigmas": True},
    "lu": {},
    "linspace": {"timestep_spacing": "linspace"},
    "trailing": {"timestep_spacing": "trailing"},
}


class _EndsClean:
    """The last step of a solver that in diffusers ends at the least noise of the schedule.

    With Karras sigmas it would even be a step of no length, which costs an evaluation and divides 0 by 0.
    """

    def step(
        self: Any,
        model_output: Tensor,
        timestep: Any,
        sample: Tensor,
        generator: Any = None,
        return_dict: bool = True,
    ) -> Any:
        """As in diffusers, but the last step returns the clean latents that the network predicts."""
        index = self.begin_index if self.step_index is None else self.step_index
        if index == len(self.timesteps) - 1:
            clean = clean_latents(model_output, sample, float(self.sigmas[index]), self.config["prediction_type"])
            self._step_index = index + 1
            return SchedulerOutput(prev_sample=clean) if return_dict else (clean,)
        further = {"generator": generator} if isinstance(self, SASolverScheduler) else {}
        return super().step(model_output, timestep, sample, **further, return_dict=return_dict)  # pyright: ignore[reportAttributeAccessIssue]


class _DEIS(_EndsClean, DEISMultistepScheduler):
    pass


class _SASolver(_EndsClean, SASolverScheduler):
    pass


class _TCD(TCDScheduler):
    """Without noise of its own (eta 0; diffusers' default of `step` is 0.3), as students are distilled."""

    def step(self, model_output: Tensor, timestep: Any, sample: Tensor, return_dict: bool = True) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """As in diffusers."""
        return super().step(model_output, timestep, sample, eta=0.0, return_dict=return_dict)


_SOLVERS: dict[str, tuple[Any, dict[str, Any]]] = {
    "unipc": (UniPCMultistepScheduler, {"solver_order": 3}),
    "dpmpp_2m": (DPMSolverMultistepScheduler, {"solver_order": 2}),
    "dpmpp_3m": (DPMSolverMultistepScheduler, {"solver_order": 3}),
    "dpmpp_sde": (DPMSolverMultistepScheduler, {"solver_order": 2, "algorithm_type": "sde-dpmsolver++"}),
    # Of orders 2 and 3 the one with the smaller distribution error at 8 to 20 steps, with a denoiser in closed form.
    "deis": (_DEIS, {"solver_order": 3}),
    "sa_solver": (_SASolver, {"predictor_order": 3, "corrector_order": 3}),
    # The first-order DPM-Solver++ is DDIM (Lu et al., 2022), and unlike diffusers' DDIM takes uneven steps.
    "ddim": (DPMSolverMultistepScheduler, {"solver_order": 1}),
    "ddpm": (DDPMScheduler, {"clip_sample": False}),
}


_FLOW_SOLVERS = ("unipc", "dpmpp_2m", "dpmpp_3m", "dpmpp_sde", "ddim")


def make_scheduler(
    name: str, config: dict[str, Any], num_inference_steps: int, timestep_spacing: str | None = None
) -> Any:
    """A diffusers scheduler for the noise schedule of a checkpoint, its time steps set.

    Args:
        name: one of `SPACINGS`. `dpmpp_2m` is the multistep solver of order 2, `dpmpp_3m` of order 3, `dpmpp_sde` the
            one of order 2 for the stochastic equation.
        config: the checkpoint's scheduler config.
        num_inference_steps: evaluations of the network.
        timestep_spacing: where the steps lie, see `SamplingOptions`; None is the first one that the solver supports.
    Returns:
        The scheduler; `step(predicted, timestep, state, generator=...)` of the stochastic ones draws noise.
    Raises:
        ValueError: unknown solver, a spacing it does not support, or more steps than the schedule has.
        DataError: the config cannot be sampled with.
    Source: Zhao et al., UniPC, 2023; Lu et al., DPM-Solver++, 2022; Zhang and Chen, DEIS, 2022; Xue et al., SA-Solver,
        2023; Song et al., DDIM, 2020; Ho et al., DDPM, 2020; Karras et al., 2022, eq. 5 (spacing).
    """
    timestep_spacing = timestep_spacing or SPACINGS.get(name, ("karras",))[0]
    check_spacing(name, timestep_spacing)
    if is_flow(config):
        return _flow_scheduler(name, config, num_inference_steps)
    _check_student(name, config, num_inference_steps)
    schedule = _noise_schedule(config)
    steps = _check_steps(config, num_inference_steps)
    if timestep_spacing == "linspace" and num_inference_steps in (1, steps):
        # A single step must be the first, and all steps must be each once: rounding would get both wrong.
        timestep_spacing = "trailing"
    if name == OF_STUDENTS:
        return _student_scheduler(schedule, num_inference_steps)
    solver, settings = _solver(name, num_inference_steps)
    if name in ("deis", "sa_solver") and schedule.pop("rescale_betas_zero_snr", False):
        schedule["trained_betas"] = _betas_without_signal(config)
    scheduler = solver(**schedule, **settings, **_SPACING_SETTINGS[timestep_spacing])
    scheduler.set_timesteps(num_inference_steps)
    if timestep_spacing == "lu":
        _take_lu_steps(scheduler, config)
    if len(scheduler.timesteps) > num_inference_steps:
        _drop_step_before_the_first(scheduler, num_inference_steps)
    if name == "deis":
        # In float32 its coefficients, differences of nearly equal numbers, get worse with more than 50 steps.
        scheduler.sigmas = scheduler.sigmas.double()
    if hasattr(scheduler, "set_begin_index"):
        # Else the start is looked up by its time step, wrongly where close sigmas round to the same one.
        scheduler.set_begin_index(0)
    return scheduler


def _solver(name: str, num_inference_steps: int) -> tuple[Any, dict[str, Any]]:
    """The class of a solver and its settings, of a lower order where steps are few."""
    solver, settings = _SOLVERS[name]
    if name == "unipc" and num_inference_steps < THIRD_ORDER_FROM:
        settings = {**settings, "solver_order": 2}
    return solver, settings


def _check_steps(config: dict[str, Any], num_inference_steps: int) -> int:
    """The steps of the noise schedule, of which no more can be taken."""
    steps = config.get("num_train_timesteps", 1000)
    if not 1 <= num_inference_steps <= steps:
        raise ValueError(f"the noise schedule has 1 to {steps} steps, got num_inference_steps {num_inference_steps}")
    return steps


def _flow_scheduler(name: str, config: dict[str, Any], num_inference_steps: int) -> Any:
    """A solver for flow matching, at steps of its own whatever spacing is asked for."""
    if name not in _FLOW_SOLVERS:
        raise DataError(
            f"scheduler {name!r} is not made for flow matching; with this base model take one of "
            f"{', '.join(_FLOW_SOLVERS)}"
        )
    num_timesteps = _check_steps(config, num_inference_steps)
    solver, settings = _solver(name, num_inference_steps)
    scheduler = solver(
        num_train_timesteps=num_timesteps, prediction_type="flow_prediction", use_flow_sigmas=True,
        flow_shift=config.get("shift", 1.0), **settings,
    )  # fmt: skip
    scheduler.set_timesteps(num_inference_steps)
    # Times are no whole numbers, to which solvers would round them.
    scheduler.sigmas = sampling_sigmas(num_inference_steps)
    scheduler.timesteps = num_timesteps * scheduler.sigmas[:-1]
    scheduler.set_begin_index(0)
    return scheduler


def trajectory_scheduler(config: dict[str, Any], timesteps: list[int]) -> Any:
    """DPM-Solver++ of order 2 with an evaluation at each of these time steps, descending; it ends in clean latents."""
    scheduler: Any = DPMSolverMultistepScheduler(**_noise_schedule(config), solver_order=2)
    scheduler.set_timesteps(timesteps=timesteps)
    scheduler.set_begin_index(0)
    return scheduler


def student_config(config: dict[str, Any], num_evaluations: int) -> dict[str, Any]:
    """The scheduler config of a student of so many evaluations, of the noise schedule of its teacher's `config`."""
    scheduler: Any = TCDScheduler(**_noise_schedule(config), original_inference_steps=num_evaluations)
    return {**scheduler.config, "_class_name": STUDENT_SCHEDULER}


def _check_student(name: str, config: dict[str, Any], num_inference_steps: int) -> None:
    number = evaluations_of(config)
    if number is None and name == OF_STUDENTS:
        raise DataError(f"scheduler {name!r} is for distilled checkpoints, and this one was not: take 'unipc'")
    if number is not None and (name, num_inference_steps) != (OF_STUDENTS, number):
        raise DataError(
            f"this checkpoint was distilled for scheduler {OF_STUDENTS!r} in num_inference_steps {number}, "
            f"got {name!r} in {num_inference_steps}"
        )


def _student_scheduler(schedule: dict[str, Any], num_evaluations: int) -> Any:
    scheduler = _TCD(**schedule, original_inference_steps=num_evaluations)
    scheduler.set_timesteps(num_evaluations)
    scheduler.set_begin_index(0)
    return scheduler


def clean_latents(predicted: Tensor, noisy: Tensor, sigma: float, prediction_type: str) -> Tensor:
    """The clean latents that a network's prediction means.

    Args:
        predicted: the network's output, of the shape of `noisy`.
        noisy: alpha clean + sigma alpha noise, with alpha = (1 + sigma^2)^-1/2.
        sigma: noise over signal.
        prediction_type: one of `PREDICTION_TYPES`.
    """
    alpha = (1 + sigma**2) ** -0.5
    if prediction_type == "sample":
        return predicted
    if prediction_type == "v_prediction":
        return alpha * noisy - sigma * alpha * predicted
    return noisy / alpha - sigma * predicted


def _take_lu_steps(scheduler: Any, config: dict[str, Any]) -> None:
    """Steps even in the log of signal over noise: in diffusers one class has them, but all solvers can take them."""
    reference: Any = DPMSolverMultistepScheduler(**_noise_schedule(config), use_lu_lambdas=True)
    reference.set_timesteps(scheduler.num_inference_steps)
    scheduler.sigmas, scheduler.timesteps = reference.sigmas, reference.timesteps


def _drop_step_before_the_first(scheduler: Any, num_inference_steps: int) -> None:
    """Rounding gives trailing steps of some counts, such as 61, one step too many: time step -1."""
    scheduler.timesteps = scheduler.timesteps[:num_inference_steps]
    scheduler.num_inference_steps = num_inference_steps
    if hasattr(scheduler, "sigmas"):
        scheduler.sigmas = torch.cat([scheduler.sigmas[:num_inference_steps], scheduler.sigmas[-1:]])


def _noise_schedule(config: dict[str, Any]) -> dict[str, Any]:
    """The part of a scheduler config that says which noise the network was trained with."""
    refuse_flow(config, "this solver")
    schedule = {key: config[key] for key in _NOISE_SCHEDULE if key in config}
    prediction_type = schedule.get("prediction_type", "epsilon")
    if prediction_type not in PREDICTION_TYPES:
        raise DataError(f"prediction_type must be one of {', '.join(PREDICTION_TYPES)}, got {prediction_type!r}")
    if prediction_type == "epsilon" and schedule.get("rescale_betas_zero_snr"):
        raise DataError(
            "the scheduler config has rescale_betas_zero_snr with prediction_type epsilon: the first noisy latents "
            "hold no signal, and the noise in them says nothing about the image; expected v_prediction or sample"
        )
    return schedule


def _betas_without_signal(config: dict[str, Any]) -> list[float]:
    """Betas rescaled to (almost) no signal at the last step, for solvers that do not know how to rescale.

    Source: Lin et al., Common Diffusion Noise Schedules and Sample Steps Are Flawed, 2023, algorithm 1.
    """
    alpha_bar = DDPMScheduler(**_noise_schedule(config)).alphas_cumprod.double().clamp(min=MIN_ALPHA_BAR)
    before = torch.cat([torch.ones(1, dtype=torch.float64), alpha_bar[:-1]])
    return (1 - alpha_bar / before).tolist()
