"""The frozen low-level controller of a hierarchy: it maps observations and latents to actions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import torch
import torch.nn.functional as F
from rl_games.algos_torch import model_builder
from rl_games.algos_torch.players import rescale_actions
from torch import Tensor

from isaacgymenvs_lite.checkpoints import files as checkpoints
from isaacgymenvs_lite.checkpoints.llc_reference import SHIPPED_LLC, make_reference
from isaacgymenvs_lite.checkpoints.packed import with_packed_settings
from isaacgymenvs_lite.config.rl_games_settings import check_network, scale_units
from isaacgymenvs_lite.config.train_files import read_train_file
from isaacgymenvs_lite.env_interface import HierarchyEnv
from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.learning.amp_config import GenAMPParams, read_agent_params
from isaacgymenvs_lite.learning.cpu.parallel import parallelize
from isaacgymenvs_lite.learning.gen_amp import GenAMPAgent
from isaacgymenvs_lite.learning.gen_amp_network_builder import GenAMPBuilder
from isaacgymenvs_lite.learning.modules.discriminator import (
    AMPObsShape,
    StyleDiscriminator,
    disc_obs_size,
)
from isaacgymenvs_lite.learning.modules.running_mean_std import replace_normalizers
from isaacgymenvs_lite.learning.modules.skill_encoder import SkillEncoder
from isaacgymenvs_lite.learning.restoring import Fitting, Parts
from isaacgymenvs_lite.paths import shipped_policies, user_path
from isaacgymenvs_lite.typed_command import package_command

_RL_DEVICES = ("cpu", "cuda:0")


@dataclass(frozen=True)
class LowLevelSizes:
    """Sizes of observations and actions that a low-level controller has in a task.

    Attributes:
        num_obs: dimension of the task's observation, including the task features.
        num_task_obs: dimension of the task features, which are the last entries of an observation.
    """

    num_obs: int
    num_task_obs: int
    amp_obs: AMPObsShape
    action_space: gymnasium.spaces.Box

    @classmethod
    def from_task(cls, env: HierarchyEnv) -> LowLevelSizes:
        """Return the sizes for a task."""
        return cls(
            num_obs=env.observation_space.shape[0],
            num_task_obs=env.get_task_obs_size(),
            amp_obs=AMPObsShape.from_task(env),
            action_space=env.action_space,
        )


class LowLevelPolicy:
    """A trained GenAMP policy in evaluation mode, which is never trained here.

    Args:
        llc_config: train file of the policy. A packed policy's own settings replace the file's.
        llc_checkpoint: checkpoint of the policy, or the name of a shipped policy.
        sizes: sizes of observations and actions in the task.
        device: device of the networks and of all returned tensors.
        precision: value that is used if the train file has `mixed_precision: auto`.

    Attributes:
        discriminator: the controller's discriminator, which computes style rewards.
        encoder: infers latents from motion.
        reference: entry of a high-level checkpoint that identifies this controller.

    Raises:
        ConfigError: the train file does not describe a GenAMP policy.
        CheckpointError: the checkpoint does not fit the file or the task.
    """

    def __init__(
        self,
        llc_config: str,
        llc_checkpoint: str,
        sizes: LowLevelSizes,
        device: str | torch.device,
        precision: Any = "auto",
    ) -> None:
        file = find_llc_checkpoint(llc_checkpoint)
        state = checkpoints.load_checkpoint(file)
        train_params = _train_params(llc_config, state)
        builder = _model_builder(train_params, llc_config)
        self.params = read_agent_params(train_params["config"], GenAMPParams)
        self.latent_dim = self.params.latent_dim
        self.num_task_obs = sizes.num_task_obs
        self.num_character_obs = sizes.num_obs - sizes.num_task_obs
        amp_obs_size = disc_obs_size(sizes.amp_obs, self.params)
        self._device = torch.device(device)
        self.model = builder.build(
            {
                "actions_num": sizes.action_space.shape[0],
                "input_shape": (self.num_character_obs,),
                "num_seqs": 1,
                "value_size": 1,
                "normalize_value": train_params["config"].get("normalize_value", False),
                "normalize_input": train_params["config"]["normalize_input"],
                "amp_input_shape": (amp_obs_size,),
                "amp_latent_shape": (self.latent_dim,),
            }
        )
        replace_normalizers(self.model)
        self.model.to(self._device).eval().requires_grad_(False)
        trained_in = train_params["config"].get("mixed_precision", False)
        parallelize(self.model, self._device, precision if trained_in == "auto" else trained_in)
        self.discriminator = StyleDiscriminator(
            self.model.a2c_network,
            amp_obs_size,
            self.params,
            GenAMPAgent.default_disc_reward,
            self._device,
        )
        self.encoder = SkillEncoder(
            self.model.a2c_network, self.discriminator.normalize, self.params
        )
        self._load(state, llc_checkpoint, llc_config)
        self.reference = make_reference(llc_checkpoint, self.model.state_dict())
        self._low = torch.from_numpy(sizes.action_space.low.copy()).to(self._device)
        self._high = torch.from_numpy(sizes.action_space.high.copy()).to(self._device)

    def _load(self, state: dict[str, Any], checkpoint: str, llc_config: str) -> None:
        """Load a checkpoint; raise CheckpointError if a size does not fit the task."""
        own = self.model.state_dict()
        for key, what, source in (
            ("a2c_network.critic_mlp._mlp.0.weight", "observation and latent", "the task has"),
            ("a2c_network.mu.bias", "actions", "the task has"),
            ("a2c_network._disc_mlp.0.weight", "AMP observation", "the task has"),
            ("a2c_network._enc.bias", "latent", f"{llc_config} says"),
        ):
            if key not in state["model"]:
                raise CheckpointError(
                    f"llc_checkpoint={checkpoint}: no low-level controller (it has no {key});"
                    " expected a checkpoint of algo: name: gen_amp"
                )
            there, here = (int((0, *each[key].shape)[-1]) for each in (state["model"], own))
            if there != here:
                raise CheckpointError(
                    f"llc_checkpoint={checkpoint}: expects {there} dimensions of {what}, {source}"
                    f" {here}; choose the task and humanoid of its training, or train a low-level"
                    " controller for this task"
                )
        modules: dict[str, Any] = {"model": self.model, **self.discriminator.checkpoint_modules}
        hint = f"does not fit llc_config={llc_config}, expected the train file it was trained with"
        fitted = Fitting(f"llc_checkpoint={checkpoint}", hint).parts(state, Parts(modules))
        for key, module in modules.items():
            module.load_state_dict(fitted[key])

    def extract_obs(self, obs: Tensor) -> Tensor:
        """Remove the task features from observations (n, O)."""
        return obs[:, : self.num_character_obs]

    def actions(self, obs: Tensor, latents: Tensor) -> Tensor:
        """Return the task's actions (n, A) for raw observations (n, O) and latents (n, Z)."""
        with torch.no_grad():
            normalized = self.model.norm_obs(self.extract_obs(obs))
            mu, _ = self.model.a2c_network.eval_actor(normalized, amp_latents=latents)
        return rescale_actions(self._low, self._high, mu.clamp(-1.0, 1.0))

    def policy_under(
        self,
        choose: Callable[[Tensor], Tensor],
        steps: int,
        act: Callable[[Tensor, Tensor], Tensor] | None = None,
    ) -> Callable[[Tensor], Tensor]:
        """Return a function from raw observations (n, O) to actions (n, A), called once per step.

        Every `steps` control steps, the function calls `choose`, which maps observations to new
        latents (n, Z). `act` maps observations and latents to actions; its default is the method
        `actions`.
        """
        chosen, step, actions_of = torch.empty(0), 0, act or self.actions

        def policy(obs: Tensor) -> Tensor:
            nonlocal chosen, step
            if step % steps == 0:
                chosen = choose(obs)
            step += 1
            return actions_of(obs, chosen)

        return policy

    def style_reward(self, amp_obs: Tensor, latents: Tensor | None = None) -> Tensor:
        """Return style rewards (n, 1) of raw AMP observations (n, F).

        A conditional discriminator also receives `latents` (n, Z). If `latents` is None, the
        encoder infers the latents from the AMP observations.
        """
        if not self.model.a2c_network.disc_is_conditional:
            return self.discriminator.reward(amp_obs)
        if latents is None:
            latents = self.encoder.read(amp_obs)
        return self.discriminator.reward(amp_obs, latents)


