"""How networks are evaluated: their precision and, on CPUs, one slice of rows per thread.

torch's own threads split every operation of a network and meet after each, some hundred times in
a gradient step. Here each thread takes a slice of the rows through the whole network and, in the
agents of this project, through the losses too, forwards and backwards. On two cores a gradient
step of AMP takes half as long (docs/speed.md), and no idle OpenMP threads spin on the CPUs that the
physics needs.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor, nn

from isaacgymenvs_lite.learning.cpu.precision import resolve_mixed_precision
from isaacgymenvs_lite.learning.cpu.row_slices import (
    join,
    split_proportionally,
    split_rows,
    sum_of_slices,
)
from isaacgymenvs_lite.utils.threads import one_torch_thread

# Fewer rows than this are not worth another thread.
_MIN_ROWS = 128
# Layers whose rows depend on each other, or that draw random numbers.
_UNSLICED_LAYERS = (nn.RNNBase, nn.Dropout, nn.modules.batchnorm._BatchNorm)

RowFunction = Callable[..., tuple[Tensor, ...]]
"""Tensors of n rows -> tensors of n rows, each row for itself."""
LossFunction = Callable[[dict[str, Tensor]], tuple[Tensor, dict[str, Tensor]]]
"""{name: rows} -> a loss, the mean over these rows, and values: such means, or tensors of rows."""


class NetworkExecutor:
    """Evaluates networks in a chosen precision and, on a CPU, slice by slice on several threads.

    Results do not depend on which thread is the faster one; a different number of threads changes
    the sums of gradients in the last bits.

    Args:
        device: where the networks are. Off the CPU nothing is sliced.
        bfloat16: compute under autocast to bfloat16; results are float32 in any case.
        num_threads: on a CPU; at least 1.
    """

    def __init__(
        self, device: str | torch.device, bfloat16: bool = False, num_threads: int = 1
    ) -> None:
        self._device_type = torch.device(device).type
        self.bfloat16 = bfloat16
        self.num_threads = num_threads if self._device_type == "cpu" else 1
        self._others: ThreadPoolExecutor | None = None
        self._within = threading.local()

    def attach(self, network: nn.Module) -> None:
        """Let `network` be evaluated by this executor whoever calls it.

        Covers `forward` of rl_games' networks (a dictionary of rows in, a tuple of rows and the
        recurrent state out) and the methods that the network names in `row_functions`. With layers
        that mix rows nothing is sliced from here on; the precision stays.
        """
        if any(isinstance(layer, _UNSLICED_LAYERS) for layer in network.modules()):
            self.num_threads = 1
        recurrent = any(isinstance(layer, nn.RNNBase) for layer in network.modules())
        whole = network.forward

        @functools.wraps(whole)
        def forward(inputs: dict[str, Any]) -> tuple[Any, ...]:
            if recurrent or not isinstance(inputs["obs"], Tensor):
                return self._whole(whole, inputs)
            return self._forward_rows(network, whole, inputs)

        network.forward = forward  # type: ignore[method-assign]
        for name in getattr(network, "row_functions", ()):
            setattr(network, name, self._row_method(network, getattr(network, name)))

    def _forward_rows(
        self, network: nn.Module, forward: Callable[..., Any], inputs: dict[str, Any]
    ) -> tuple[Any, ...]:
        num_rows = len(inputs["obs"])
        names = [
            name
            for name, value in inputs.items()
            if isinstance(value, Tensor) and value.ndim > 0 and len(value) == num_rows
        ]
        others = {name: value for name, value in inputs.items() if name not in names}

        def function(*rows: Tensor) -> tuple[Tensor, ...]:
            *outputs, _no_state = forward({**others, **dict(zip(names, rows, strict=True))})
            return tuple(outputs)

        return (*self.run(network, function, *(inputs[name] for name in names)), None)

    def _row_method(self, network: nn.Module, method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def sliced(*rows: Tensor, **named: Any) -> Any:
            names = [name for name, value in named.items() if isinstance(value, Tensor)]
            others = {name: value for name, value in named.items() if name not in names}
            several = True

            def function(*part: Tensor) -> tuple[Tensor, ...]:
                nonlocal several
                named_part = dict(zip(names, part[len(rows) :], strict=True))
                result = method(*part[: len(rows)], **named_part, **others)
                several = not isinstance(result, Tensor)
                return tuple(result) if several else (result,)

            outputs = self.run(network, function, *rows, *(named[name] for name in names))
            return outputs if several else outputs[0]

        return sliced

    def run(self, module: nn.Module, function: RowFunction, *rows: Tensor) -> tuple[Tensor, ...]:
        """Return `function(*rows)` in float32, differentiable (once) by parameters and rows.

        Args:
            module: whose parameters `function` uses.
            function: see `RowFunction`; several threads call it at the same time.
            rows: (n, ...) each.
        """
        evaluate = functools.partial(self._whole, function)
        slices = self._num_slices(len(rows[0]))
        if slices == 1 or getattr(self._within, "slice", False):
            return evaluate(*rows)
        if not torch.is_grad_enabled():
            parts = self.map(evaluate, split_rows(rows, slices))
            return tuple(torch.cat(column) for column in zip(*parts, strict=True))
        parameters = [p for p in module.parameters() if p.requires_grad]
        outputs = _Sliced.apply(self, evaluate, slices, len(rows), *rows, *parameters)
        return tuple(outputs)  # type: ignore[arg-type]

    def _whole(self, function: Callable[..., tuple[Any, ...]], *arguments: Any) -> tuple[Any, ...]:
        with self.autocast():
            outputs = function(*arguments)
        return tuple(_as_float32(output) for output in outputs)

    def autocast(self) -> torch.autocast:
        """Return the context in which networks compute."""
        return torch.autocast(self._device_type, torch.bfloat16, enabled=self.bfloat16)

    def _num_slices(self, num_rows: int) -> int:
        return max(1, min(self.num_threads, num_rows // _MIN_ROWS))

    def gradients(
        self, function: LossFunction, rows: dict[str, Tensor], parameters: list[nn.Parameter]
    ) -> tuple[list[Tensor | None], dict[str, Tensor]]:
        """Differentiate a loss that is a mean over rows, from its rows to its gradients by slices.

        Threads meet once, where a loss of the outputs of `run` makes them meet behind each network,
        and the loss itself is shared between them too.

        Args:
            function: see `LossFunction`; several threads call it at the same time.
            rows: {name: (n, ...)}. Numbers of rows may differ between names; each slice has the
                same share of all of them.
            parameters: that the loss is differentiated by.

        Returns:
            The gradients by `parameters`, None for those that the loss does not depend on, and
            the values: means over all rows where `function` gives numbers, all rows where it gives
            rows.
        """

        def differentiate(part: dict[str, Tensor], share: float) -> tuple[Any, ...]:
            loss, values = function(part)
            found = torch.autograd.grad(loss * share, parameters, allow_unused=True)
            return found, {name: value.detach() for name, value in values.items()}

        most = max(len(tensor) for tensor in rows.values())
        parts, shares = split_proportionally(rows, self._num_slices(most))
        results = self.map(differentiate, list(zip(parts, shares, strict=True)))
        found, values = zip(*results, strict=True)
        together = {name: join([v[name] for v in values], shares) for name in values[0]}
        return [sum_of_slices(column) for column in zip(*found, strict=True)], together

    def map(self, function: Callable[..., Any], arguments: list[tuple[Any, ...]]) -> list[Any]:
        """Return [function(*a) for a in arguments], the calls spread over the threads."""
        grad_enabled = torch.is_grad_enabled()
        busy = min(self.num_threads, len(arguments))
        if busy <= 1:
            return [function(*a) for a in arguments]

        def work(first: int) -> list[Any]:
            self._within.slice = True
            try:
                with torch.set_grad_enabled(grad_enabled):  # each thread has a switch of its own
                    return [function(*a) for a in arguments[first::busy]]
            finally:
                self._within.slice = False

        futures = [self._pool().submit(work, first) for first in range(1, busy)]
        with one_torch_thread():
            columns = [work(0)]
        columns += [future.result() for future in futures]
        return [columns[i % busy][i // busy] for i in range(len(arguments))]

    def _pool(self) -> ThreadPoolExecutor:
        """The threads beside the caller's own, made when first needed."""
        if self._others is None:
            self._others = ThreadPoolExecutor(
                self.num_threads - 1,
                thread_name_prefix="network",
                initializer=lambda: torch.set_num_threads(1),
            )
        return self._others


