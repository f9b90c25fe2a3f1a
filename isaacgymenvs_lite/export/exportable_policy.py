"""Turns trained policies into functions of tensors (graphs), which other runtimes can run.

A graph computes one deterministic step of a player in float32, including the task's limits of
observations and the normalisers. The graph shares its parameters with the player.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from rl_games.algos_torch.players import rescale_actions
from torch import Tensor, nn

from isaacgymenvs_lite.learning.cpu.parallel import serial_network
from isaacgymenvs_lite.learning.gen_amp_players import GenAMPPlayerContinuous
from isaacgymenvs_lite.learning.hrl_players import HRLPlayer
from isaacgymenvs_lite.learning.modules.actor_critic_network import ActorCriticNetwork
from isaacgymenvs_lite.learning.modules.running_mean_std import replace_normalizers
from isaacgymenvs_lite.learning.sac import SACPlayer
from isaacgymenvs_lite.learning.skills.low_level_policy import LowLevelPolicy, latents_of_actions


@dataclass(frozen=True)
class TensorSpec:
    """An input or an output of a graph, which is a tensor for n samples.

    The size n of the dimension `batch_axis` is not in `shape`.
    """

    name: str
    shape: tuple[int, ...]
    batch_axis: int = 0
    dtype: torch.dtype = torch.float32

    def sample(self, n: int) -> Tensor:
        """Return a tensor of n random samples, standard normal values or fair booleans."""
        size = (*self.shape[: self.batch_axis], n, *self.shape[self.batch_axis :])
        if self.dtype == torch.bool:
            return torch.rand(size) < 0.5
        return torch.randn(size, dtype=self.dtype)


class PolicyGraph(nn.Module):
    """A function of tensors; `forward` maps the inputs to the outputs.

    Args:
        player: rl_games' player of the policy.

    Attributes:
        inputs: descriptions of the arguments. The first argument is `obs` (n, O), the task's raw
            observations.
        outputs: descriptions of the results. The first result is `action` (n, A), the argument of
            the task's `step`.
    """

    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]

    def __init__(self, player: Any) -> None:
        super().__init__()
        env = player.env
        # Exporters cannot read rl_games' normalisers, because these are TorchScript modules.
        replace_normalizers(player.model)
        self._clip_obs = env.clip_obs
        self._clip_actions = env.clip_actions
        self.inputs = (TensorSpec("obs", (env.num_obs,)),)
        self.outputs = (TensorSpec("action", (env.num_actions,)),)

    def _clamped_obs(self, obs: Tensor) -> Tensor:
        return obs.clamp(-self._clip_obs, self._clip_obs)

    def _clamped_action(self, action: Tensor) -> Tensor:
        return action.clamp(-self._clip_actions, self._clip_actions)


class _MeanActor(nn.Module):
    """Maps raw observations (n, O), and latents (n, Z) of skill policies, to mean actions (n, A).

    `clip` clamps actions to +-1 and maps them to the limits `low` and `high` (A,).
    """

    def __init__(self, model: nn.Module, low: Tensor, high: Tensor, clip: bool) -> None:
        super().__init__()
        self._model: Any = model
        self._clip = clip
        self.register_buffer("_low", low)
        self.register_buffer("_high", high)

    def forward(self, obs: Tensor, *latents: Tensor) -> Tensor:
        network, obs = serial_network(self._model.a2c_network), self._model.norm_obs(obs)
        if isinstance(network, ActorCriticNetwork):
            mu, _ = network.eval_actor(obs, *latents)
        else:
            mu = network.forward({"obs": obs, "is_train": False})[0]
        return self.within_limits(mu)

    def step(self, obs: Tensor, states: tuple[Tensor, ...]) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Return the actions and the next hidden states of a recurrent network."""
        network, obs = serial_network(self._model.a2c_network), self._model.norm_obs(obs)
        outputs = network.forward({"obs": obs, "is_train": False, "rnn_states": states})
        return self.within_limits(outputs[0]), outputs[-1]

    def within_limits(self, mu: Tensor) -> Tensor:
        if not self._clip:
            return mu
        return rescale_actions(self._low, self._high, mu.clamp(-1.0, 1.0))


def _actor_of(player: Any) -> _MeanActor:
    return _MeanActor(player.model, player.actions_low, player.actions_high, player.clip_actions)


class FeedForwardGraph(PolicyGraph):
    """The graph obs -> action of PPO and AMP."""

    def __init__(self, player: Any) -> None:
        super().__init__(player)
        self._actor = _actor_of(player)

    def forward(self, obs: Tensor) -> Tensor:
        """Return `outputs` of `inputs`."""
        return self._clamped_action(self._actor(self._clamped_obs(obs)))