def _model_builder(train_params: dict[str, Any], llc_config: str) -> Any:
    """Return the model that a train file names, before its network is built."""
    network, registered = train_params.get("network") or {}, model_builder.ModelBuilder()
    try:
        builder = registered.network_builder.network_factory.create(network.get("name"))
    except ValueError:
        builder = None
    if not isinstance(builder, GenAMPBuilder) or "latent_dim" not in train_params["config"]:
        raise ConfigError(
            f"llc_config={llc_config}: no skill policy (network: name: {network.get('name')});"
            " expected the train file of a low-level controller, with network: name: gen_amp, ase"
            " or a registered GenAMPBuilder, and config: latent_dim"
        )
    check_network(network, f"llc_config={llc_config}: network")
    builder.load(network)
    model = (train_params.get("model") or {}).get("name", "gen_amp")
    return registered.model_factory.create(model, network=builder)


def find_llc_checkpoint(llc_checkpoint: str) -> Path:
    """Return a low-level controller's checkpoint, given its path or a shipped policy's name."""
    shipped = shipped_policies()
    path = shipped.get(llc_checkpoint) or user_path(llc_checkpoint)
    if llc_checkpoint and path.is_file():
        return path
    what = f"={llc_checkpoint}: no file {path.absolute()}" if llc_checkpoint else " is not given"
    ships = f", or llc_checkpoint={SHIPPED_LLC}, which ships" if SHIPPED_LLC in shipped else ""
    raise CheckpointError(
        f"train.params.config.llc_checkpoint{what}; expected a low-level controller: the path of a"
        f" checkpoint that {package_command('train', 'task=HumanoidASE')} has written to"
        f" runs/HumanoidASE_<time>/nn{ships}"
    )


def _train_params(llc_config: str, state: dict[str, Any]) -> dict[str, Any]:
    """Return the section `params` of the training that wrote a checkpoint.

    A train file may have different networks for CPU and GPU. The variant whose layers are in the
    checkpoint is returned.
    """
    variants = []
    for device in _RL_DEVICES:
        file = read_train_file(llc_config, rl_device=device)["params"]
        variants.append(with_packed_settings(file, state))
        scale_units(variants[-1].get("network") or {})
    first = state["model"].get("a2c_network.critic_mlp._mlp.0.weight")
    for params in variants:
        units = ((params.get("network") or {}).get("mlp") or {}).get("units")
        if units and first is not None and first.ndim == 2 and units[0] == first.shape[0]:
            return params
    return variants[0]


def latents_of_actions(actions: Tensor) -> Tensor:
    """Scale high-level actions (n, Z) to unit vectors."""
    return F.normalize(actions, dim=-1)
