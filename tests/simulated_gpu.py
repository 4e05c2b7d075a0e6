"""A GPU where there is none: CPU tensors that say they are on `cuda:0` and refuse what a GPU's would refuse.

    with simulated_gpu() as gpu:
        train(device="cuda")
    assert gpu.num_operations > 0

Refused are operations on tensors of both devices, on numbers a GPU must not share with a CPU's generator, and NumPy on
a tensor that was not fetched. What is computed is what the CPU computes, so that results must equal the CPU's. Seen is
every call of torch from Python; what torch's own functions call among themselves is taken on trust. Speed, memory,
kernels, float16 where this CPU has none, compiling and several GPUs are not simulated.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any
from unittest import mock

import torch
from torch.overrides import TorchFunctionMode

GPU = torch.device("cuda", 0)
MIX = {"__getitem__", "__setitem__", "copy_", "index_put_", "backward", "_has_compatible_shallow_copy_type"}
"""May take tensors of both devices: a GPU's tensor takes indices from the CPU, and copies go from one to the other."""


class GpuTensor(torch.Tensor):
    """A tensor on the simulated GPU."""

    __torch_function__ = torch._C._disabled_torch_function_impl


class SimulatedGpu(TorchFunctionMode):
    """Sees every call of torch and says where its result is.

    Attributes:
        num_operations: on tensors of the GPU.
    """

    def __init__(self) -> None:
        """A GPU that has done nothing yet."""
        super().__init__()
        self.num_operations = 0

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run `func` on the CPU's numbers, or raise as a GPU would."""
        kwargs = dict(kwargs or {})
        name = getattr(func, "__name__", str(func))
        if name == "__get__":
            return self._property(func, args)
        if name in ("numpy", "__array__") and on_gpu(args[0]):
            raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first")
        if name == "__deepcopy__":
            return _deep_copy(args[0])
        if name in ("to", "cpu", "cuda") and args and isinstance(args[0], torch.Tensor):
            return self._moved(name, args, kwargs)
        tensors: list[torch.Tensor] = []
        _map((args, kwargs), tensors.append)
        own = [tensor for tensor in tensors if on_gpu(tensor)]
        # What has no dimension is a number, which a GPU's operation takes from anywhere.
        foreign = [tensor for tensor in tensors if not on_gpu(tensor) and tensor.dim()]
        asked = None
        if kwargs.get("device") is not None:
            asked = torch.device(kwargs["device"]).type == "cuda"
            kwargs["device"] = "cpu"
        self.num_operations += bool(own)
        if own and foreign and asked is None and (name not in MIX or (name == "__getitem__" and not on_gpu(args[0]))):
            shapes = [[tuple(tensor.shape) for tensor in found] for found in (own, foreign)]
            raise RuntimeError(f"{name}: tensors on two devices, cuda:0 {shapes[0]} and cpu {shapes[1]}")
        there = bool(own) if asked is None else asked
        if there and kwargs.get("generator") is not None:
            raise RuntimeError(f"{name}: expected a 'cuda' device type for generator but found 'cpu'")
        made = func(*args, **kwargs)
        if any(made is tensor for tensor in tensors):  # in place
            return made
        return _map(made, lambda tensor: _placed(tensor, there)) if there else made

    @staticmethod
    def _property(func: Any, args: Any) -> Any:
        asked = getattr(getattr(func, "__self__", None), "__name__", "")
        if asked in ("device", "is_cuda", "is_cpu"):
            there = on_gpu(args[0])
            return {"device": GPU if there else torch.device("cpu"), "is_cuda": there, "is_cpu": not there}[asked]
        made = func(*args)
        return _map(made, lambda tensor: _placed(tensor, True)) if on_gpu(args[0]) else made

    @staticmethod
    def _moved(name: str, args: Any, kwargs: dict[str, Any]) -> Any:
        tensor = args[0]
        there, further = {"cpu": False, "cuda": True}.get(name, on_gpu(tensor)), list(args[1:])
        if kwargs.get("device") is not None:
            there, kwargs["device"] = torch.device(kwargs["device"]).type == "cuda", "cpu"
        for number, place in enumerate(further if name == "to" else ()):
            if isinstance(place, (torch.device, str)):
                there, further[number] = torch.device(place).type == "cuda", "cpu"
            elif isinstance(place, torch.Tensor):
                there, further[number] = on_gpu(place), place.as_subclass(torch.Tensor)
        made = tensor.as_subclass(torch.Tensor) if on_gpu(tensor) else tensor
        made = torch.Tensor.to(made, *further, **kwargs) if name == "to" else made
        if there != on_gpu(tensor):
            return _placed(made.clone(), there)
        same = made.data_ptr() == tensor.data_ptr() and made.dtype == tensor.dtype
        return tensor if same else _placed(made, there)


