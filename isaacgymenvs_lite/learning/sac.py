"""rl_games' soft actor-critic (SAC), with checkpoints that include temperature and best reward."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from rl_games.algos_torch.players import SACPlayer as RLGamesSACPlayer
from rl_games.algos_torch.sac_agent import SACAgent as RLGamesSACAgent
from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor, nn

from isaacgymenvs_lite.env_interface import Env, diverged_in
from isaacgymenvs_lite.learning.common_player import EpisodePlayer
from isaacgymenvs_lite.learning.diverged import EpisodeMeters, KeptTransitions
from isaacgymenvs_lite.learning.restoring import Parts, RestoringPlayer
from isaacgymenvs_lite.learning.safeguards import Safeguards
from isaacgymenvs_lite.utils.precision import resolve_mixed_precision
from isaacgymenvs_lite.utils.state import Stateful


class _EndOfEpoch(Stateful):
    """Wraps the observer, because rl_games' loop calls only the observer after each epoch."""

    stored = ("_observer",)

    def __init__(self, agent: SACAgent, observer: AlgoObserver) -> None:
        self._agent, self._observer = agent, observer

    def __getattr__(self, name: str) -> Any:
        return getattr(vars(self)["_observer"], name)

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        agent = self._agent
        agent._check_learned()
        agent._has_learned = True
        self._observer.after_print_stats(frame, epoch_num, total_time)
        agent.save_before_first_episode()
        is_last = 0 <= agent.max_epochs <= agent.epoch_num or 0 <= agent.max_frames <= agent.frame
        if agent.game_rewards.current_size == 0 and is_last:
            agent._save_without_reward()
            raise _LastEpochError


class _LastEpochError(Exception):
    """Raised to leave rl_games' loop after the last epoch if no episode has ended."""


class _EndsAtItsLimits(RLGamesSACAgent):
    """Ends a training after its last epoch.

    rl_games' SAC checks the limits only if an episode has ended.
    """

    def train(self) -> Any:
        """Train; return the best mean reward and the last epoch."""
        try:
            return super().train()
        except _LastEpochError:
            return self.last_mean_rewards, self.epoch_num


