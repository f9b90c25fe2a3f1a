"""Checks that a checkpoint fits agent or player before anything of it is loaded.

Adam's fused step reads as many numbers of a moment as its parameter has, whatever the moment's
size is, and `load_state_dict` stops halfway. Here every tensor and every number is compared with
the one that it replaces, and nothing is loaded unless all of them fit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from rl_games.common.player import BasePlayer
from torch import Tensor, nn

from isaacgymenvs_lite.checkpoints.files import LLC_KEY, load_checkpoint, short
from isaacgymenvs_lite.checkpoints.optimizer_state import fit_optimizer_state
from isaacgymenvs_lite.errors import CheckpointError

_COMPILED_PREFIX = "_orig_mod."
_MOMENTS = ("exp_avg", "exp_avg_sq")
# Entries of state dictionaries of which a square root is taken.
_NOT_NEGATIVE = ("running_var", "exp_avg_sq")
# Entries of an optimiser's groups that a checkpoint sets: number of values, least, upper bound.
_HYPERPARAMETERS = {
    "lr": (1, 0.0, math.inf),
    "betas": (2, 0.0, 1.0),
    "eps": (1, 0.0, math.inf),
    "weight_decay": (1, 0.0, math.inf),
}


@dataclass(frozen=True)
class Parts:
    """The entries of a checkpoint that an agent or a player loads, by the checkpoint's keys.

    Attributes:
        modules: networks and normalisers.
        optimizers: of the agent; all of them are Adam.
        tensors: single tensors.
        scalers: gradient scalers.
        optional: keys that a checkpoint may leave out.
        counts: True if it must have `epoch` and `frame`.
    """

    modules: Mapping[str, nn.Module]
    optimizers: Mapping[str, torch.optim.Optimizer] = field(default_factory=dict)
    tensors: Mapping[str, Tensor] = field(default_factory=dict)
    scalers: Mapping[str, Any] = field(default_factory=dict)
    optional: frozenset[str] = frozenset()
    counts: bool = False

    @property
    def required(self) -> list[str]:
        """Keys that a checkpoint must have."""
        keys = [*self.modules, *self.optimizers, *self.tensors, *self.scalers]
        keys += ["epoch", "frame"] if self.counts else []
        return [key for key in keys if key not in self.optional]


# Checked when the file was read; a task checks its own entry.
_AS_THEY_ARE = ("epoch", "frame", "last_mean_rewards", "env_state", LLC_KEY)


def _as_counted(name: str, tensor: Any) -> Any:
    """Return a tensor; the integer that rl_games 2 counts a normaliser's rows with, in float64."""
    is_count = name.rpartition(".")[2] == "count" and isinstance(tensor, Tensor)
    return tensor.double() if is_count and tensor.dtype == torch.int64 else tensor


