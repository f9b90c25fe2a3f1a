"""Checks that a checkpoint fits an agent or a player before anything is loaded from it.

torch's `load_state_dict` stops halfway at a tensor that does not fit, and fused Adam does not check
the shapes of its running averages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from rl_games.common.player import BasePlayer
from torch import Tensor, nn

from isaacgymenvs_lite.checkpoints.files import LLC_KEY, fit_optimizer_state, load_checkpoint, short
from isaacgymenvs_lite.errors import CheckpointError

_COMPILED_PREFIX = "_orig_mod."
_MOMENTS = ("exp_avg", "exp_avg_sq")
_NOT_NEGATIVE = ("running_var", "exp_avg_sq", "step")
"""Endings of the names of tensors whose values are never negative."""


@dataclass(frozen=True)
class Parts:
    """The objects that an agent or a player loads from a checkpoint, by the checkpoint's keys.

    `others` are gradient scalers, whose state holds only scalars. A checkpoint may lack the keys in
    `optional`. If `counts` is True, it must have `epoch` and `frame`.
    """

    modules: Mapping[str, nn.Module]
    optimizers: Mapping[str, torch.optim.Optimizer] = field(default_factory=dict)
    tensors: Mapping[str, Tensor] = field(default_factory=dict)
    others: Mapping[str, Any] = field(default_factory=dict)
    optional: frozenset[str] = frozenset()
    counts: bool = False

    @property
    def required(self) -> list[str]:
        """The keys that a checkpoint must have."""
        keys = [*self.modules, *self.optimizers, *self.tensors, *self.others]
        keys += ["epoch", "frame"] if self.counts else []
        return [key for key in keys if key not in self.optional]


# `load_checkpoint` has already checked these entries; a task checks its `env_state` itself.
_AS_THEY_ARE = ("epoch", "frame", "last_mean_rewards", "env_state", LLC_KEY)


class Fitting:
    """Compares a checkpoint with the modules and optimisers into which it is loaded.

    Error messages begin with `source`, the user's argument (`checkpoint=FILE`), and end with
    `hint`.
    """

    def __init__(
        self,
        source: str,
        hint: str = "made with another network or task; use its own task= and train="
        " (config.yaml in its run folder)",
    ) -> None:
        self._source = source
        self._hint = hint

    def parts(self, state: Mapping[str, Any], parts: Parts) -> dict[str, Any]:
        """Return the entries for `parts`; raise CheckpointError if an entry does not fit."""
        missing = [key for key in parts.required if key not in state]
        if missing:
            needs = " (test=True needs less)" if parts.optimizers else ""
            raise CheckpointError(
                f"{self._source}: has no {', '.join(missing)}, so that"
                f" {'training cannot go on from it' if parts.optimizers else 'it cannot be played'}"
                f"; expected a checkpoint that train.py wrote{needs}"
            )
        fitted = {key: state[key] for key in _AS_THEY_ARE if key in state}
        for key in (key for key in parts.modules if key in state):
            fitted[key] = self._module(state[key], parts.modules[key], key)
        for key in (key for key in parts.tensors if key in state):
            self._compare(state[key], parts.tensors[key], key)
            fitted[key] = state[key]
        for key in (key for key in parts.others if key in state):
            fitted[key] = self._other(state[key], parts.others[key], key)
        model = parts.modules.get("model")
        for key in (key for key in parts.optimizers if key in state):
            fitted[key] = self._optimizer(state[key], parts.optimizers[key], model, key)
        return fitted

    def _module(self, given: Mapping[str, Tensor], module: nn.Module, where: str) -> dict[str, Any]:
        own = module.state_dict()
        names = {name.replace(_COMPILED_PREFIX, ""): name for name in own}
        for name, own_name in names.items():
            if name not in given:
                raise self._misfit(f"has no {where}.{name}, expected {_kind(own[own_name])}")
        fitted: dict[str, Any] = {}
        for name, tensor in given.items():
            if name not in names:
                raise self._misfit(
                    f"has {where}.{short(name)} ({_kind(tensor)}), which is not expected"
                )
            if name.endswith("count") and isinstance(tensor, Tensor):
                tensor = tensor.double()  # rl_games 2 stores a normaliser's count as an integer
            self._compare(tensor, own[names[name]], f"{where}.{name}")
            fitted[names[name]] = tensor
        return fitted

    def _compare(self, given: Any, own: Tensor, where: str) -> None:
        if not isinstance(given, Tensor) or _kind(given) != _kind(own):
            raise self._misfit(f"{where} is {_kind(given)}, expected {_kind(own)}")
        if not given.isfinite().all():
            raise CheckpointError(
                f"{self._source}: {where} has values that are not finite: its training diverged;"
                " use an earlier checkpoint of it"
            )
        if where.endswith(_NOT_NEGATIVE) and (given < 0).any():
            raise CheckpointError(f"{self._source}: {where} has values below 0; use another file")

    def _optimizer(
        self, given: Any, optimizer: torch.optim.Optimizer, model: nn.Module | None, where: str
    ) -> dict[str, Any]:
        """Return Adam's running averages, with the groups and settings of `optimizer`."""
        own = optimizer.state_dict()["param_groups"]
        parameters = [p.detach() for group in optimizer.param_groups for p in group["params"]]
        try:
            if model is not None:
                given = fit_optimizer_state(given, optimizer, model)
            sizes = [len(group["params"]) for group in given["param_groups"]]
            if sizes != [len(group["params"]) for group in own]:
                raise ValueError(f"groups of {sizes} tensors")
            moments: dict[int, dict[str, Tensor]] = {}
            for number, entry in given["state"].items():
                moments[number] = {
                    **{name: entry[name] for name in _MOMENTS},
                    # Before torch 1.12 the step was no tensor.
                    "step": torch.as_tensor(entry["step"], dtype=torch.float32),
                }
                for name, value in moments[number].items():
                    replaced = torch.zeros(()) if name == "step" else parameters[number]
                    self._compare(value, replaced, f"{where}.state.{number}.{name}")
        except CheckpointError as error:
            line = str(error)
            line = line if line.startswith(self._source) else f"{self._source}: {line}"
            raise CheckpointError(line) from error
        except Exception as error:  # A state from another program may have any structure.
            raise self._misfit(f"{where} is no state of this optimiser") from error
        return {"state": moments, "param_groups": own}

    def _other(self, given: Any, other: Any, where: str) -> dict[str, Any]:
        """Return the scalars in the state of another object, such as a gradient scaler."""
        try:
            return {name: type(own)(given[name]) for name, own in other.state_dict().items()}
        except Exception as error:
            raise self._misfit(f"{where} does not hold the expected values") from error

    def _misfit(self, what: str) -> CheckpointError:
        return CheckpointError(f"{self._source}: {what}: {self._hint}")


class RestoringPlayer(BasePlayer):
    """Mixin that loads a checkpoint only if all of it fits.

    In a list of base classes, the mixin stands before rl_games' player.
    """

    model: Any

    def _parts(self) -> Parts:
        """Return the objects that the player loads from a checkpoint."""
        return Parts({"model": self.model})

    def restore(self, fn: str) -> dict[str, Any]:
        """Load a checkpoint and return its entries, or raise CheckpointError."""
        parts = self._parts()
        state = Fitting(f"checkpoint={fn}").parts(load_checkpoint(fn), parts)
        for key, module in parts.modules.items():
            if key in state:
                module.load_state_dict(state[key])
        if self.env is not None and state.get("env_state") is not None:
            self.env.set_env_state(state["env_state"])
        return state


def _kind(value: Any) -> str:
    """Describe a tensor by shape and type, and any other value by its type."""
    if not isinstance(value, Tensor):
        return f"a {type(value).__name__}"
    shape = "x".join(str(size) for size in value.shape) or "one value"
    return f"{shape} {str(value.dtype).removeprefix('torch.')}"