class BFloat16HiddenLayers(nn.Sequential):
    """Layers of which all except the last compute in bfloat16 on a CPU.

    Parameters, their gradients and the outputs stay float32.
    """

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the outputs (n, ...) of rows (n, ...)."""
        *hidden, last = self
        with torch.autocast("cpu", torch.bfloat16):
            for layer in hidden:
                inputs = layer(inputs)
        return last(inputs.float())


class SACAgent(Safeguards, _EndsAtItsLimits):
    """The agent of `algo: name: sac`, with rl_games' loop, losses and replay buffer.

    Unlike rl_games' checkpoints, checkpoints of this agent hold the temperature and the best
    reward. Checkpoints do not hold the replay buffer (hundreds of MB); only `resume=` restores it.
    A training that starts from a checkpoint learns once the replay buffer holds a batch.

    Transitions of diverged simulations are not stored; see `diverged`.

    On a CPU, `mixed_precision` computes the hidden layers in bfloat16 and the outputs in float32,
    because the bfloat16 rounding error of a Q value of some hundreds exceeds the reward of a step.
    """

    stored = ("_step", "update_counter", "_last_of_actor")
    stored_buffers = ("replay_buffer",)
    frames_before_log = 1

    def __init__(self, base_name: str, params: dict[str, Any]) -> None:
        config = params["config"]
        device = torch.device(config.get("device", "cuda:0"))
        on_cpu = device.type == "cpu"
        if torch.are_deterministic_algorithms_enabled():
            torch.set_num_threads(1)  # Sums depend on the number of threads.
        bfloat16 = resolve_mixed_precision(config.get("mixed_precision", False), device)
        config["mixed_precision"] = bfloat16 and not on_cpu
        # torch_compile would compile `forward`, which SAC never calls.
        config.setdefault("torch_compile", False)
        # rl_games' other agents call `before_init` before they make their TensorBoard writer.
        name = config.get("full_experiment_name") or config["name"]
        config["features"]["observer"].before_init(base_name, config, name)
        # rl_games' SAC does not accept an existing environment; its other agents do.
        self.vec_env = config.get("vec_env")
        super().__init__(base_name, params)
        former = self.replay_buffer
        shapes = (former.obses.shape[1:], former.actions.shape[1:])
        size = (former.capacity, former.device)
        del self.replay_buffer, former  # This frees memory for the new buffer.
        self.replay_buffer = KeptTransitions(*shapes, *size)
        self._meters = EpisodeMeters(self, ("game_rewards", "game_lengths"))
        self.algo_observer = _EndOfEpoch(self, self.algo_observer)
        self._step = 0
        nothing = torch.zeros((), device=self._device)
        no_loss = nothing if self.learnable_temperature else None
        self._last_of_actor = (nothing, nothing, self.alpha.detach(), no_loss)
        if bfloat16 and on_cpu:
            network = self.model.sac_network
            for critic in (network.critic, network.critic_target):
                critic.Q1 = BFloat16HiddenLayers(*critic.Q1)
                critic.Q2 = BFloat16HiddenLayers(*critic.Q2)
            network.actor.trunk = BFloat16HiddenLayers(*network.actor.trunk)

    @property
    def curr_frames(self) -> int:
        """The environment steps of an epoch; rl_games' other agents have this attribute."""
        return self.num_frames_per_epoch

    def get_full_state_weights(self) -> dict[str, Any]:
        """Return the entries of a checkpoint."""
        return {
            **super().get_full_state_weights(),
            "log_alpha": self.log_alpha.detach(),
            "last_mean_rewards": self.last_mean_rewards,
            "env_state": self.vec_env.get_env_state(),
        }

    def set_full_state_weights(self, weights: dict[str, Any], set_epoch: bool = True) -> None:
        """Load a checkpoint; the temperature is optional, because rl_games does not store it."""
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

    @property
    def _steps_of_epoch(self) -> int:
        return self._step % self.num_steps_per_episode

    def env_step(self, actions: Tensor) -> Any:
        """Step the task, and raise NotFiniteError for actions, observations or rewards with nan."""
        result: Any = super().env_step(actions)
        *_, dones, infos = result
        diverged = diverged_in(infos, dones.device)
        self.replay_buffer.left_out = diverged
        self._meters.leave_out(diverged, dones)
        rows = {"obses": result[0]["obs"], "actions": actions, "rewards": result[1]}
        rows = {name: value.unsqueeze(0) for name, value in rows.items()}
        self._check_rows(rows, self._steps_of_epoch)
        self._step += 1
        return result

    def mean_policy(self, env: Env) -> Callable[[dict[str, Tensor]], Tensor]:
        """Return mean actions (N, A) for observations of `env`, another task of the same kind."""
        self.set_eval()
        return lambda obs: self.act(self.obs_to_tensors(obs), self.actions_num)

    def _steadier_settings(self) -> str:
        keys = ("actor_lr", "critic_lr", "alpha_lr")
        rates = {key: float(self.config[key]) for key in keys}
        return " ".join(
            f"train.params.config.{key}={rate / 2:g} (now {rate:g})" for key, rate in rates.items()
        )

    def train_epoch(self) -> Any:
        """Write a training state if it is due, or restore one, and then train an epoch."""
        self.epoch_num -= 1  # rl_games has already counted this epoch.
        self.go_on()
        self.store_if_due()
        self.epoch_num += 1
        result = super().train_epoch()
        self.algo_observer.after_steps()  # rl_games' other agents call `after_steps` too.
        return result

    def update(self, step: int) -> Any:
        """Take a gradient step once the replay buffer holds a batch; return values to log.

        Between two updates of the actor (`policy_frequency`), the actor's last values are repeated.
        In these steps, rl_games' method returns zeros and None, which rl_games cannot average.
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
    """Return the entries of a checkpoint that both agent and player load."""
    names = ("actor", "critic", "critic_target")
    modules: dict[str, Any] = {name: getattr(model.sac_network, name) for name in names}
    if model.normalize_input:
        modules["running_mean_std"] = model.running_mean_std
    return Parts(modules, optional=frozenset({"running_mean_std"}))


class SACPlayer(EpisodePlayer, RestoringPlayer, RLGamesSACPlayer):
    """The player of `sac`; see `EpisodePlayer`."""

    def _parts(self) -> Parts:
        return _played_parts(self.model)