def attach_executor(
    network: nn.Module, device: str | torch.device, mixed_precision: Any
) -> NetworkExecutor:
    """Let a network be evaluated in the precision asked for, by as many threads as torch has.

    Args:
        network: an rl_games network (`model.a2c_network`).
        device: where it is.
        mixed_precision: the key `train.params.config.mixed_precision`.

    Raises:
        ConfigError: mixed_precision is none of True, False, "auto".
    """
    bfloat16 = resolve_mixed_precision(mixed_precision, device)
    executor = NetworkExecutor(device, bfloat16, torch.get_num_threads())
    executor.attach(network)
    return executor


def _as_float32(output: Any) -> Any:
    """Return an output of a network, or the tuple of its recurrent states, in float32."""
    if isinstance(output, tuple):
        return tuple(_as_float32(state) for state in output)
    return output.float() if isinstance(output, Tensor) else output


class _Sliced(torch.autograd.Function):
    """A function of rows and parameters whose slices are differentiated on several threads."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        executor: NetworkExecutor,
        function: RowFunction,
        slices: int,
        num_inputs: int,
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        rows = tensors[:num_inputs]
        wanted = ctx.needs_input_grad[4 : 4 + num_inputs]
        inputs = [
            tuple(part.detach().requires_grad_(w) for part, w in zip(parts, wanted, strict=True))
            for parts in split_rows(rows, slices)
        ]
        with torch.enable_grad():
            outputs = executor.map(function, inputs)
        columns = list(zip(*outputs, strict=True))
        results = tuple(torch.cat([part.detach() for part in column]) for column in columns)
        # What depends on no parameter (the spread of a fixed sigma) must not seem to.
        constant = [r for r, c in zip(results, columns, strict=True) if not c[0].requires_grad]
        ctx.mark_non_differentiable(*constant)
        ctx.executor, ctx.wanted, ctx.parameters = executor, wanted, tensors[num_inputs:]
        ctx.slices = list(zip(inputs, outputs, strict=True))
        return results

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        def differentiate(
            inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...], grads: tuple[Tensor, ...]
        ) -> list[Tensor | None]:
            sources = [x for x in inputs if x.requires_grad] + list(ctx.parameters)
            pairs = [(x, g) for x, g in zip(outputs, grads, strict=True) if x.requires_grad]
            targets, target_grads = zip(*pairs, strict=True)
            found = torch.autograd.grad(targets, sources, target_grads, allow_unused=True)
            return list(found)

        arguments = [
            (*graph, part)
            for graph, part in zip(ctx.slices, split_rows(grads, len(ctx.slices)), strict=True)
        ]
        found = ctx.executor.map(differentiate, arguments)
        ctx.slices = None  # frees the graphs
        columns = list(zip(*found, strict=True))
        num_row_grads = sum(ctx.wanted)
        row_grads = iter(columns[:num_row_grads])
        of_rows = [torch.cat(next(row_grads)) if wanted else None for wanted in ctx.wanted]
        return (None, None, None, None, *of_rows, *map(sum_of_slices, columns[num_row_grads:]))
