"""Evaluates networks in a chosen precision; on CPUs, each thread computes some of the rows.

torch's threads split every operation and synchronise after each, some hundred times in a gradient
step. In this module, each thread computes forward and backward pass of the whole network for a
slice of the rows; in this project's agents, it also computes the losses. On two cores this halves
the time of an AMP gradient step (docs/speed.md), and no idle OpenMP threads use CPU time that the
physics needs.

With `torch_deterministic=True`, slices and results do not depend on the number of threads.
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor, nn

from isaacgymenvs_lite.learning.modules.running_mean_std import replace_normalizers
from isaacgymenvs_lite.utils.precision import resolve_mixed_precision
from isaacgymenvs_lite.utils.threads import one_torch_thread

# A slice has at least this many rows.
_MIN_ROWS = 128
# Cost b of each additional slice, in multiplications. Python's interpreter lock serialises small
# operations of the slices. If a network needs `a` multiplications, the cost of s slices is a / s +
# b * s, which is least for s = sqrt(a / b).
_PRODUCTS_OF_A_SLICE = 300_000_000
# Rows per slice and largest number of slices under `torch_deterministic=True`. Smaller slices cost
# more, because each slice casts the weights and computes separate gradients; larger slices leave
# threads idle.
_FIXED_ROWS = 1024
_MOST_FIXED_SLICES = 16
# Without gradients, this many rows are evaluated at once: their activations fit into the cache.
_CHUNK_ROWS = 8192
# Layers that mix rows or draw random numbers, and therefore cannot be sliced.
_UNSLICED_LAYERS = (nn.RNNBase, nn.Dropout, nn.modules.batchnorm._BatchNorm)
# Attributes in which a torch module stores its parameters, buffers and layers.
_MODULE_STATE = ("_parameters", "_buffers", "_modules", "_non_persistent_buffers_set")

RowFunction = Callable[..., Any]
"""A function from tensors of n rows to one or several tensors of n rows, which treats each row
independently."""
LossFunction = Callable[[dict[str, Tensor]], tuple[Tensor, dict[str, Tensor]]]
"""A function from {name: rows} to a mean loss and {name: value}; a value is a mean over the rows or
a tensor of rows."""


def parallelize(model: Any, device: str | torch.device, mixed_precision: Any) -> NetworkExecutor:
    """Replace the network of an rl_games model by a `ParallelNetwork`, and return its executor."""
    bfloat16 = resolve_mixed_precision(mixed_precision, device)
    parameters = sum(parameter.numel() for parameter in model.a2c_network.parameters())
    network = ParallelNetwork(
        model.a2c_network, device, bfloat16, torch.get_num_threads(), parameters
    )
    model.a2c_network = network
    return network.executor


def take_models(agent: Any, device: str | torch.device, precision: Any) -> NetworkExecutor:
    """Give an agent's policy and critic fast normalisers and networks; return the executor.

    The agent's `value_mean_std` is set as well. The executor of the policy's network is returned.
    """
    models = [agent.model]
    if agent.has_central_value:
        models.append(agent.central_value_net.model)
    executors = []
    for model in models:
        replace_normalizers(model)
        executors.append(parallelize(model, device, precision))
    if agent.normalize_value:
        agent.value_mean_std = models[-1].value_mean_std
    return executors[0]


class ParallelNetwork(nn.Module):
    """Replaces an rl_games network; each of several threads computes a slice of the rows.

    The threads compute `forward` (from a dictionary of rows to a tuple of rows and the recurrent
    state) and the methods named in `row_functions`. All other attributes are those of the wrapped
    network. Parameters, buffers and layers keep their names in checkpoints.

    `serial` is the wrapped network; a call of `serial` uses one thread and the parameters'
    precision. A network whose layers mix rows (`_UNSLICED_LAYERS`) is not sliced.
    """

    serial: nn.Module
    executor: NetworkExecutor

    def __init__(
        self,
        network: nn.Module,
        device: str | torch.device,
        bfloat16: bool = False,
        num_threads: int = 1,
        row_products: int | None = None,
    ) -> None:
        super().__init__()
        layers = list(network.modules())
        can_slice = not any(isinstance(layer, _UNSLICED_LAYERS) for layer in layers)
        del vars(self)["training"]  # `training` is then read from the wrapped network.
        vars(self).update(
            {name: vars(network)[name] for name in _MODULE_STATE},
            serial=network,
            executor=NetworkExecutor(device, bfloat16, num_threads, can_slice, row_products),
            _is_recurrent=any(isinstance(layer, nn.RNNBase) for layer in layers),
        )

    def forward(self, inputs: dict[str, Any]) -> tuple[Any, ...]:
        """Return the network's outputs; all inputs with as many rows as `obs` are sliced."""
        if self._is_recurrent or not isinstance(inputs["obs"], Tensor):
            return self.executor.evaluate(self.serial, inputs)
        sliced: dict[str, Tensor] = {}
        for name, value in inputs.items():
            if isinstance(value, Tensor) and value.shape[:1] == inputs["obs"].shape[:1]:
                sliced[name] = value

        def function(*rows: Tensor) -> tuple[Tensor, ...]:
            *outputs, _no_state = self.serial({**inputs, **dict(zip(sliced, rows, strict=True))})
            return tuple(outputs)

        return (*self.executor.run(self, function, *sliced.values()), None)

    def __getattr__(self, name: str) -> Any:
        # `serial` is not set yet while the module is copied.
        if name.startswith("__") or "serial" not in vars(self):
            raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")
        value = getattr(self.serial, name)
        if name not in getattr(self.serial, "row_functions", ()):
            return value
        return functools.partial(self._call_row_function, value)

    def _call_row_function(self, method: Callable[..., Any], *rows: Tensor, **named: Any) -> Any:
        sliced = {name: value for name, value in named.items() if isinstance(value, Tensor)}

        def function(*part: Tensor) -> Any:
            named_part = dict(zip(sliced, part[len(rows) :], strict=True))
            return method(*part[: len(rows)], **{**named, **named_part})

        return self.executor.run(self, function, *rows, *sliced.values())

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self.serial, name, value)

    def train(self, mode: bool = True) -> ParallelNetwork:
        """Set training or evaluation mode of the wrapped network."""
        self.serial.train(mode)
        return self


