# pyright: reportMissingImports=false
"""Wraps a task as a vectorised environment of Stable-Baselines3, with numpy arrays.

Isaac Lab's `isaaclab_rl.sb3` has the same names; docs/from_isaac_lab.md has a script.
"""

from __future__ import annotations

import ast
import logging
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.scene import Image
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask, Transition
from isaacgymenvs_lite.wrappers.gymnasium_env import Bools, Floats, GymnasiumVectorEnv, as_numpy
from isaacgymenvs_lite.wrappers.isaac_lab_env import IsaacLabEnv

log = logging.getLogger(__name__)

_BATCHED = (IsaacLabEnv, GymnasiumVectorEnv)
# Wrappers of Gymnasium that do not change the results of a step.
_RECORDERS = (
    *(gymnasium.wrappers.RecordVideo, gymnasium.wrappers.vector.RecordVideo),
    *(gymnasium.wrappers.OrderEnforcing, gymnasium.wrappers.PassiveEnvChecker),
)

# PPO's arguments that may be schedules such as "lin_3e-4", which fall linearly to zero.
_SCHEDULED = ("learning_rate", "clip_range", "clip_range_vf")
_LINEAR = "lin_"
_NN = ("nn.", "torch.nn.", "th.nn.")


def _unrecorded(env: Any) -> Any:
    """Return the environment without its video recorders and Gymnasium's checks."""
    while isinstance(env, _RECORDERS):
        env = env.env
    return env


class Sb3VecEnvWrapper(VecEnv):
    """N environments of a task for Stable-Baselines3.

    `infos[i]` of an ended episode has `terminal_observation` (F,), `TimeLimit.truncated` and
    `episode` {"r": return, "l": length, "t": time in s since the start}; `VecMonitor`, which adds
    the same values, is not needed. Every `infos[i]` also has the task's infos for environment i at
    the end of the step, for example `amp_obs` (F,); `infos[i]["log"]` has the infos about all
    environments.

    Args:
        task: a task of `isaacgymenvs_lite.make`, or an environment of
            `gymnasium.make("Isaac-Cartpole-v0")` or `gymnasium.make_vec`, with or without a video
            wrapper.
        render_mode: `rgb_array` or None; ignored if `task` is an environment of Gymnasium.
        fast_variant: an argument of Isaac Lab without effect, because infos are always complete.

    Attributes:
        stepper: steps the task; its `last_step` contains the last step as tensors.

    Raises:
        WrapperError: `task` has another type, or a wrapper that changes the results of a step.
    """

    def __init__(
        self, task: Any, render_mode: str | None = None, fast_variant: bool = True
    ) -> None:
        self._env = task if isinstance(_unrecorded(task), _BATCHED) else None
        if self._env is None:
            self.stepper = AutoresetTask(task, type(self).__name__, render_mode=render_mode)
        else:
            self.stepper = self._env.unwrapped.stepper
        self.task = self.stepper.task
        self._actions = torch.zeros(self.task.num_envs, self.task.num_actions)
        super().__init__(self.task.num_envs, self.task.observation_space, self.task.action_space)

    def reset(self) -> Floats:
        """Start new episodes with the seed set by `seed`; return observations (N, F)."""
        seed = self._seeds[0]
        self._reset_seeds()
        self._reset_options()
        if self._env is None:
            return as_numpy(self.stepper.reset(seed)["obs"])
        observations, _ = self._env.reset(seed=seed)
        if isinstance(self._env.unwrapped, IsaacLabEnv):
            observations = as_numpy(observations["policy"])
        return observations

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Store actions (N, A) for `step_wait`."""
        self._actions = torch.as_tensor(np.asarray(actions, dtype=np.float32))

    def step_wait(self) -> tuple[Floats, Floats, Bools, list[dict[str, Any]]]:
        """Make the step; return observations (N, F), rewards (N,), dones (N,) and N infos."""
        if self._env is None:
            self.stepper.step(self._actions)
        else:  # The step must pass through the video recorders around the environment.
            self._env.step(self._actions)
        step = self.stepper.last_step
        assert step is not None
        return (
            as_numpy(step.observations["obs"]),
            as_numpy(step.rewards),
            as_numpy(step.ended),
            self._infos(step),
        )

    def _infos(self, step: Transition) -> list[dict[str, Any]]:
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for name, rows in step.per_env.items():
            for info, row in zip(infos, as_numpy(rows), strict=True):
                info[name] = row
        if step.scalars:
            for info in infos:
                info["log"] = step.scalars
        if step.final_observations is None:
            return infos
        episodes = step.episodes
        time_s = round(episodes.time_s, 6)
        last = as_numpy(step.final_observations["obs"])
        truncated = step.truncated.tolist()
        values = (episodes.env_ids.tolist(), episodes.returns.tolist(), episodes.lengths.tolist())
        for env_id, episode_return, length in zip(*values, strict=True):
            infos[env_id] |= {
                "terminal_observation": last[env_id],
                "TimeLimit.truncated": truncated[env_id],
                "episode": {"r": episode_return, "l": length, "t": time_s},
            }
        return infos

    def close(self) -> None:
        """Release the renderer and the simulation."""
        (self.stepper if self._env is None else self._env).close()

    def get_images(self) -> Sequence[Image]:
        """Return a picture of each environment."""
        return self.stepper.draw()

    # --- Stable-Baselines3's calls for single environments, which all belong to one task ---------

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return a list with the same attribute of the task for each environment."""
        owner = self.stepper if attr_name == "render_mode" else self.task
        value = getattr(owner, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the task; `indices` must include all environments."""
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise ConfigError(
                f"set_attr('{attr_name}', indices={indices}): the environments are one task;"
                " leave indices out"
            )
        setattr(self.task, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the task once; return a list with the result for each environment."""
        result = getattr(self.task, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return True for `Monitor`, because `infos` has the returns and lengths of episodes."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]


def process_sb3_cfg(cfg: Mapping[str, Any], num_envs: int) -> dict[str, Any]:
    """Convert an agent file of Isaac Lab to arguments of Stable-Baselines3's PPO.

    `n_minibatches` becomes `batch_size`, `lin_3e-4` becomes a schedule, and the activation in
    `policy_kwargs` becomes a class. `device` is removed if it names a GPU that torch does not see.
    All other keys stay, even `n_timesteps`, `policy` and `normalize_input`, which are not arguments
    of PPO.

    In older files `policy_kwargs` is Python code, `"dict(activation_fn=nn.ELU, ...)"`, which Isaac
    Lab evaluates. This function parses the code but never runs it.

    Raises:
        ConfigError: a value is wrong.
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
    """Replace values such as "lin_3e-4" by schedules; return all arguments of PPO."""
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
    """Return `policy_kwargs` with the activation as a class of torch.nn."""
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
