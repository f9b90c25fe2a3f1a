"""Players of AMP policies; they also measure the style reward."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

from torch import Tensor

from isaacgymenvs_lite.env_interface import AMPObsEnv, require
from isaacgymenvs_lite.learning.amp_config import AMPParams, read_agent_params
from isaacgymenvs_lite.learning.amp_continuous import AMPAgent, LeastSquaresAMPAgent
from isaacgymenvs_lite.learning.common_player import CommonPlayer
from isaacgymenvs_lite.learning.modules.discriminator import (
    AMPObsShape,
    StyleDiscriminator,
    StyleRewards,
    disc_obs_size,
)
from isaacgymenvs_lite.learning.published_names import ReadOnly
from isaacgymenvs_lite.learning.restoring import Parts

log = logging.getLogger(__name__)


class AMPPlayerContinuous(StyleRewards, CommonPlayer):
    """The player of `amp_continuous` and `amp`.

    If `print_disc_prediction` in `params.config` is True, the discriminator's logit and reward of
    environment 0 are logged at every step.
    """

    _normalize_amp_input = ReadOnly("_amp.normalize_amp_input")
    _disc_reward_scale = ReadOnly("_amp.disc_reward_scale")
    _amp_input_mean_std = ReadOnly("discriminator.normalizer", "restore, from a checkpoint")

    default_disc_reward = AMPAgent.default_disc_reward
    params_class: ClassVar[type[AMPParams]] = AMPParams

    def __init__(self, params: dict[str, Any]) -> None:
        self._print_disc_prediction = bool(params["config"].get("print_disc_prediction", False))
        self._amp = read_agent_params(params["config"], self.params_class)
        super().__init__(params)

    def _build_net(self, config: dict[str, Any]) -> None:
        """Build the model and the discriminator."""
        super()._build_net(config)
        self.discriminator = StyleDiscriminator(
            self.model.a2c_network,
            self._amp_obs_size,
            self._amp,
            self.default_disc_reward,
            self.device,
        )

    def _build_net_config(self) -> dict[str, Any]:
        task = require(self.env, AMPObsEnv, "an AMP policy")
        self._amp_obs_size = disc_obs_size(AMPObsShape.from_task(task), self._amp)
        return {**super()._build_net_config(), "amp_input_shape": (self._amp_obs_size,)}

    def _parts(self) -> Parts:
        parts = super()._parts()
        own = self.discriminator.checkpoint_modules
        return replace(parts, modules={**parts.modules, **own})

    def style_reward_function(self) -> Callable[[Tensor], Tensor] | None:
        """Return a function from AMP observations (N, F) to style rewards (N, 1)."""

        def reward(amp_obs: Tensor) -> Tensor:
            rewards = self._calc_disc_rewards(amp_obs.to(self.device), *self._disc_latents())
            return rewards.to(amp_obs.device)

        return reward

    def _disc_latents(self) -> tuple[Tensor, ...]:
        """Return latents (N, Z) if the discriminator needs them in addition to AMP observations."""
        return ()

    def _post_step(self, info: dict[str, Any]) -> None:
        super()._post_step(info)
        if self._print_disc_prediction:
            self._amp_debug(info)

    def _amp_debug(self, info: dict[str, Any]) -> None:
        """Log the discriminator's logit and the style reward of environment 0."""
        amp_obs = info["amp_obs"][:1].to(self.device)
        logit = self._eval_disc(amp_obs, *(rows[:1] for rows in self._disc_latents()))
        rewards = self._calc_amp_rewards(amp_obs, *(rows[:1] for rows in self._reward_latents()))
        parts = [f"{name} {value.item():.4f}" for name, value in rewards.items()]
        log.info("disc_pred: %.4f  %s", logit.item(), "  ".join(parts))


class LeastSquaresAMPPlayer(AMPPlayerContinuous):
    """The player of `amp_agent`."""

    default_disc_reward = LeastSquaresAMPAgent.default_disc_reward
