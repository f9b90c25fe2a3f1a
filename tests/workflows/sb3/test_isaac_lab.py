"""Isaac Lab's flat agent files: read as published, and never run."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import yaml

pytest.importorskip("stable_baselines3")

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.workflows.library import load_agent_file
from isaacgymenvs_lite.workflows.sb3.agent import Agent, to_sections

SB3 = "sb3"
# Keys and values in the form that Isaac Lab's files have; the older form of policy_kwargs below.
FLAT = {
    "seed": 7,
    "n_timesteps": 64.0,
    "policy": "MlpPolicy",
    "n_steps": 8,
    "batch_size": 16,
    "gae_lambda": 0.9,
    "gamma": 0.98,
    "n_epochs": 2,
    "ent_coef": 0.01,
    "learning_rate": "lin_3e-4",
    "clip_range": 0.2,
    "policy_kwargs": {
        "activation_fn": "nn.ELU",
        "net_arch": {"pi": [8, 8], "vf": [8]},
        "optimizer_kwargs": {"eps": 1e-8},
        "squash_output": False,
    },
    "vf_coef": 1.0,
    "max_grad_norm": 1.0,
    "device": "cuda:0",
    "normalize_input": True,
    "normalize_value": True,
    "clip_obs": 20.0,
}
SMALL = ("--num_envs", "4", "num_threads=1")


@pytest.fixture
def flat_file(tmp_path: Path) -> Path:
    file = tmp_path / "sb3_ppo_cfg.yaml"
    file.write_text(yaml.safe_dump(FLAT))
    return file


def test_a_flat_file_means_the_same_in_sections():
    sections = to_sections(FLAT, num_envs=4)
    assert sections["max_iterations"] == 2  # 64 frames in rollouts of 8 x 4
    assert (sections["batch_size"], "minibatches" in sections) == (16, False)
    assert sections["ppo"]["gamma"] == 0.98 and sections["ppo"]["learning_rate"](
        0.5
    ) == pytest.approx(1.5e-4)
    assert sections["policy"]["activation"] == "elu"
    assert sections["policy"]["optimizer_kwargs"] == {"eps": 1e-8}
    assert sections["vec_normalize"] == {
        "norm_obs": True,
        "norm_reward": True,
        "clip_obs": 20.0,
        "clip_reward": math.inf,
    }
    fewer = {key: value for key, value in FLAT.items() if key not in ("batch_size", "clip_obs")}
    assert to_sections({**fewer, "n_minibatches": 4}, 4)["batch_size"] == 8
    assert to_sections(fewer, 4)["batch_size"] == 64  # Stable-Baselines3's own
    assert to_sections(fewer, 4)["vec_normalize"]["clip_obs"] == 100.0  # Isaac Lab's
    assert to_sections({**FLAT, "normalize_input": False}, 4)["vec_normalize"] is None


def test_an_agent_trains_and_plays_by_a_flat_file(flat_file, run_train, run_play, tmp_path):
    run_train(SB3, *SMALL, "--agent", str(flat_file), "agent.gamma=0.97")
    (folder,) = (tmp_path / "logs" / "sb3" / "Cartpole").iterdir()
    assert yaml.safe_load((folder / "params/agent.yaml").read_text())["gamma"] == 0.97
    assert yaml.safe_load((folder / "params/env.yaml").read_text())["seed"] == 7
    assert (folder / "model.zip").is_file() and (folder / "model.npz").is_file()
    assert "episodes: 4, " in run_play(SB3, *SMALL)


def test_the_file_reaches_the_algorithm(flat_file):
    from isaacgymenvs_lite import make

    content = load_agent_file("sb3", "Cartpole", str(flat_file), [])
    task = make(task="Cartpole", num_envs=4)
    model = Agent(task, content, "cpu", seed=1).model
    task.close()
    assert (model.batch_size, model.n_epochs, model.gae_lambda) == (16, 2, 0.9)
    assert model.lr_schedule(1.0) == pytest.approx(3e-4)
    assert model.lr_schedule(0.25) == pytest.approx(0.75e-4)
    assert model.policy.optimizer.defaults["eps"] == 1e-8
    assert [layer.out_features for layer in model.policy.mlp_extractor.value_net[::2]] == [8]
    assert model.policy.activation_fn.__name__ == "ELU"


LINE = "dict(activation_fn=nn.ELU, net_arch=[dict(pi=[32, 16], vf=(8,))], log_std_init=-1.5,)"


def test_a_line_of_python_is_parsed():
    policy = to_sections({**FLAT, "policy_kwargs": LINE}, 4)["policy"]
    assert policy == {
        "activation": "elu",
        "net_arch": [{"pi": [32, 16], "vf": [8]}],
        "log_std_init": -1.5,
    }


def test_nothing_of_a_line_is_run(tmp_path: Path):
    for line in [
        "dict(net_arch=__import__('os').mkdir({harm!r}))",
        "open({harm!r}, 'w')",
        "dict(**{{'a': 1}})",
        "dict([('net_arch', open({harm!r}, 'w'))])",
        "dict(a=nn.ELU(open({harm!r}, 'w')))",
        "[1, 2",
        "dict(a=" + "-" * 1900 + "1)",
        "{{1: 2}}",
        "dict(a=b)",
    ]:
        harm = tmp_path / "harm"
        with pytest.raises(ConfigError, match="policy_kwargs"):
            to_sections({**FLAT, "policy_kwargs": line.format(harm=str(harm))}, 4)
        assert not harm.exists()


def test_what_a_flat_file_cannot_say_is_one_line(flat_file, run_train, fails):
    for word, message in [
        ("agent.gama=0.9", "unknown key of agent.ppo 'gama' (did you mean 'gamma'?)"),
        ("agent.rollout_buffer_class=a.B", "unknown key of agent.ppo 'rollout_buffer_class'"),
        ("agent.policy=CnnPolicy", "expected one of MlpPolicy"),
        ("agent.policy_kwargs.activation_fn=os.system", "such as nn.ELU"),
        ("agent.policy_kwargs.optimizer_class=torch.optim.SGD", "optimizer_class"),
        ("agent.learning_rate=lin_fast", "expected a number, or lin_"),
    ]:
        assert message in fails(run_train, SB3, *SMALL, "--agent", str(flat_file), word)