def on_gpu(tensor: torch.Tensor) -> bool:
    """Does it say that it is on the simulated GPU?"""
    return isinstance(tensor, GpuTensor)


def _placed(tensor: torch.Tensor, there: bool) -> torch.Tensor:
    return tensor if on_gpu(tensor) == there else tensor.as_subclass(GpuTensor if there else torch.Tensor)


def _deep_copy(tensor: torch.Tensor) -> torch.Tensor:
    there, needed = on_gpu(tensor), tensor.requires_grad
    made = _placed(tensor.detach().clone(), there).requires_grad_(needed)
    if isinstance(tensor, torch.nn.Parameter) and there:
        made._is_param = True  # as torch marks parameters of other classes
    return torch.nn.Parameter(made, needed) if isinstance(tensor, torch.nn.Parameter) and not there else made


def _map(value: Any, function: Callable[[torch.Tensor], Any]) -> Any:
    if isinstance(value, torch.Tensor):
        return function(value)
    if isinstance(value, dict):
        return {key: _map(item, function) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        mapped = [_map(item, function) for item in value]
        return type(value)(*mapped) if hasattr(value, "_fields") else type(value)(mapped)
    return value


class _CpuAutocast(torch.autocast):
    def __init__(self, device_type: str, *args: Any, **kwargs: Any) -> None:
        super().__init__("cpu", *args, **kwargs)


@contextlib.contextmanager
def simulated_gpu() -> Iterator[SimulatedGpu]:
    """Within the context torch says that it has one GPU; in this thread alone tensors can be on it."""
    save, load = torch.save, torch.load

    def save_plain(state: Any, *args: Any, **kwargs: Any) -> None:
        save(_map(state, lambda tensor: _placed(tensor, False)), *args, **kwargs)

    def load_to(*args: Any, map_location: Any, **kwargs: Any) -> Any:
        there = torch.device(map_location).type == "cuda"
        return _map(load(*args, map_location="cpu", **kwargs), lambda tensor: _placed(tensor, there))

    patches = {
        "torch.save": save_plain,
        "torch.load": load_to,
        "torch.cuda.is_available": lambda: True,
        "torch.cuda.device_count": lambda: 1,
        "torch.cuda.init": lambda: None,
        "torch.cuda.current_device": lambda: 0,
        "torch.cuda.set_device": lambda _: None,
        "torch.cuda.get_device_properties": lambda _: SimpleNamespace(uuid=f"simulated-{os.getpid()}"),
        "torch.cuda.synchronize": lambda *_: None,
        "torch.cuda.empty_cache": lambda: None,
        "torch.cuda.is_bf16_supported": lambda *_: True,
        # Of a torch that was built for GPUs, whose optimizers ask the driver.
        "torch.accelerator.current_accelerator": lambda **_: None,
        "torch.autocast": _CpuAutocast,
    }
    # A module that moves gets new parameters: other classes of tensors cannot be put into the old ones.
    before = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    try:
        with contextlib.ExitStack() as stack:
            for name, value in patches.items():
                stack.enter_context(mock.patch(name, value))
            yield stack.enter_context(SimulatedGpu())
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(before)
