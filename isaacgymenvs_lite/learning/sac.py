"""rl_games' soft actor-critic, with checkpoints that a training can go on from."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from rl_games.algos_torch.players import SACPlayer as RLGamesSACPlayer
from rl_games.algos_torch.sac_agent import SACAgent as RLGamesSACAgent
from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor, nn

from isaacgymenvs_lite.learning.cpu.precision import resolve_mixed_precision
from isaacgymenvs_lite.learning.episode_player import EpisodePlayer
from isaacgymenvs_lite.learning.restoring import Parts, RestoringPlayer
from isaacgymenvs_lite.learning.safeguards import Safeguards


class _EndOfEpoch(AlgoObserver):
    """Lets an agent act before and after an observer is given an epoch.

    Args:
        agent: whose loop has no other place for it.
        observer: of the training.
    """

    def __init__(self, agent: SACAgent, observer: AlgoObserver) -> None:
        super().__init__()
        self._agent, self._observer = agent, observer

    def after_init(self, algo: Any) -> None:
        self._observer.after_init(algo)

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        self._observer.process_infos(infos, done_indices)

    def after_clear_stats(self) -> None:
        self._observer.after_clear_stats()  # type: ignore[attr-defined]  # some have it

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        self._agent.check_epoch()
        self._observer.after_print_stats(frame, epoch_num, total_time)
        self._agent.save_before_first_episode()


class SACAgent(Safeguards, RLGamesSACAgent):
    """The agent of `algo: name: sac`: rl_games' loop, losses and replay buffer.

    Its checkpoints hold the temperature and the best reward, too, which rl_games' leave out: a
    resumed run would start again with `init_alpha`. The replay buffer is not stored (hundreds of
    MB): a resumed run acts by its policy until a batch is there, and learns then.

    `mixed_precision` on a CPU: the hidden layers compute in bfloat16, the outputs in float32, as
    values of some hundreds in bfloat16 are apart by more than what a step is paid. rl_games' own
    switch means CUDA autocast.

    Args:
        base_name: name for rl_games' bookkeeping.
        params: the section `params` of a train file, prepared by the Runner.

    Raises:
        ConfigError: mixed_precision is none of True, False, "auto".
    """

    def __init__(self, base_name: str, params: dict[str, Any]) -> None:
        config = params["config"]
        device = torch.device(config.get("device", "cuda:0"))
        on_cpu = device.type == "cpu"
        bfloat16 = resolve_mixed_precision(config.get("mixed_precision", False), device)
        config["mixed_precision"] = bfloat16 and not on_cpu
        # rl_games compiles a `forward` that SAC never calls.
        config.setdefault("torch_compile", False)
        # rl_games' other agents call it before they make their TensorBoard writer.
        name = config.get("full_experiment_name") or config["name"]
        config["features"]["observer"].before_init(base_name, config, name)
        # rl_games takes over an environment that exists in its other agents only.
        self.vec_env = config.get("vec_env")
        super().__init__(base_name, params)
        self.algo_observer = _EndOfEpoch(self, self.algo_observer)
        self._step = 0
        nothing = torch.zeros((), device=self._device)
        no_loss = nothing if self.learnable_temperature else None
        self._last_of_actor = (nothing, nothing, self.alpha.detach(), no_loss)
        if bfloat16 and on_cpu:
            network = self.model.sac_network
            for critic in (network.critic, network.critic_target):
                compute_hidden_layers_in_bfloat16(critic.Q1)
                compute_hidden_layers_in_bfloat16(critic.Q2)
            compute_hidden_layers_in_bfloat16(network.actor.trunk)

    @property
    def curr_frames(self) -> int:
        """Environment steps of an epoch, under the name that rl_games' other agents have for it."""
        return self.num_frames_per_epoch

    def get_full_state_weights(self) -> dict[str, Any]:
        """Return what goes into a checkpoint."""
        return {
            **super().get_full_state_weights(),
            "log_alpha": self.log_alpha.detach(),
            "last_mean_rewards": self.last_mean_rewards,
            "env_state": self.vec_env.get_env_state(),
        }

    def set_full_state_weights(self, weights: dict[str, Any], set_epoch: bool = True) -> None:
        """Take back what `get_full_state_weights` gave; rl_games' files lack the temperature."""
        super().set_full_state_weights(weights, set_epoch=set_epoch)
        if "log_alpha" in weights:
            with torch.no_grad():
                self.log_alpha.copy_(weights["log_alpha"])

    def _parts(self) -> Parts:
        played = _played_parts(self.model)
        names = ("actor", "critic", "log_alpha")
        return replace(
            played,
            optimizers={f"{name}_optimizer": getattr(self, f"{name}_optimizer") for name in names},
            tensors={"log_alpha": self.log_alpha.detach()},
            optional=played.optional | {"log_alpha"},
            counts=True,
        )

    def env_step(self, actions: Tensor) -> Any:
        """Step the task; what goes in and comes out must be finite.

        Raises:
            NotFiniteError: it is not; it says what and where. Nothing of it was learned.
        """
        result: Any = super().env_step(actions)
        rows = {"obses": result[0]["obs"], "actions": actions, "rewards": result[1]}
        step = self._step % self.num_steps_per_episode
        self._check_rows({name: value.unsqueeze(0) for name, value in rows.items()}, step)
        self._step += 1
        return result

    def act(self, obs: Any, action_dim: Any, sample: bool = False) -> Any:
        """As rl_games.

        Raises:
            NotFiniteError: the networks are not finite, so that no action can be drawn.
        """
        with self._acting_on(obs, self._step % self.num_steps_per_episode):
            return super().act(obs, action_dim, sample)

    def _steadier_settings(self) -> str:
        keys = ("actor_lr", "critic_lr", "alpha_lr")
        rates = {key: float(self.config[key]) for key in keys}
        return " ".join(
            f"train.params.config.{key}={rate / 2:g} (now {rate:g})" for key, rate in rates.items()
        )

    def check_epoch(self) -> None:
        """Check what was learned in an epoch.

        Raises:
            NotFiniteError: it is not finite.
        """
        self._check_learned()
        self._has_learned = True

    def update(self, step: int) -> Any:
        """Make a gradient step, once the replay buffer holds a batch.

        Returns:
            actor's loss, entropy, temperature and its loss; losses of both critics. Of a step that
            leaves the actor alone (`policy_frequency`), what the last one with the actor gave:
            rl_games gives zeros and None, which it cannot average with others.
        """
        buffer = self.replay_buffer
        if not buffer.full and buffer.idx < self.batch_size:
            nothing = torch.zeros((), device=self._device)
            return self._last_of_actor, nothing, nothing
        updates_actor = (self.update_counter + 1) % self.policy_frequency == 0
        of_actor, *of_critics = super().update(step)
        if updates_actor:
            self._last_of_actor = of_actor
        return self._last_of_actor, *of_critics


def _played_parts(model: Any) -> Parts:
    """Return what agent and player take over of a checkpoint."""
    names = ("actor", "critic", "critic_target")
    modules: dict[str, Any] = {name: getattr(model.sac_network, name) for name in names}
    if model.normalize_input:
        modules["running_mean_std"] = model.running_mean_std
    return Parts(modules, optional=frozenset({"running_mean_std"}))


def compute_hidden_layers_in_bfloat16(network: nn.Sequential) -> None:
    """Let all layers but the last compute under autocast to bfloat16, on a CPU, in place.

    Parameters, their gradients and the outputs stay float32.
    """
    *hidden, last = network

    def forward(inputs: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            for layer in hidden:
                inputs = layer(inputs)
        return last(inputs.float())

    network.forward = forward  # type: ignore[method-assign]


class SACPlayer(EpisodePlayer, RestoringPlayer, RLGamesSACPlayer):
    """The player of `sac`; see `EpisodePlayer`."""

    def _parts(self) -> Parts:
        return _played_parts(self.model)