class Fitting:
    """Compares a checkpoint with the modules and optimisers that load it.

    Args:
        source: the user's argument, the first words of a message: `checkpoint=FILE`.
        hint: what to do if it does not fit.
    """

    def __init__(
        self,
        source: str,
        hint: str = "made with another network or task; use the task= and train= it was trained"
        " with (config.yaml in its run folder)",
    ) -> None:
        self._source = source
        self._hint = hint

    def parts(self, state: Mapping[str, Any], parts: Parts) -> dict[str, Any]:
        """Return the entries of a checkpoint that `parts` names; all of them fit.

        Raises:
            CheckpointError: one is missing or does not fit; the message names the first.
        """
        missing = [key for key in parts.required if key not in state]
        if missing:
            needs = " (test=True needs less)" if parts.optimizers else ""
            raise CheckpointError(
                f"{self._source}: has no {', '.join(missing)}, so that"
                f" {'training cannot go on from it' if parts.optimizers else 'it cannot be played'}"
                f"; expected a checkpoint that train.py wrote{needs}"
            )
        fitted = {key: state[key] for key in _AS_THEY_ARE if key in state}
        for key, module in parts.modules.items():
            if key in state:
                fitted[key] = self.module(state[key], module, key)
        for key, tensor in parts.tensors.items():
            if key in state:
                self._compare(state[key], tensor, key)
                fitted[key] = state[key]
        for key, scaler in parts.scalers.items():
            if key in state:
                fitted[key] = self._numbers(state[key], scaler.state_dict(), key)
        model = parts.modules.get("model")
        for key, optimizer in parts.optimizers.items():
            if key in state:
                fitted[key] = self.optimizer(state[key], optimizer, model, key)
        return fitted

    def module(self, given: Mapping[str, Tensor], module: nn.Module, where: str) -> dict[str, Any]:
        """Return the state of a module, under the module's own names.

        Raises:
            CheckpointError: a name is unknown or missing, or a tensor does not fit.
        """
        own = module.state_dict()
        names = {name.replace(_COMPILED_PREFIX, ""): name for name in own}
        given = {name: _as_counted(name, tensor) for name, tensor in given.items()}
        for name, tensor in names.items():
            if name not in given:
                raise self._misfit(f"has no {where}.{name}, expected {_kind(own[tensor])}")
        for name, tensor in given.items():
            if name not in names:
                raise self._misfit(
                    f"has {where}.{short(name)} ({_kind(tensor)}), which is not expected"
                )
            self._compare(tensor, own[names[name]], f"{where}.{name}")
        return {own_name: given[name] for name, own_name in names.items()}

    def _compare(self, given: Any, own: Tensor, where: str) -> None:
        """Compare a tensor with the one that it replaces.

        Raises:
            CheckpointError: type or shape differ, or a number cannot be used.
        """
        if not isinstance(given, Tensor) or _kind(given) != _kind(own):
            raise self._misfit(f"{where} is {_kind(given)}, expected {_kind(own)}")
        if not given.isfinite().all():
            raise CheckpointError(
                f"{self._source}: {where} holds numbers that are not finite: its training had"
                " broken down; take an earlier checkpoint of it"
            )
        if where.endswith(_NOT_NEGATIVE) and (given < 0).any():
            raise CheckpointError(
                f"{self._source}: {where} holds numbers below 0, expected squares; take another"
                " checkpoint"
            )

    def optimizer(
        self,
        given: Any,
        optimizer: torch.optim.Optimizer,
        model: nn.Module | None,
        where: str,
    ) -> dict[str, Any]:
        """Return the state of an Adam in the form that `optimizer` loads.

        Groups keep the switches of `optimizer`; the numbers are the checkpoint's.

        Raises:
            CheckpointError: its parameters are others, or a number cannot be used.
        """
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        self._check_structure(given, len(parameters), where)
        if model is not None:
            try:
                given = fit_optimizer_state(given, optimizer, model)
            except CheckpointError as error:
                raise CheckpointError(f"{self._source}: {error}") from error
        own_groups = optimizer.state_dict()["param_groups"]
        sizes = [len(group["params"]) for group in given["param_groups"]]
        if sizes != [len(group["params"]) for group in own_groups]:
            raise self._misfit(
                f"{where}.param_groups are of {_listed(sizes)} tensors, expected"
                f" {_listed(len(group['params']) for group in own_groups)}"
            )
        groups = [
            {**own, **self._hyperparameters(group, f"{where}.param_groups.{i}")}
            for i, (own, group) in enumerate(zip(own_groups, given["param_groups"], strict=True))
        ]
        return {"state": self._moments(given["state"], parameters, where), "param_groups": groups}

    def _check_structure(self, given: Any, num_parameters: int, where: str) -> None:
        """Check that the groups have as many parameters, numbered 0, 1, 2, ..."""
        groups = given.get("param_groups") if isinstance(given, dict) else None
        numbers: list[Any] = []
        for group in groups if isinstance(groups, list) else ():
            params = group.get("params") if isinstance(group, dict) else None
            numbers += params if isinstance(params, list) else [None]
        if not numbers or not isinstance(given.get("state"), dict):
            raise self._misfit(f"{where} is no state of an optimiser, expected state and groups")
        # Compared one by one: the entries of a file may have any type.
        if any(type(n) is not int or n != i for i, n in enumerate(numbers)):
            raise self._misfit(f"{where}.param_groups do not number their parameters 0, 1, 2, ...")
        if len(numbers) != num_parameters:
            raise self._misfit(
                f"{where}.param_groups are of {len(numbers)} tensors, expected {num_parameters}"
            )

    def _hyperparameters(self, given: Mapping[str, Any], where: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, (length, least, bound) in _HYPERPARAMETERS.items():
            if name not in given:
                continue
            values = given[name] if isinstance(given[name], (list, tuple)) else [given[name]]
            usable = len(values) == length and all(
                type(value) in (int, float) and least <= value < bound for value in values
            )
            if not usable:
                numbers = "a number" if length == 1 else f"{length} numbers"
                raise CheckpointError(
                    f"{self._source}: {where}.{name} is {short(given[name])}, expected {numbers} of"
                    f" at least {least:g}" + ("" if math.isinf(bound) else f" and below {bound:g}")
                )
            floats = tuple(float(value) for value in values)
            found[name] = floats[0] if length == 1 else floats
        return found

    def _moments(
        self, given: Mapping[Any, Any], parameters: list[Tensor], where: str
    ) -> dict[int, dict[str, Tensor]]:
        """Return the moments by number of the parameter; a parameter may have none."""
        moments: dict[int, dict[str, Tensor]] = {}
        for number, entry in given.items():
            place = f"{where}.state.{short(number)}"
            if type(number) is not int or not 0 <= number < len(parameters):
                raise self._misfit(
                    f"{place} is of no parameter, expected 0 to {len(parameters) - 1}"
                )
            for name in (*_MOMENTS, "step"):
                if not isinstance(entry, dict) or name not in entry:
                    raise self._misfit(f"has no {place}.{name}")
            for name in _MOMENTS:
                self._compare(entry[name], parameters[number].detach(), f"{place}.{name}")
            moments[number] = {name: entry[name] for name in _MOMENTS}
            moments[number]["step"] = self._step(entry["step"], f"{place}.step")
        return moments

    def _step(self, given: Any, where: str) -> Tensor:
        """Return an optimiser's step count; before torch 1.12 it was a number."""
        if type(given) in (int, float):
            given = torch.tensor(float(given))
        self._compare(given, torch.zeros(()), where)
        if given < 0:
            raise CheckpointError(f"{self._source}: {where} is {given.item()}, expected at least 0")
        return given

    def _numbers(self, given: Any, own: Mapping[str, Any], where: str) -> dict[str, Any]:
        """Return the entries that `own` has, all of them numbers of at least 0."""
        numbers = {key: given.get(key) for key in own} if isinstance(given, dict) else {}
        for key in own:
            value: Any = numbers.get(key)
            if type(value) not in (int, float) or not 0.0 <= value < math.inf:
                raise self._misfit(f"{where}.{key} is {short(value)}, expected a number")
        return numbers

    def _misfit(self, what: str) -> CheckpointError:
        return CheckpointError(f"{self._source}: {what}: {self._hint}")


class RestoringPlayer(BasePlayer):
    """Loads a checkpoint once all of it fits; a mixin, listed before rl_games' player."""

    model: Any

    def _parts(self) -> Parts:
        """Return the entries of a checkpoint that it loads."""
        return Parts({"model": self.model})

    def restore(self, fn: str) -> dict[str, Any]:
        """Load a checkpoint, and return its entries.

        Raises:
            CheckpointError: the file cannot be used; the player is unchanged then.
        """
        parts = self._parts()
        state = Fitting(f"checkpoint={fn}").parts(load_checkpoint(fn), parts)
        for key, module in parts.modules.items():
            if key in state:
                module.load_state_dict(state[key])
        if self.env is not None and state.get("env_state") is not None:
            self.env.set_env_state(state["env_state"])
        return state


def _kind(value: Any) -> str:
    """Return shape and type of a tensor in words, of another value its type."""
    if not isinstance(value, Tensor):
        return f"a {type(value).__name__}"
    shape = "x".join(str(size) for size in value.shape) or "one number"
    return f"{shape} {str(value.dtype).removeprefix('torch.')}"


def _listed(sizes: Any) -> str:
    return " and ".join(str(size) for size in sizes)
