"""Players of AMP policies: they know the style reward."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_config import AMPParams, read_amp_params
from isaacgymenvs_lite.learning.amp_continuous import AMPAgent, LeastSquaresAMPAgent
from isaacgymenvs_lite.learning.common_player import CommonPlayer
from isaacgymenvs_lite.learning.discriminator import AMPObsShape, StyleDiscriminator, judged_size
from isaacgymenvs_lite.learning.restoring import Parts

log = logging.getLogger(__name__)


class AMPPlayerContinuous(CommonPlayer):
    """The player of `amp_continuous` and `amp`.

    Keys beside CommonPlayer's: `print_disc_prediction` in `params.config` logs the discriminator's
    logit and reward of environment 0 at every step.
    """

    default_disc_reward = AMPAgent.default_disc_reward
    params_class: ClassVar[type[AMPParams]] = AMPParams

    def __init__(self, params: dict[str, Any]) -> None:
        self._print_disc_prediction = bool(params["config"].get("print_disc_prediction", False))
        self._amp = read_amp_params(params["config"], self.params_class)
        super().__init__(params)
        self.discriminator = StyleDiscriminator(
            self.model.a2c_network,
            judged_size(AMPObsShape.of_task(self.env), self._amp),
            self._amp,
            self.default_disc_reward,
            self.device,
        )

    def _build_net_config(self) -> dict[str, Any]:
        if not hasattr(self.env, "amp_observation_space"):
            raise ConfigError(
                "an AMP policy needs a task with reference motions (amp_observation_space), such"
                " as task=HumanoidAMP"
            )
        return {
            **super()._build_net_config(),
            "amp_input_shape": (judged_size(AMPObsShape.of_task(self.env), self._amp),),
        }

    def _parts(self) -> Parts:
        parts = super()._parts()
        if self.discriminator.normalizer is None:
            return parts
        own = {"amp_input_mean_std": self.discriminator.normalizer}
        return replace(parts, modules={**parts.modules, **own})

    def _style_reward_function(self) -> Callable[[Tensor], Tensor] | None:
        def reward(amp_obs: Tensor) -> Tensor:
            rewards = self.discriminator.reward(amp_obs.to(self.device), *self._disc_latents())
            return rewards.to(amp_obs.device)

        return reward

    def _disc_latents(self) -> tuple[Tensor, ...]:
        """Return what the discriminator hears beside the AMP observations (N, F) of now."""
        return ()

    def _on_step(self, dones: Tensor, infos: dict[str, Any]) -> None:
        super()._on_step(dones, infos)
        if self._print_disc_prediction:
            first = (infos["amp_obs"].to(self.device), *self._disc_latents())
            logit = self.discriminator.logits(*(rows[:1] for rows in first))
            reward = self.discriminator.reward_from_logits(logit)
            log.info("disc_pred: %.4f  style reward: %.4f", logit.item(), reward.item())


class LeastSquaresAMPPlayer(AMPPlayerContinuous):
    """The player of `amp_agent`."""

    default_disc_reward = LeastSquaresAMPAgent.default_disc_reward
