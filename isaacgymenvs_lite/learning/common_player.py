"""Players, which measure a policy over whole episodes with the play loop of `evaluation`."""

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
from isaacgymenvs_lite.learning.published_names import PLAYER_NAMES, ExplainedNames
from isaacgymenvs_lite.learning.restoring import RestoringPlayer


class EpisodePlayer(BasePlayer):
    """Mixin of players that plays `games_num` episodes, with or without a viewer window."""

    result: EvaluationResult | None = None
    """The result of `run`; it is None before."""

    def __init__(self, params: dict[str, Any]) -> None:
        super().__init__(params)
        self.has_batch_dimension = True

    def run(self) -> None:
        """Play, log the result, and go on playing while a viewer window is open."""
        games = episodes_to_play(self.player_config)
        self.result = evaluate_and_log(self.env, self.act, games, on_step=self.on_step)
        play_on(self.env, self.act, self.on_step)

    def act(self, obs: dict[str, Tensor]) -> Tensor:
        """Return the task's actions (N, A) for the task's observations."""
        rows: Any = self.obs_to_torch(obs)
        with torch.no_grad():
            return self.get_action(rows, self.is_deterministic)

    def on_step(self, dones: Tensor, infos: dict[str, Any]) -> None:
        """Process the dones (N,) and infos of a step; this is called before resets."""


class CommonPlayer(ExplainedNames, EpisodePlayer, RestoringPlayer, PpoPlayerContinuous):
    """The player of a CommonAgent.

    Keys of `train.params.config.player`: `games_num` (number of episodes, by default 32 and at
    least one per environment), `deterministic` (whether to use mean actions, by default True), and
    `record` (a .npz file to which the first episode of environment 0 is written as a motion clip).

    Raises:
        ConfigError: a latent is given for a policy without skill latents.
        OverrideError: a subclass overrides a method that nothing calls here.
    """

    replaced: ClassVar[dict[str, str]] = PLAYER_NAMES

    is_latent_conditioned: ClassVar[bool] = False
    """Whether policies of this player receive skill latents."""

    def __init__(self, params: dict[str, Any]) -> None:
        # The constructor of PpoPlayerContinuous is not called, because it builds the model before
        # the model's inputs are known.
        BasePlayer.__init__(self, params)
        latent = self.player_config.get("latent")
        if latent and not self.is_latent_conditioned:
            raise ConfigError(
                f"latent={latent}: this policy has no skill latents (only policies of gen_amp and"
                " ase have); remove it"
            )
        # rl_games' default plays without end; this project's default is a number of episodes.
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
        """Set dimension and limits of the policy's actions, before the networks are built."""
        self.actions_num = self.action_space.shape[0]
        self.actions_low = torch.from_numpy(self.action_space.low.copy()).to(self.device)
        self.actions_high = torch.from_numpy(self.action_space.high.copy()).to(self.device)

    def _build_net(self, config: dict[str, Any]) -> None:
        """Build the model with the arguments of `_build_net_config`."""
        self.model = self.network.build(config).to(self.device).eval()
        self.is_rnn = False

    def _build_net_config(self) -> dict[str, Any]:
        """Return the arguments with which the model is built."""
        return {
            "actions_num": self.actions_num,
            "input_shape": self.obs_shape,
            "num_seqs": self.num_agents,
            "value_size": self.value_size,
            "normalize_value": self.normalize_value,
            "normalize_input": self.normalize_input,
        }

    def run(self) -> None:
        """Play `games_num` episodes, log the result, and go on while a viewer window is open."""
        self._measure()
        play_on(self.env, self.act)

    def _measure(self) -> None:
        """Play `games_num` episodes, and log reward, episode length and imitation errors."""
        self.result = evaluate_and_log(
            self.env,
            self.act,
            self.games_num,
            style_reward=self.style_reward_function(),
            on_step=self.on_step,
        )

    def obs_to_torch(self, obs: Any) -> Any:
        """Return {"obs": (N, O)} for `get_action`."""
        return {"obs": super().obs_to_torch(obs)}

    def get_action(self, obs_dict: Any, is_deterministic: bool = False) -> Tensor:
        """Return actions (N, A) within the action space for raw observations {"obs": (N, O)}."""
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
        """Return the policy's inputs besides the observation; this is called once per step."""
        return {}

    def style_reward_function(self) -> Callable[[Tensor], Tensor] | None:
        """Return a function from AMP observations (N, F) to rewards, or None if there is none."""
        return None

    def on_step(self, dones: Tensor, infos: dict[str, Any]) -> None:
        """Record the step if a clip is recorded, and call `_post_step`."""
        if self._recorder is not None:
            self._recorder.step(dones)
        self._post_step(infos)

    def _post_step(self, info: dict[str, Any]) -> None:
        """Process the infos of a step; this is called before resets."""
