"""CommonPlayer: plays a policy in an environment that resets when it is asked to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import torch
from rl_games.algos_torch.players import PpoPlayerContinuous, rescale_actions
from rl_games.common.player import BasePlayer
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.evaluation.evaluate import (
    EvaluationResult,
    episodes_to_play,
    evaluate_and_log,
    play_on,
)
from isaacgymenvs_lite.evaluation.motion_recorder import MotionRecorder
from isaacgymenvs_lite.learning.published_names import ExplainedNames
from isaacgymenvs_lite.learning.restoring import RestoringPlayer


class CommonPlayer(ExplainedNames, RestoringPlayer, PpoPlayerContinuous):
    """rl_games' PPO player with the play loop of `evaluation`.

    Keys of `train.params.config.player`: `games_num` (default: 32, at least one per environment),
    `deterministic` (default True: mean actions), `record` (a .npz file that the first episode of
    environment 0 is written to as a motion clip).

    Attributes:
        result: what `run` measured; None before.
        is_latent_conditioned: whether its policies act under skill latents.

    Raises:
        ConfigError: a latent for a policy that hears none.
        OverrideError: a subclass overrides what is not called here; at its definition.
    """

    is_latent_conditioned: ClassVar[bool] = False

    def __init__(self, params: dict[str, Any]) -> None:
        # Not PpoPlayerContinuous' constructor: it builds the model before an agent's own inputs
        # are known.
        BasePlayer.__init__(self, params)
        self.result: EvaluationResult | None = None
        latent = self.player_config.get("latent")
        if latent and not self.is_latent_conditioned:
            raise ConfigError(
                f"latent={latent}: this policy hears no skill latents (algorithms gen_amp and ase"
                " make such); remove it"
            )
        # rl_games' default means "until the window is closed"; without a window a play ends.
        self.games_num = episodes_to_play(self.player_config)
        self.has_batch_dimension = True
        self.network = self.config["network"]
        self.normalize_input = self.config["normalize_input"]
        self.normalize_value = self.config.get("normalize_value", False)
        self._setup_action_space()
        self._build_net(self._build_net_config())
        path = self.player_config.get("record")
        self._recorder = MotionRecorder(self.env, path) if path else None

    def _setup_action_space(self) -> None:
        """Set number and limits of the policy's actions; the networks do not exist yet."""
        self.actions_num = self.action_space.shape[0]
        self.actions_low = torch.from_numpy(self.action_space.low.copy()).to(self.device)
        self.actions_high = torch.from_numpy(self.action_space.high.copy()).to(self.device)

    def _build_net(self, config: dict[str, Any]) -> None:
        """Build the model, of the arguments that `_build_net_config` returned."""
        self.model = self.network.build(config).to(self.device).eval()
        self.is_rnn = False

    def _build_net_config(self) -> dict[str, Any]:
        """Return the arguments that the model is built with."""
        return {
            "actions_num": self.actions_num,
            "input_shape": self.obs_shape,
            "num_seqs": self.num_agents,
            "value_size": self.value_size,
            "normalize_value": self.normalize_value,
            "normalize_input": self.normalize_input,
        }

    def run(self) -> None:
        """Play `games_num` episodes, log what was reached, and play on for whoever looks on."""
        self._measure()
        play_on(self.env, self.act)

    def _measure(self) -> None:
        """Play `games_num` episodes and log reward, episode length and imitation."""
        self.result = evaluate_and_log(
            self.env,
            self.act,
            self.games_num,
            style_reward=self._style_reward_function(),
            on_step=self._on_step,
        )

    def obs_to_torch(self, obs: Any) -> Any:
        """Return {"obs": (N, O)}, what `get_action` takes."""
        return {"obs": super().obs_to_torch(obs)}

    def get_action(self, obs_dict: Any, is_deterministic: bool = False) -> Tensor:
        """Return actions (N, A), within the action space's limits.

        Args:
            obs_dict: raw observations, {"obs": (N, O)} or the tensor itself.
            is_deterministic: mean actions.
        """
        obs = obs_dict["obs"] if isinstance(obs_dict, dict) else obs_dict
        with torch.no_grad():
            result = self.model(
                {
                    "is_train": False,
                    "prev_actions": None,
                    "obs": self._preproc_obs(obs),
                    "rnn_states": None,
                    **self._policy_inputs(),
                }
            )
        actions = result["mus"] if is_deterministic else result["actions"]
        if not self.clip_actions:
            return actions
        return rescale_actions(self.actions_low, self.actions_high, actions.clamp(-1.0, 1.0))

    def _policy_inputs(self) -> dict[str, Tensor]:
        """Return inputs of the policy beside the observation, (N, ...); once for each step."""
        return {}

    def act(self, obs: dict[str, Tensor]) -> Tensor:
        """Return the task's actions (N, A) for what the task observes."""
        return self.get_action(self.obs_to_torch(obs), self.is_deterministic)

    def _style_reward_function(self) -> Callable[[Tensor], Tensor] | None:
        """Return a function from AMP observations to rewards, None without a discriminator."""
        return None

    def _on_step(self, dones: Tensor, infos: dict[str, Any]) -> None:
        """Called with the dones (N,) and infos of each step, before resets."""
        if self._recorder is not None:
            self._recorder.step(dones)
        self._post_step(infos)

    def _post_step(self, info: dict[str, Any]) -> None:
        """Called with the infos of each step, before resets."""