def serial_network(network: nn.Module) -> Any:
    """Return the network without threads and autocast, so that an exporter can trace it."""
    return network.serial if isinstance(network, ParallelNetwork) else network


class NetworkExecutor:
    """Evaluates functions of rows in a chosen precision; on a CPU, threads evaluate slices of them.

    The number of threads changes the last bits of summed gradients, unless torch uses only
    deterministic algorithms.

    Args:
        device: device of the networks. Rows are only sliced on the CPU.
        bfloat16: whether to compute under autocast to bfloat16. Results are always float32.
        num_threads: largest number of threads.
        can_slice: whether all functions treat each row independently.
        row_products: number of multiplications per row (about the number of parameters), which
            limits the number of slices. If `row_products` is None, all threads are used.
    """

    def __init__(
        self,
        device: str | torch.device,
        bfloat16: bool = False,
        num_threads: int = 1,
        can_slice: bool = True,
        row_products: int | None = None,
    ) -> None:
        self._device_type = torch.device(device).type
        self._can_slice = can_slice and self._device_type == "cpu"
        self.bfloat16 = bfloat16
        self.num_threads = num_threads if self._can_slice else 1
        self._row_products = row_products
        self._others: ThreadPoolExecutor | None = None
        self._within = threading.local()

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy the executor without its threads."""
        settings = (self.bfloat16, self.num_threads, self._can_slice, self._row_products)
        return NetworkExecutor, (self._device_type, *settings)

    def run(self, module: nn.Module, function: RowFunction, *rows: Tensor) -> Any:
        """Return `function(*rows)` in float32, once differentiable in parameters and rows.

        Several threads call `function`, which uses parameters of `module`.
        """
        slices = self._num_slices(len(rows[0]))
        if slices == 1 or getattr(self._within, "slice", False):
            return self.evaluate(function, *rows)
        several = True

        def evaluate(*part: Tensor) -> tuple[Tensor, ...]:
            nonlocal several
            outputs = self.evaluate(function, *part)
            several = isinstance(outputs, tuple)
            return outputs if several else (outputs,)

        if torch.is_grad_enabled():
            parameters = [p for p in module.parameters() if p.requires_grad]
            apply: Any = _SlicedFunction.apply
            outputs = apply(self, evaluate, slices, len(rows), *rows, *parameters)
        else:
            parts = self.map(evaluate, split_rows(rows, slices))
            outputs = tuple(map(torch.cat, zip(*parts, strict=True)))
        return outputs if several else outputs[0]

    def evaluate(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return `function(*arguments)` in float32; only the calling thread computes it."""
        with torch.autocast(self._device_type, torch.bfloat16, enabled=self.bfloat16):
            outputs = function(*arguments)
        return _as_float32(outputs)

    def gradients(
        self, function: LossFunction, rows: dict[str, Tensor], parameters: list[nn.Parameter]
    ) -> tuple[list[Tensor | None], dict[str, Tensor]]:
        """Differentiate a mean loss over rows; threads compute both passes for slices of the rows.

        The threads synchronise once; `run` synchronises after each network, and leaves the loss to
        one thread. Tensors may have different numbers of rows; each slice gets the same share of
        every tensor.

        Returns:
            The gradients (None for parameters that do not influence the loss), and the values of
            `function`: scalars are means over all rows, and tensors have all rows.
        """

        def differentiate(part: dict[str, Tensor], share: float) -> tuple[Any, ...]:
            loss, values = function(part)
            return torch.autograd.grad(loss * share, parameters, allow_unused=True), values

        most = max(map(len, rows.values()))
        parts, shares = split_proportionally(rows, self._num_slices(most))
        found, values = zip(
            *self.map(differentiate, list(zip(parts, shares, strict=True))), strict=True
        )
        merged = {}
        for name in values[0]:
            columns = [of_slice[name].detach() for of_slice in values]
            if columns[0].ndim > 0:
                merged[name] = torch.cat(columns)
            else:
                weighted = map(torch.mul, columns, shares)
                merged[name] = torch.stack(list(weighted)).sum()
        return list(map(sum_gradients, zip(*found, strict=True))), merged

    def map(self, function: Callable[..., Any], arguments: list[tuple[Any, ...]]) -> list[Any]:
        """Return [function(*a) for a in arguments]; the threads share the calls."""
        if len(arguments) <= 1:
            return [function(*a) for a in arguments]
        grad_enabled = torch.is_grad_enabled()
        results: list[Any] = [None] * len(arguments)
        busy = min(self.num_threads, len(arguments))

        def work(first: int) -> None:
            self._within.slice = True
            try:
                with torch.set_grad_enabled(grad_enabled):  # This switch is per thread.
                    for i in range(first, len(arguments), busy):
                        results[i] = function(*arguments[i])
            finally:
                self._within.slice = False

        if self._others is None and busy > 1:
            self._others = ThreadPoolExecutor(
                self.num_threads - 1, "network", initializer=lambda: torch.set_num_threads(1)
            )
        others: Any = self._others
        futures = [others.submit(work, first) for first in range(1, busy)]
        with one_torch_thread():
            work(0)
        for future in futures:
            future.result()
        return results

    def _num_slices(self, num_rows: int) -> int:
        if not self._can_slice:
            return 1
        if torch.are_deterministic_algorithms_enabled():
            return max(1, min(_MOST_FIXED_SLICES, num_rows // _FIXED_ROWS))
        most = min(self.num_threads, num_rows // _MIN_ROWS)
        if self._row_products is not None:
            most = min(most, math.isqrt(num_rows * self._row_products // _PRODUCTS_OF_A_SLICE))
        return max(1, most)


def _as_float32(output: Any) -> Any:
    """Convert an output, or all outputs and recurrent states in a tuple, to float32."""
    if isinstance(output, tuple):
        return tuple(map(_as_float32, output))
    return output.float() if isinstance(output, Tensor) else output


class _SlicedFunction(torch.autograd.Function):
    """A differentiable function of rows and parameters, computed in slices by several threads."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        executor: NetworkExecutor,
        function: RowFunction,
        slices: int,
        num_inputs: int,
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.needs_grad = ctx.needs_input_grad[4 : 4 + num_inputs]
        inputs = []
        for parts in split_rows(tensors[:num_inputs], slices):
            pairs = zip(parts, ctx.needs_grad, strict=True)
            inputs.append(tuple(part.detach().requires_grad_(needs) for part, needs in pairs))
        with torch.enable_grad():
            outputs = executor.map(function, inputs)
        columns = list(zip(*outputs, strict=True))
        results = tuple(torch.cat([part.detach() for part in column]) for column in columns)
        # An output that depends on no parameter (a fixed sigma) must not require gradients.
        constant = [r for r, c in zip(results, columns, strict=True) if not c[0].requires_grad]
        ctx.mark_non_differentiable(*constant)
        ctx.executor, ctx.parameters = executor, tensors[num_inputs:]
        ctx.slices = list(zip(inputs, outputs, strict=True))
        return results

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        def differentiate(
            inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...], grads: tuple[Tensor, ...]
        ) -> tuple[Tensor | None, ...]:
            sources = [x for x in inputs if x.requires_grad] + list(ctx.parameters)
            pairs = [(x, g) for x, g in zip(outputs, grads, strict=True) if x.requires_grad]
            targets, target_grads = zip(*pairs, strict=True)
            return torch.autograd.grad(targets, sources, target_grads, allow_unused=True)

        parts = split_rows(grads, len(ctx.slices))
        arguments = [(*graph, part) for graph, part in zip(ctx.slices, parts, strict=True)]
        columns = list(zip(*ctx.executor.map(differentiate, arguments), strict=True))
        ctx.slices = None  # Frees the graphs.
        row_grads = [torch.cat(columns.pop(0)) if needs else None for needs in ctx.needs_grad]
        return (None, None, None, None, *row_grads, *map(sum_gradients, columns))


# --- slices of rows --------------------------------------------------------------------------


def evaluate_in_chunks(function: Callable[..., Tensor], *rows: Tensor) -> Tensor:
    """Return function(*rows) (..., D) in float32 for rows (..., F), without gradients.

    The function is called for chunks of rows, whose activations fit into the CPU's cache.
    """
    with torch.no_grad():
        columns = [x.reshape(-1, x.shape[-1]).split(_CHUNK_ROWS) for x in rows]
        results = torch.cat([function(*chunk).float() for chunk in zip(*columns, strict=True)])
    return results.view(*rows[0].shape[:-1], -1)


def split_rows(rows: tuple[Tensor, ...], slices: int) -> list[tuple[Tensor, ...]]:
    """Return `slices` tuples; tuple i holds the i-th part of each tensor."""
    return list(zip(*(torch.tensor_split(tensor, slices) for tensor in rows), strict=True))


def split_proportionally(
    rows: dict[str, Tensor], slices: int
) -> tuple[list[dict[str, Tensor]], list[float]]:
    """Split tensors of different lengths, so that a slice has the same share of every tensor.

    Return the slices and their shares. The number of slices is at most `slices`, and at most the
    greatest common divisor of the lengths.
    """
    unit = math.gcd(*map(len, rows.values()))
    slices = max(1, min(slices, unit))
    parts: list[dict[str, Tensor]] = []
    shares: list[float] = []
    first = 0
    for i in range(slices):
        end = unit * (i + 1) // slices
        part = {}
        for name, tensor in rows.items():
            factor = len(tensor) // unit
            part[name] = tensor[factor * first : factor * end]
        parts.append(part)
        shares.append((end - first) / unit)
        first = end
    return parts, shares


def sum_gradients(grads: tuple[Tensor | None, ...]) -> Tensor | None:
    """Return the sum of a parameter's gradients from all slices; None counts as 0."""
    total = grads[0]
    for grad in grads[1:]:
        total = grad if total is None else total if grad is None else total + grad
    return total
