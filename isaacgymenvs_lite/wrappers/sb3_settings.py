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

# Arguments of PPO that may be "lin_3e-4": linearly to zero, as in Stable-Baselines3's zoo.
_SCHEDULED = ("learning_rate", "clip_range", "clip_range_vf")
_LINEAR = "lin_"
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
    made = read_schedules(cfg, "agent")
    if "n_minibatches" in made:
        made["batch_size"] = made.get("n_steps", 2048) * num_envs // made.pop("n_minibatches")
    if "policy_kwargs" in made:
        made["policy_kwargs"] = _read_policy_kwargs(made["policy_kwargs"] or {})
    if str(made.get("device", "")).startswith("cuda") and not torch.cuda.is_available():
        log.info("agent.device=%s: torch sees no GPU; the CPU is used", made.pop("device"))
    return made


def read_schedules(section: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return arguments of PPO with falling schedules for "lin_3e-4"; other values unchanged.

    Raises:
        ConfigError: no number after lin_.
    """
    made = dict(section)
    for key in _SCHEDULED:
        value = made.get(key)
        if isinstance(value, str) and value.startswith(_LINEAR):
            try:
                made[key] = LinearSchedule(float(value.removeprefix(_LINEAR)), 0.0, 1.0)
            except ValueError as error:
                message = f"{where}.{key}: got {value!r}, expected a number, or lin_ and a number"
                raise ConfigError(message) from error
    return made


def _read_policy_kwargs(arguments: Any) -> dict[str, Any]:
    """Return `policy_kwargs` with the activation as a class of torch.nn.

    Raises:
        ConfigError: no mapping, or an activation that is no name.
    """
    if isinstance(arguments, str):
        try:
            arguments = _value(ast.parse(arguments.strip(), mode="eval").body)
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise ConfigError(
                f"agent.policy_kwargs={arguments[:60]!r}: expected a mapping, or dict(...) of"
                " numbers, lists and activations such as nn.ELU; nothing of it is run"
            ) from error
    if not isinstance(arguments, Mapping):
        raise ConfigError(f"agent.policy_kwargs: got {arguments!r}, expected a mapping")
    policy = dict(arguments)
    if policy.get("activation_fn") is not None:
        given = str(policy["activation_fn"])
        prefix = next((prefix for prefix in _NN if given.startswith(prefix)), None)
        name = given.removeprefix(prefix or given)
        if name not in nn.modules.activation.__all__:
            raise ConfigError(
                f"agent.policy_kwargs.activation_fn: got {given!r}, expected the name of an"
                " activation, such as nn.ELU"
            )
        policy["activation_fn"] = getattr(nn, name)
    return policy


def _value(node: ast.expr) -> Any:
    match node:
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=words):
            if any(word.arg is None for word in words):
                raise ValueError("**")
            return {str(word.arg): _value(word.value) for word in words}
        case ast.Dict(keys=keys, values=values):
            names = [ast.literal_eval(key) if key is not None else None for key in keys]
            if not all(isinstance(name, str) for name in names):
                raise ValueError("a key that is not text")
            return dict(zip(names, map(_value, values), strict=True))
        case ast.List(elts=entries) | ast.Tuple(elts=entries):
            return [_value(entry) for entry in entries]
        case ast.Attribute() if ast.unparse(node).startswith(_NN):
            return ast.unparse(node)
        case _:
            return ast.literal_eval(node)