class SACGraph(PolicyGraph):
    """The graph obs -> action of SAC; the action is the squashed mean."""

    def __init__(self, player: Any) -> None:
        super().__init__(player)
        self._model = player.model
        self._range = tuple(player.action_range)

    def forward(self, obs: Tensor) -> Tensor:
        """Return `outputs` of `inputs`."""
        normalized = self._model.norm_obs(self._clamped_obs(obs))
        mu, _ = self._model.sac_network.actor.trunk(normalized).chunk(2, dim=-1)
        return self._clamped_action(torch.tanh(mu).clamp(*self._range))


class SkillGraph(PolicyGraph):
    """The graph obs, latent -> action of GenAMP; the latent (n, Z) may have any length."""

    def __init__(self, player: Any) -> None:
        super().__init__(player)
        self._actor = _actor_of(player)
        self._num_policy_obs = player.num_policy_obs
        self.inputs += (TensorSpec("latent", (player.latent_dim,)),)

    def forward(self, obs: Tensor, latent: Tensor) -> Tensor:
        """Return `outputs` of `inputs`."""
        own = self._clamped_obs(obs)[:, : self._num_policy_obs]  # removes the goal
        action = self._actor(own, F.normalize(latent, dim=-1))
        return self._clamped_action(action)


class HierarchyGraph(PolicyGraph):
    """The graph obs, latent, decide -> action, latent of both policies of HRL.

    The high-level policy chooses a new latent (n, Z) where `decide` (n,) bool is True and keeps the
    given latent elsewhere. `decide` must be True in the first step of an episode and then in every
    `llc_steps`-th step.
    """

    def __init__(self, player: Any) -> None:
        super().__init__(player)
        self._high_level = _actor_of(player)
        llc: LowLevelPolicy = player.llc
        space = player.env.action_space
        low, high = (torch.from_numpy(limit.copy()) for limit in (space.low, space.high))
        self._low_level = _MeanActor(llc.model, low, high, clip=True)
        self._num_character_obs = llc.num_character_obs
        latent = TensorSpec("latent", (llc.latent_dim,))
        self.inputs += (latent, TensorSpec("decide", (), dtype=torch.bool))
        self.outputs += (TensorSpec("latent_out", latent.shape),)

    def forward(self, obs: Tensor, latent: Tensor, decide: Tensor) -> tuple[Tensor, Tensor]:
        """Return `outputs` of `inputs`."""
        obs = self._clamped_obs(obs)
        chosen = latents_of_actions(self._high_level(obs))
        latent = torch.where(decide.unsqueeze(-1), chosen, latent)
        action = self._low_level(obs[:, : self._num_character_obs], latent)
        return self._clamped_action(action), latent


class RecurrentGraph(PolicyGraph):
    """The graph obs, hidden (and cell of an LSTM) -> action, hidden (and cell) of recurrent PPO.

    The hidden and cell states (layers, n, units) are zero at the start of an episode. The graph
    does not include a separate critic's states.
    """

    def __init__(self, player: Any) -> None:
        super().__init__(player)
        self._actor = _actor_of(player)
        self._separate = bool(player.model.a2c_network.separate)
        layers, _, units = player.model.get_default_rnn_state()[0].shape
        is_lstm = player.model.a2c_network.rnn_name == "lstm"
        names = ("hidden", "cell") if is_lstm else ("hidden",)
        self.inputs += tuple(TensorSpec(name, (layers, units), 1) for name in names)
        self.outputs += tuple(TensorSpec(f"{name}_out", (layers, units), 1) for name in names)

    def forward(
        self, obs: Tensor, hidden: Tensor, cell: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """Return `outputs` of `inputs`."""
        states = (hidden,) if cell is None else (hidden, cell)
        critic = tuple(torch.zeros_like(state) for state in states) if self._separate else ()
        action, after = self._actor.step(self._clamped_obs(obs), (*states, *critic))
        return (self._clamped_action(action), *after[: len(states)])


def make_exportable_policy(player: Any) -> PolicyGraph:
    """Return the graph of a player, which must be on the CPU and have loaded its checkpoint."""
    if isinstance(player, HRLPlayer):
        kind: type[PolicyGraph] = HierarchyGraph
    elif isinstance(player, GenAMPPlayerContinuous):
        kind = SkillGraph
    elif isinstance(player, SACPlayer):
        kind = SACGraph
    elif player.is_rnn:
        kind = RecurrentGraph
    else:
        kind = FeedForwardGraph
    return kind(player).eval().requires_grad_(False)
