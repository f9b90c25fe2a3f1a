"""A folder of configuration files like the ones that users bring."""

from __future__ import annotations

from pathlib import Path

import pytest

# Of the shape of IsaacGymEnvs' files: relative interpolations into the composed tree, numbers that
# plain YAML reads as text, seq_len.
PUBLISHED = """\
params:
  seed: ${...seed}
  algo:
    name: amp_continuous
  model:
    name: continuous_amp
  network:
    name: amp
    separate: True
    space:
      continuous:
        mu_activation: None
        sigma_activation: None
        mu_init:
          name: default
        sigma_init:
          name: const_initializer
          val: -2.9
        fixed_sigma: True
        learn_sigma: False
    mlp:
      units: [32, 16]
      activation: relu
      d2rl: False
      initializer:
        name: default
      regularizer:
        name: None
    disc:
      units: [32, 16]
      activation: relu
      initializer:
        name: default
  load_checkpoint: ${if:${...checkpoint},True,False}
  load_path: ${...checkpoint}
  config:
    name: ${resolve_default:HumanoidAMP,${....experiment}}
    full_experiment_name: ${.name}
    env_name: rlgpu
    ppo: True
    multi_gpu: ${....multi_gpu}
    mixed_precision: False
    normalize_input: True
    normalize_value: True
    normalize_advantage: True
    num_actors: ${....task.env.numEnvs}
    reward_shaper:
      scale_value: 1
    gamma: 0.99
    tau: 0.95
    learning_rate: 5e-5
    lr_schedule: constant
    score_to_win: 20000
    max_epochs: ${resolve_default:5000,${....max_iterations}}
    grad_norm: 1.0
    entropy_coef: 0.0
    e_clip: 0.2
    horizon_length: 16
    minibatch_size: 32768
    mini_epochs: 6
    critic_coef: 5
    clip_value: False
    seq_len: 4
    bounds_loss_coef: 10
    amp_minibatch_size: 4096
"""

# Of the shape of ASE's files: no interpolations, no num_actors, `ppo` twice, seed -1.
ASE_LIKE = (
    PUBLISHED.replace("${...seed}", "-1")
    .replace("  load_checkpoint: ${if:${...checkpoint},True,False}\n", "  load_checkpoint: False\n")
    .replace("  load_path: ${...checkpoint}\n", "")
    .replace("${resolve_default:HumanoidAMP,${....experiment}}", "Humanoid")
    .replace("    full_experiment_name: ${.name}\n", "")
    .replace("${....multi_gpu}", "False")
    .replace("    num_actors: ${....task.env.numEnvs}\n", "")
    .replace("${resolve_default:5000,${....max_iterations}}", "100000")
    .replace("    e_clip: 0.2\n", "    ppo: True\n    e_clip: 0.2\n")
)

TASK = """\
name: HumanoidAMP
env:
  numEnvs: ${resolve_default:512,${...num_envs}}
  envSpacing: 5
  motion_file: walk.npz
sim:
  physx:
    num_threads: ${....num_threads}
    contact_offset: 0.05
"""


@pytest.fixture
def config_dir(tmp_path: Path) -> Path:
    """A folder for `--config-dir` with task/Mine and train/Published, Ase, OnlyDefaults."""
    files = {
        "task/Mine.yaml": TASK,
        "train/Published.yaml": PUBLISHED,
        "train/Ase.yaml": ASE_LIKE,
        "train/OnlyDefaults.yaml": "defaults:\n  - Published\n  - _self_\n",
    }
    for name, text in files.items():
        file = tmp_path / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(text)
    return tmp_path
