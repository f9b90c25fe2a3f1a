# pyright: reportMissingImports=false
"""Values in Isaac Lab's agent files for Stable-Baselines3, as arguments of its classes.

Older files write `policy_kwargs` as a line of Python, `"dict(activation_fn=nn.ELU, ...)"`, which
Isaac Lab evaluates. Here it is parsed and never run; it may hold numbers, texts, lists,
dictionaries and names of activations.
"""

from __future__ import annotations

import ast
import logging
from collections.abc import Mapping
from typing import Any

import torch
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from isaacgymenvs_lite.errors import ConfigError

log = logging.getLogger(__name__)

SCHEDULED = ("learning_rate", "clip_range", "clip_range_vf")
"""Arguments of PPO that may be "lin_3e-4": linearly to zero, as in Stable-Baselines3's zoo."""

_LINEAR = "lin_"
_MOST_TEXT = 2000
_NN = ("nn.", "torch.nn.", "th.nn.")


def process_sb3_cfg(cfg: Mapping[str, Any], num_envs: int) -> dict[str, Any]:
    """Return an agent file of Isaac Lab as arguments of Stable-Baselines3's PPO.

    `n_minibatches` becomes `batch_size`, `lin_3e-4` a schedule, `policy_kwargs` and the activation
    in it objects. A GPU in `device` is left out where torch sees none. All other keys stay, also
    those that are no arguments of PPO: `n_timesteps`, `policy`, `normalize_input`.

    Args:
        cfg: content of the file.
        num_envs: of the training.

    Raises:
        ConfigError: a value that cannot be used.
    """
    made = dict(cfg)
    for key in SCHEDULED:
        made |= {key: read_schedule(made[key], f"agent.{key}")} if key in made else {}
    if "n_minibatches" in made:
        made["batch_size"] = made.get("n_steps", 2048) * num_envs // made.pop("n_minibatches")
    if "policy_kwargs" in made:
        policy = made["policy_kwargs"] = read_policy_kwargs(made["policy_kwargs"])
        if name := policy.get("activation_fn"):
            policy["activation_fn"] = _activation(name)
    if str(made.get("device", "")).startswith("cuda") and not torch.cuda.is_available():
        log.info("agent.device=%s: torch sees no GPU; the CPU is used", made.pop("device"))
    return made


def read_schedule(value: Any, where: str) -> Any:
    """Return a falling schedule for "lin_3e-4"; other values unchanged.

    Raises:
        ConfigError: no number after lin_.
    """
    if not isinstance(value, str) or not value.startswith(_LINEAR):
        return value
    try:
        return LinearSchedule(float(value.removeprefix(_LINEAR)), 0.0, 1.0)
    except ValueError as error:
        message = f"{where}: got {value!r}, expected a number, or lin_ and a number"
        raise ConfigError(message) from error


def read_policy_kwargs(arguments: Any) -> dict[str, Any]:
    """Return `policy_kwargs`, with the activation by its class's name in torch.nn: "ELU".

    Raises:
        ConfigError: no mapping, or an activation that is no name.
    """
    if isinstance(arguments, str):
        arguments = _parsed(arguments)
    if not isinstance(arguments, Mapping):
        raise ConfigError(f"agent.policy_kwargs: got {arguments!r}, expected a mapping")
    policy = dict(arguments)
    function = policy.get("activation_fn")
    if function is None:
        return policy
    prefix = next((p for p in _NN if str(function).startswith(p)), None)
    if not isinstance(function, str) or prefix is None:
        raise ConfigError(
            f"agent.policy_kwargs.activation_fn: got {function!r}, expected a name such as nn.ELU"
        )
    return {**policy, "activation_fn": function.removeprefix(prefix)}


def _activation(name: str) -> type[nn.Module]:
    if name not in nn.modules.activation.__all__:
        raise ConfigError(
            f"agent.policy_kwargs.activation_fn: torch.nn has no activation {name}; expected a name"
            " such as nn.ELU"
        )
    return getattr(nn, name)


def _parsed(text: str) -> Any:
    """Return the value of a line of Python, without running it.

    Raises:
        ConfigError: it holds more than numbers, texts, lists, dictionaries and activations.
    """
    refusal = (
        f"agent.policy_kwargs={text[:60]!r}: expected a mapping, or dict(...) of numbers, lists and"
        " activations such as nn.ELU; nothing of it is run"
    )
    if len(text) > _MOST_TEXT:
        raise ConfigError(refusal)
    try:
        return _value(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ConfigError(refusal) from error


def _value(node: ast.expr) -> Any:
    match node:
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=words):
            if any(word.arg is None for word in words):
                raise ValueError("**")
            return {str(word.arg): _value(word.value) for word in words}
        case ast.Dict(keys=keys, values=values):
            if not all(
                isinstance(key, ast.Constant) and isinstance(key.value, str) for key in keys
            ):
                raise ValueError("a key that is not text")
            pairs = zip(keys, values, strict=True)
            return {key.value: _value(value) for key, value in pairs}  # type: ignore[union-attr]
        case ast.List(elts=entries) | ast.Tuple(elts=entries):
            return [_value(entry) for entry in entries]
        case ast.Attribute() if ast.unparse(node).startswith(_NN):
            return ast.unparse(node)
        case _:
            return ast.literal_eval(node)
