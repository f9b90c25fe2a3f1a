"""GenAMPAgent: AMP with a policy that receives a skill latent, such as ASE's low-level controller.

Peng et al. 2022, "ASE: Large-Scale Reusable Adversarial Skill Embeddings" (arXiv 2205.01906).
An encoder infers the latent from the motion. The policy is rewarded if the inferred latent is
similar to the policy's latent; different latents therefore become different skills.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from isaacgymenvs_lite.env_interface import (
    ClipKeepingEnv,
    ClipSkillEnv,
    CommandedSkillEnv,
    Env,
    SkillEnv,
    TrackingDemo,
    fits,
    require,
)
from isaacgymenvs_lite.errors import ConfigError, OverrideError
from isaacgymenvs_lite.learning.amp_config import AMPParams, GenAMPParams
from isaacgymenvs_lite.learning.amp_continuous import AMPAgent
from isaacgymenvs_lite.learning.common_agent import LossTerms, weighted_mean
from isaacgymenvs_lite.learning.modules.skill_encoder import SkillEncoder, SkillRewards
from isaacgymenvs_lite.learning.published_names import ReadOnly, accepts
from isaacgymenvs_lite.learning.skills.latents import (
    ClipLatents,
    EvaluationLatents,
    LatentSchedule,
    sample_similar_rows,
)
from isaacgymenvs_lite.learning.warm_start import descend

log = logging.getLogger(__name__)

# Each random latent is compared with this many AMP observations of the clips.
_NEIGHBOURS = 512
# The encoder learns commands from so many AMP observations of clips.
_COMMANDED_DEMOS = 20_000
# Inputs of a conditional discriminator: latents of AMP observations from replay buffer and clips.
_DISC_LATENTS = ("amp_obs_replay_latents", "amp_obs_demo_latents")


class GenAMPAgent(SkillRewards, AMPAgent):
    """The agent of `algo: name: gen_amp` or `ase`.

    The task is a `SkillEnv`. The task must be a `ClipSkillEnv` if latents are inferred from clips,
    if the encoder has losses on clips, or if the discriminator is conditional.

    Attributes:
        encoder: reward and loss of the encoder.
        schedule: the current latents of the environments, and when they change.
    """

    params_class: ClassVar[type[AMPParams]] = GenAMPParams
    env_contract: ClassVar[Any] = SkillEnv
    scalars: ClassVar[dict[str, str]] = {
        **AMPAgent.scalars,
        "enc_loss": "losses/enc_loss",
        "enc_alignment_loss": "losses/enc_alignment_loss",
        "enc_uniformity_loss": "losses/enc_uniformity_loss",
        "enc_command_loss": "losses/enc_command_loss",
        "amp_diversity_loss": "losses/amp_diversity_loss",
        "enc_reward_mean": "info/enc_reward_mean",
        "enc_reward_std": "info/enc_reward_std",
        "enc_grad_penalty": "info/enc_grad_penalty",
    }
    stored_episodes = ("schedule",)
    # An asymmetric critic is refused, because it does not receive the latents.
    unsupported_keys = (*AMPAgent.unsupported_keys, "central_value_config")
    _amp: GenAMPParams
    _env: SkillEnv
    _latent_dim = ReadOnly("_amp.latent_dim")
    _latent_steps_min = ReadOnly("_amp.latent_steps_min")
    _latent_steps_max = ReadOnly("_amp.latent_steps_max")
    _amp_diversity_bonus = ReadOnly("_amp.amp_diversity_bonus")
    _amp_diversity_tar = ReadOnly("_amp.amp_diversity_tar")
    _enc_coef = ReadOnly("_amp.enc_coef")
    _enc_weight_decay = ReadOnly("_amp.enc_weight_decay")
    _enc_reward_scale = ReadOnly("_amp.enc_reward_scale")
    _enc_grad_penalty = ReadOnly("_amp.enc_grad_penalty")
    _enc_reward_w = ReadOnly("_amp.enc_reward_w")
    _ase_latents = ReadOnly("schedule.latents", "the agent's schedule")
    _latent_reset_steps = ReadOnly("schedule.change_at", "the agent's schedule")

    # --- constructor -----------------------------------------------------------------------

    def _load_config_params(self, config: dict[str, Any]) -> None:
        super()._load_config_params(config)
        self._clip_latents = ClipLatents(
            self._amp.clip_latents,
            self._amp.latent_dim,
            read=lambda amp_obs: self._eval_enc(amp_obs),
            fetch=lambda n: self._amp_obs_demo_buffer.sample(n)["amp_obs"],
            sample=lambda n: self._sample_latents(n),
        )
        self.schedule = LatentSchedule(
            self.num_actors,
            self._amp.latent_dim,
            self._amp.latent_steps_min,
            self._amp.latent_steps_max,
            self.ppo_device,
            draw=lambda n: self._clip_latents.draw(n, self.ppo_device),
        )

    def _build_net_config(self) -> dict[str, Any]:
        return {**super()._build_net_config(), **self._sizes_of_inputs(self._env)}

    def _build_modules(self) -> None:
        super()._build_modules()
        self.encoder = SkillEncoder(
            self.model.a2c_network, lambda amp_obs: self._preproc_amp_obs(amp_obs), self._amp
        )
        # A subclass may have the published loss, which has three arguments and draws `new_latents`
        # itself.
        self._diversity_loss_takes_latents = accepts(self._diversity_loss, 4)
        if self._amp.disc_mismatched_demos > 0.0 and not self._disc_is_conditional:
            raise ConfigError(
                "train.params.config.disc_mismatched_demos: only a discriminator that receives"
                " latents can use mismatched demos; set this key to 0, or"
                " train.params.network.disc.conditional=True"
            )
        self._needs_pairs = self._amp.encodes_clips or self._disc_is_conditional
        fetch = type(self)._fetch_amp_obs_demo
        if self._needs_pairs and fetch is not AMPAgent._fetch_amp_obs_demo:
            raise OverrideError(
                f"{type(self).__name__}._fetch_amp_obs_demo: with enc_alignment_coef,"
                " enc_uniformity_coef or disc.conditional demonstrations come in pairs; override"
                " _fetch_amp_obs_demo_pairs"
            )
        if self._needs_pairs or self._amp.clip_latents > 0.0:
            self._clips = require(
                self._env,
                ClipSkillEnv,
                "train.params.config: clip_latents, enc_alignment_coef, enc_uniformity_coef or"
                " network.disc.conditional",
            )
        self._commanding: CommandedSkillEnv | None = None
        if self._amp.enc_command_coef > 0.0 and fits(self._env, CommandedSkillEnv):
            num_commands = self._env.num_skill_commands
            if num_commands > self._amp.latent_dim:
                raise ConfigError(
                    f"train.params.config.latent_dim={self._amp.latent_dim}: expected at least"
                    f" {num_commands}, because the first entries of latents are commands"
                )
            self._commanding = self._env if num_commands > 0 else None
        if self._amp.enc_command_coef > 0.0 and self._commanding is None:
            log.info("latents command nothing: the task does not have task.env.goal=skill")
        # The task compares an episode with its clip until the first latent of the episode changes.
        self._keeping: ClipKeepingEnv | None = None
        if self._amp.clip_latents > 0.0 and fits(self._clips, ClipKeepingEnv):
            self._keeping = self._clips

    def init_tensors(self) -> None:
        """Allocate the rollout, including latents."""
        super().init_tensors()
        self.experience_buffer.tensor_dict["amp_latents"] = torch.zeros(
            self.horizon_length, self.num_actors, self._amp.latent_dim, device=self.ppo_device
        )
        self.tensor_list += ["amp_latents"]

    def _store_demos(self) -> None:
        """Store AMP observations of clips, or pairs of them at two times of a clip."""
        if not self._needs_pairs:
            super()._store_demos()
            return
        pairs = self._fetch_amp_obs_demo_pairs(self._amp.amp_batch_size)
        at, near = self.discriminator.truncate(pairs).unbind(dim=1)
        self._amp_obs_demo_buffer.store({"amp_obs": at, "amp_obs_near": near})

    def _fetch_amp_obs_demo_pairs(self, num_samples: int) -> Tensor:
        """Return n pairs of AMP observations (n, 2, F), each from two nearby times of a clip."""
        return self._clips.fetch_amp_obs_demo_pairs(num_samples)

    def _fetch_tracking_demo(self) -> TrackingDemo | None:
        """Return poses of clips with their actions if the encoder learns from clips, else None."""
        return super()._fetch_tracking_demo() if self._amp.encodes_clips else None

    def _tracking_latents(self, demo: TrackingDemo) -> Tensor:
        """Train the encoder on the clips, and return the latents that it infers for `demo`."""
        if self.discriminator.normalizer is not None:
            self.discriminator.normalizer.count_in(demo.amp_obs)

        def loss() -> Tensor:
            terms = self._clip_encoding_losses(self._draw_encoder_rows())
            return torch.stack([weight * value for weight, value in terms.values()]).sum()

        network = self.model.a2c_network
        descend(loss, network.enc_parameters(), self._amp.warm_start_steps)
        return self._eval_enc(demo.amp_obs)

    # --- rollout ---------------------------------------------------------------------------

    def env_reset(self) -> Any:
        """Reset the environment; every episode gets a new latent."""
        obs = super().env_reset()
        self._restart_latents(torch.arange(self.num_actors, device=self.ppo_device))
        return obs

    def _after_reset(self, env_ids: Tensor) -> None:
        super()._after_reset(env_ids)
        self._restart_latents(env_ids)
        self._update_latents()

    def _restart_latents(self, env_ids: Tensor) -> None:
        if self._amp.clip_latents == 0.0 or len(env_ids) == 0:
            self.schedule.restart(env_ids)
        else:
            amp_obs = self.discriminator.truncate(self._clips.amp_obs_of(env_ids))
            latents, of_starts = self._clip_latents.for_starts(amp_obs)
            self.schedule.restart(env_ids, latents)
            if self._keeping is not None:
                self._keeping.leave_clips(env_ids)
                self._keeping.keep_to_clips(env_ids[of_starts])
        self._command(env_ids)

    def _update_latents(self) -> None:
        """Replace latents that change before this policy step."""
        changed = self.schedule.advance(self._progress())
        self._command(changed)
        if self._keeping is not None:
            self._keeping.leave_clips(changed)

    def _command(self, env_ids: Tensor) -> None:
        """Tell the task what the latents of environments (n,) command."""
        if self._commanding is not None and len(env_ids) > 0:
            commands = self.schedule.latents[env_ids, : self._commanding.num_skill_commands]
            self._commanding.command_skills(env_ids, commands)

    def _sample_latents(self, n: int) -> Tensor:
        """Return n random latents (n, Z), unit vectors."""
        return self.model.a2c_network.sample_latents(n)

    def _progress(self) -> Tensor:
        return self._env.progress_buf.to(self.ppo_device)

    def _policy_inputs(self) -> dict[str, Tensor]:
        return {**super()._policy_inputs(), "amp_latents": self.schedule.latents}

    def _evaluation_inputs(self, env: Env) -> Callable[[], dict[str, Tensor]]:
        task = require(env, SkillEnv, "mean_policy of GenAMP")
        latents = EvaluationLatents(
            make_evaluation_schedule(self._amp, task, self.encoder, self.ppo_device)
        )
        return lambda: {"amp_latents": latents(env.progress_buf.to(self.ppo_device))}

    def _needs_next_value(self) -> Tensor:
        """Include environments whose latent changes: V(s') is computed with the old latent."""
        return super()._needs_next_value() | self.schedule.is_over(self._progress())

    def _record_step(self, n: int, infos: dict[str, Any]) -> None:
        super()._record_step(n, infos)
        self.experience_buffer.update_data("amp_latents", n, self.schedule.latents)

    def _reward_latents(self) -> tuple[Tensor, ...]:
        return (self.experience_buffer.tensor_dict["amp_latents"],)

    def _combine_rewards(self, task_rewards: Tensor, amp_rewards: dict[str, Tensor]) -> Tensor:
        """Return the total rewards (..., 1): AMP's reward + enc_reward_w * encoder reward."""
        return (
            super()._combine_rewards(task_rewards, amp_rewards)
            + self._amp.enc_reward_w * amp_rewards["enc_rewards"]
        )

    # --- update ----------------------------------------------------------------------------

    def _draw_disc_rows(self, batch_dict: dict[str, Any]) -> None:
        """Add AMP observations of clips and replay buffer to the batch, with latents if needed.

        Only a conditional discriminator needs latents. An AMP observation of a clip gets the latent
        of another time of the clip, because the latent of the same time would be too easy to match.
        `disc_mismatched_demos` replaces some replayed AMP observations by AMP observations of clips
        with wrong latents, which count as fake (Reed et al. 2016, "Generative Adversarial Text to
        Image Synthesis", algorithm 1).
        """
        if not self._disc_is_conditional:
            super()._draw_disc_rows(batch_dict)
            return
        fakes = {"amp_obs": batch_dict["amp_obs"], "amp_obs_latents": batch_dict["amp_latents"]}
        num_rows = len(fakes["amp_obs"])
        pairs = self._amp_obs_demo_buffer.sample(num_rows)
        demos, latents = pairs["amp_obs"], self._eval_enc(pairs["amp_obs_near"])
        if self._amp.latent_sharpness > 0.0:
            # Random latents have the same share here as in the policy's episodes. Each random
            # latent is paired with an AMP observation of the clips whose inferred latent is
            # similar, so that every latent has a motion.
            fresh, chosen = self._clip_latents.random(num_rows, latents.device)
            near = sample_similar_rows(fresh, latents[:_NEIGHBOURS], self._amp.latent_sharpness)
            of_clips = torch.zeros(num_rows, 1, dtype=torch.bool, device=latents.device)
            of_clips[chosen] = True
            demos = torch.where(of_clips, demos, demos[near])
            latents = torch.where(of_clips, latents, fresh)
        if self._amp_replay_buffer.get_total_count() > 0:
            fakes = self._amp_replay_buffer.sample(num_rows)
        num = round(self._amp.disc_mismatched_demos * num_rows)
        # The order is random, and the previous row is therefore a random other row.
        mismatched = {"amp_obs": demos, "amp_obs_latents": latents.roll(1, dims=0)}
        for name, rows in mismatched.items():
            mixed = torch.cat((rows[:num], fakes[name][num:]))
            batch_dict[name.replace("amp_obs", "amp_obs_replay")] = mixed
        batch_dict |= {"amp_obs_demo": demos, "amp_obs_demo_latents": latents}

    def prepare_dataset(self, batch_dict: dict[str, Any]) -> None:
        """Fill the dataset, and add the latents for policy and discriminator."""
        super().prepare_dataset(batch_dict)
        rows = self.dataset.values_dict
        rows["amp_latents"] = rows["amp_obs_latents"] = batch_dict["amp_latents"]
        for name in _DISC_LATENTS:
            if name in batch_dict:
                rows[name] = batch_dict[name]

    def _after_update(self, batch_dict: dict[str, Any]) -> None:
        latents = {"amp_obs_latents": batch_dict["amp_latents"]}
        others = latents if self._disc_is_conditional else {}
        self._store_replay_amp_obs(batch_dict["amp_obs"], **others)

    def _dataset_row_limits(self) -> dict[str, int]:
        """Limit the latents of AMP observations to as many rows as the AMP observations."""
        own = dict.fromkeys(("amp_obs_latents", *_DISC_LATENTS), self._amp_minibatch_size)
        return {**super()._dataset_row_limits(), **own}

    def prepare_minibatch(self, minibatch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Add latents for the diversity loss and AMP observations for the encoder's losses."""
        rows = super().prepare_minibatch(minibatch)
        if self._enable_amp_diversity_bonus():
            rows["diversity_latents"] = self._sample_latents(len(minibatch["amp_latents"]))
        if self._amp.encodes_clips:
            rows |= self._draw_encoder_rows()
        return rows

    def _draw_encoder_rows(self) -> dict[str, Tensor]:
        """Return the normalised AMP observations from which the encoder learns.

        "demo_triples" (n, 3, F) are two nearby times of a clip and one other, "commanded_demos"
        (n, F) belong to "commands" (n, C).
        """
        num_rows = max(1, self._amp_minibatch_size // 2)
        demos = self._amp_obs_demo_buffer.sample(num_rows)
        pairs = torch.stack((demos["amp_obs"], demos["amp_obs_near"]), dim=1)
        # The order is random, and the previous row is therefore a random other row.
        others = pairs[:, :1].roll(1, dims=0)
        rows = {"demo_triples": self._preproc_amp_obs(torch.cat((pairs, others), dim=1))}
        if self._commanding is not None:
            amp_obs, commands = self._commanded_demos
            chosen = torch.randint(len(commands), (num_rows,), device=commands.device)
            rows["commanded_demos"] = self._preproc_amp_obs(amp_obs[chosen])
            rows["commands"] = commands[chosen]
        return rows

    @cached_property
    def _commanded_demos(self) -> tuple[Tensor, Tensor]:
        """AMP observations (K, F) of clips, with commands (K, C)."""
        assert self._commanding is not None
        amp_obs, commands = self._commanding.fetch_commanded_demos(_COMMANDED_DEMOS)
        return self.discriminator.truncate(amp_obs), commands

    def _training_inputs(self, input_dict: dict[str, Tensor]) -> dict[str, Any]:
        names = ("amp_latents", "amp_obs_latents", *_DISC_LATENTS)
        return {
            **super()._training_inputs(input_dict),
            **{name: input_dict[name] for name in names if name in input_dict},
            "enc_gradient": self._enable_enc_grad_penalty(),
        }

    def _extra_losses(
        self, result: dict[str, Tensor], batch: dict[str, Any], input_dict: dict[str, Tensor]
    ) -> LossTerms:
        terms = super()._extra_losses(result, batch, input_dict)
        info = self.encoder.loss(
            result["enc_pred"], batch["amp_obs_latents"], result.get("enc_gradient")
        )
        weights = {"enc_loss": self._amp.enc_coef}
        terms |= {name: (weights.get(name, 0.0), value) for name, value in info.items()}
        if "demo_triples" in input_dict:
            terms |= self._clip_encoding_losses(input_dict)
        if "diversity_latents" in input_dict:
            fresh = (input_dict["diversity_latents"],) if self._diversity_loss_takes_latents else ()
            loss = self._diversity_loss(batch["obs"], result["mus"], batch["amp_latents"], *fresh)
            mean = weighted_mean(loss, input_dict)
            terms["amp_diversity_loss"] = (self._amp.amp_diversity_bonus, mean)
        return terms

    def _clip_encoding_losses(self, rows: Mapping[str, Tensor]) -> LossTerms:
        """Return the encoder's losses on clips, given the rows of `_draw_encoder_rows`.

        The alignment loss makes the latents of two nearby times similar, and the uniformity loss
        spreads all latents over the sphere. See Wang and Isola 2020 (arXiv 2005.10242), eq. 1, and
        eq. 2 without the logarithm. The command loss makes the first entries of latents commands.
        """
        triples = rows["demo_triples"]
        found = self.model.a2c_network.eval_enc(triples.flatten(0, 1)).float()
        at, near, other = found.view(*triples.shape[:2], -1).unbind(dim=1)
        alignment = (at - near).square().sum(dim=-1).mean()
        uniformity = torch.exp(-2.0 * (at - other).square().sum(dim=-1)).mean()
        terms = {
            "enc_alignment_loss": (self._amp.enc_alignment_coef, alignment),
            "enc_uniformity_loss": (self._amp.enc_uniformity_coef, uniformity),
        }
        if "commands" in rows:
            latents = self.model.a2c_network.eval_enc(rows["commanded_demos"]).float()
            missed = latents[:, : rows["commands"].shape[1]] - rows["commands"]
            loss = missed.square().sum(dim=-1).mean()
            terms["enc_command_loss"] = (self._amp.enc_command_coef, loss)
        return terms

    def _enable_amp_diversity_bonus(self) -> bool:
        """Return whether there is a diversity loss."""
        return self._amp.amp_diversity_bonus != 0.0

    def _enable_enc_grad_penalty(self) -> bool:
        """Return whether the encoder's loss has a gradient penalty."""
        return self._amp.enc_grad_penalty != 0.0

    def _diversity_loss(
        self,
        obs: Tensor,
        action_params: Tensor,
        ase_latents: Tensor,
        new_latents: Tensor | None = None,
    ) -> Tensor:
        """Return the diversity loss (n,), which compares changes of actions and of latents.

        The loss is (target - |a - a'|^2 / A / (0.5 - 0.5 z . z' + 1e-5))^2; the actions a and a'
        under the latents z and z' are clamped to +-1 (ASE, eq. 14, as in its published code).
        Several threads call this method.

        Args:
            obs: (n, O) normalised observations.
            action_params: (n, A) mean actions under `ase_latents`.
            ase_latents: (n, Z) latents z.
            new_latents: (n, Z) latents z'. If `new_latents` is None, this method draws them.
        """
        new_z = self._sample_latents(len(obs)) if new_latents is None else new_latents
        other_mu, _ = self._eval_actor(obs, new_z)
        change = action_params.clamp(-1.0, 1.0) - other_mu.clamp(-1.0, 1.0)
        latent_distance = 0.5 - 0.5 * (ase_latents * new_z).sum(dim=-1)
        ratio = change.square().mean(dim=-1) / (latent_distance + 1e-5)
        return (self._amp.amp_diversity_tar - ratio).square()

    def _eval_actor(self, obs: Tensor, ase_latents: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions and log standard deviations (n, A) of normalised obs (n, O)."""
        return self.model.a2c_network.eval_actor(obs, ase_latents)


def make_evaluation_schedule(
    params: GenAMPParams, env: SkillEnv, encoder: SkillEncoder, device: str | torch.device
) -> LatentSchedule:
    """Return a latent schedule for playing a task, which draws latents like in training."""
    clip_latents = ClipLatents(
        params.clip_latents,
        params.latent_dim,
        read=encoder.read,
        fetch=lambda n: env.fetch_amp_obs_demo(n).to(device),
    )
    draw = partial(clip_latents.draw, device=device)
    steps = (params.latent_steps_min, params.latent_steps_max)
    return LatentSchedule(env.num_envs, params.latent_dim, *steps, device, draw)
