"""`isaacgymenvs-lite check`: what a file asks for, in words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from isaacgymenvs_lite.commands.check import describe, main
from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.paths import cfg_dir
from isaacgymenvs_lite.tasks import isaacgym_task_map
from isaacgymenvs_lite.tasks.cartpole import Cartpole

TRAIN_FILES = sorted(path.stem for path in (cfg_dir() / "train").glob("*.yaml"))
# Files that others are made of, with no name and length of their own.
BASES = {"ClassicPPO", "ClassicSAC"}


def test_a_train_file_in_words() -> None:
    lines = describe("AntPPO")
    assert lines[0].startswith("AntPPO.yaml: a train file, checked with task=Ant;")
    assert lines[1:] == [
        "task: 60 observations, 8 actions, 1000 control steps of 0.0166 s at most,"
        " 4,096 environments",
        "algorithm: a2c_continuous, model continuous_a2c_logstd",
        "network: actor_critic, [256, 128, 64] elu",
        "samples: 4,096 environments x 16 steps = 65,536 in an epoch;"
        " 4 times 2 minibatches of 32,768",
        "length: 500 epochs, 32,768,000 steps",
        "nothing is wrong with it",
    ]


def test_a_task_file_in_words() -> None:
    lines = describe("Cartpole")
    assert lines[0] == "Cartpole.yaml: a task file, of the task Cartpole"
    assert lines[1].startswith("task: 4 observations, 1 actions, 500 control steps")


def test_the_time_of_a_control_step_is_what_is_simulated() -> None:
    for task, step_s in [("Ant", "0.0332"), ("AnymalTerrain", "0.04"), ("HumanoidAMP", "0.0332")]:
        # AnymalTerrain's has 4 calls of 5 ms (its key `decimation`) before this key doubles it.
        line = describe(task, ["task.env.controlFrequencyInv=2"])[1]
        assert f"control steps of {step_s} s at most" in line


def test_keys_that_nothing_reads_are_named(tmp_path: Path) -> None:
    file = tmp_path / "AntMine.yaml"
    file.write_text("defaults: [AntPPO, _self_]\nparams: {config: {lr_threshold: 1, zebra: 2}}\n")
    lines = describe(str(file))
    assert "task=Ant;" in lines[0]
    assert any("no effect here:" in line and "params.config.lr_threshold" in line for line in lines)
    assert any("nothing reads train.params.config.zebra" in line for line in lines)


def test_a_checkpoint_that_the_file_asks_for(tmp_path: Path) -> None:
    file, weights = tmp_path / "AntMine.yaml", tmp_path / "Ant.pth"
    asked = f"params: {{load_checkpoint: True, load_path: {weights}}}\n"
    file.write_text(f"defaults: [AntPPO, _self_]\n{asked}")
    with pytest.raises(CheckpointError, match=f"no file {weights}"):
        describe(str(file))
    weights.touch()
    assert f"goes on from {weights}" in describe(str(file))


def test_a_task_by_the_algorithm_if_the_name_is_no_help(tmp_path: Path) -> None:
    file = tmp_path / "zebra.yaml"
    file.write_text("defaults: [HumanoidASEPPO, _self_]\n")
    assert "task=HumanoidASE;" in describe(str(file))[0]


def test_keys_without_effect_are_all_named(tmp_path: Path) -> None:
    file = tmp_path / "AntMine.yaml"
    player = "player: {games_num: 3, mine: True}"
    file.write_text(
        f"defaults: [AntPPO, _self_]\nparams: {{config: {{{player}}}, model: {{extra: 1}}}}\n"
    )
    lines = describe(str(file))
    assert "note: nothing reads train.params.model.extra" in lines
    assert "note: nothing reads train.params.config.player.mine" in lines
    closing = "it can be used; the keys without effect are named above"
    assert lines[-1] == closing
    of_task = describe("Ant", ["num_envs=2048"])
    (unread,) = (line for line in of_task if line.startswith("no effect here: "))
    assert "task.env.envSpacing" in unread
    assert "task.sim.physx.* (except num_threads)" in unread
    assert of_task[-1] == closing


@pytest.mark.slow
def test_nothing_is_wrong_with_our_own_train_files() -> None:
    for name in sorted(set(TRAIN_FILES) - BASES):
        assert describe(name, ["num_envs=64"])[-1] == "nothing is wrong with it"


def test_mistakes_are_one_line_and_exit_code_2(capsys) -> None:
    for words, said in [
        (["AntPPO", "train.params.config.gamma=7"], "gamma: got 7, expected"),
        (["AntPPO", "train.params.algo.name=a2c_discrete"], "got discrete actions"),
        (
            ["AntPPO", "+train.params.config.central_value_config={minibatch_size: 8}"],
            "central_value_config: .*which this task lacks",
        ),
        (
            ["AnymalTerrainPPO_LSTM", "train.params.config.seq_length=5"],
            "seq_length 5 does not divide horizon_length 24",
        ),
        (["Lost"], "Lost: no such file, and no name"),
        ([str(Path(__file__).parent / "data.txt")], "no such file"),
    ]:
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        assert error.count("\n") == 1
        assert re.search(said, error), error


def test_a_file_of_another_kind_is_named(tmp_path: Path, capsys) -> None:
    file = tmp_path / "notes.yaml"
    file.write_text("a: 1\n")
    with pytest.raises(SystemExit):
        main([str(file)])
    assert "neither a train file" in capsys.readouterr().err


# Of the shape of IsaacGymEnvs' files for hands: two networks with memory, a player without end.
ASYMMETRIC = """\
params:
  seed: ${...seed}
  algo: {name: a2c_continuous}
  model: {name: continuous_a2c_logstd}
  network:
    name: actor_critic
    separate: False
    space:
      continuous:
        mu_activation: None
        sigma_activation: None
        mu_init: {name: default}
        sigma_init: {name: const_initializer, val: 0}
        fixed_sigma: True
    mlp:
      units: [512]
      activation: relu
      d2rl: False
      initializer: {name: default}
      regularizer: {name: None}
    rnn: {name: lstm, units: 1024, layers: 1, before_mlp: True, layer_norm: True}
  load_checkpoint: ${if:${...checkpoint},True,False}
  load_path: ${...checkpoint}
  config:
    name: ${resolve_default:Hand,${....experiment}}
    full_experiment_name: ${.name}
    env_name: rlgpu
    multi_gpu: ${....multi_gpu}
    ppo: True
    mixed_precision: False
    normalize_input: True
    normalize_value: True
    num_actors: ${....task.env.numEnvs}
    reward_shaper: {scale_value: 0.01}
    normalize_advantage: True
    gamma: 0.998
    tau: 0.95
    learning_rate: 1e-4
    lr_schedule: adaptive
    schedule_type: standard
    kl_threshold: 0.016
    score_to_win: 100000
    max_epochs: ${resolve_default:10000,${....max_iterations}}
    save_best_after: 100
    save_frequency: 200
    print_stats: True
    grad_norm: 1.0
    entropy_coef: 0.0
    truncate_grads: True
    e_clip: 0.2
    horizon_length: 16
    minibatch_size: 16384
    mini_epochs: 4
    critic_coef: 4
    clip_value: True
    seq_len: 4
    bounds_loss_coef: 0.0001
    central_value_config:
      minibatch_size: ${..minibatch_size}
      mini_epochs: ${..mini_epochs}
      learning_rate: 1e-4
      kl_threshold: 0.016
      clip_value: True
      normalize_input: True
      truncate_grads: True
      network:
        name: actor_critic
        central_value: True
        mlp:
          units: [512]
          activation: relu
          d2rl: False
          initializer: {name: default}
          regularizer: {name: None}
        rnn: {name: lstm, units: 1024, layers: 1, before_mlp: True, layer_norm: True}
    player: {deterministic: True, games_num: 1000000, print_stats: True}
"""


def test_a_file_for_an_asymmetric_critic_with_memory(tmp_path: Path) -> None:
    file = tmp_path / "HandPPOAsymmLSTM.yaml"
    file.write_text(ASYMMETRIC)
    with pytest.raises(ConfigError, match=r"central_value_config: .*which this task lacks"):
        describe(str(file), ["task=Ant"])
    lines = describe(str(file), ["task=Ant", "task.env.asymmetric_observations=True"])
    assert "asymmetric critic: actor_critic, [512] relu, lstm of 1024 units" in lines
    assert lines[-1] == "it can be used; the keys without effect are named above"
    with pytest.raises(ConfigError, match="seq_length 5 does not divide horizon_length 16"):
        describe(
            str(file),
            [
                *("task=Ant", "task.env.asymmetric_observations=True"),
                "train.params.config.seq_len=5",
            ],
        )


# --- whose task a file is of ---------------------------------------------------------------------


def train_file(folder: Path, name: str, run: str = "") -> Path:
    """Write a train file that is Ant's but for the name of its runs."""
    file = folder / f"{name}.yaml"
    file.parent.mkdir(parents=True, exist_ok=True)
    config = f"{{config: {{name: '${{resolve_default:{run},${{....experiment}}}}'}}}}"
    file.write_text(f"defaults: [AntPPO, _self_]\nparams: {config if run else '{}'}\n")
    return file


def test_train_files_of_published_tasks_are_not_checked_with_another(tmp_path: Path) -> None:
    for name, run, task in [
        ("AllegroKukaPPO", "AllegroKuka", "AllegroKuka"),
        ("FactoryTaskGearsPPO", "", "FactoryTaskGears"),
        ("AllegroHandDextremeADRPPO", "AllegroHandADR", "AllegroHandDextremeADR"),
        ("mine", "IndustRealTaskPegsInsert", "IndustRealTaskPegsInsert"),
    ]:
        file = train_file(tmp_path, name, run)
        said = f"{name}.yaml is not checked: {task} is a published task .* not here"
        with pytest.raises(ConfigError, match=said):
            describe(str(file))
        # Whoever wants it checked with another says so.
        assert describe(str(file), ["task=Ant"])[-1] == "nothing is wrong with it"


def test_task_files_of_published_tasks(tmp_path: Path) -> None:
    for text in [
        "name: FactoryTaskGears\nenv: {numEnvs: 3}\nsim: {}\n",
        "defaults: [_self_, {env: reorientation}]\nname: AllegroKuka\nenv: {numEnvs: 3}\n",
        "name: AllegroHandDextremeADR\nenv: {numEnvs: 3}\nsim: {dt: .nan}\n",
    ]:
        file = tmp_path / "any.yaml"
        file.write_text(text)
        with pytest.raises(ConfigError, match=r"any.yaml is not checked: \w+ is a published task"):
            describe(str(file))


def test_train_files_of_a_forks_own_tasks(tmp_path: Path) -> None:
    for name, run in [("MyRobotPPO", "MyRobot"), ("AntMazePPO", "AntMaze"), ("MyRobotSAC", "x")]:
        file = train_file(tmp_path, name, run)
        with pytest.raises(
            ConfigError,
            match=f"{name}.yaml belongs to none of the tasks here; .* task=",
        ):
            describe(str(file))
        assert describe(str(file), ["task=Ant"])[-1] == "nothing is wrong with it"


# As docs/own_task.md has it.
SWING_UP = """\
defaults:
  - Classic
  - _self_

name: SwingUp

env:
  numEnvs: ${resolve_default:512,${...num_envs}}
  episodeLength: 300
"""


def test_a_task_file_of_ones_own_that_is_made_of_ours(tmp_path: Path, capsys) -> None:
    file = tmp_path / "cfg" / "task" / "SwingUp.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(SWING_UP)
    assert main([str(file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "SwingUp.yaml: a task file, of the task SwingUp"
    assert "the class of 'SwingUp' is not here, so that the keys of task.env are not" in lines[1]
    assert lines[-1] == "the rest of it can be used; the keys without effect are named above"


def test_with_its_class_all_of_it_is_checked(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(isaacgym_task_map, "SwingUp", Cartpole)
    file = tmp_path / "cfg" / "task" / "SwingUp.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(SWING_UP)
    lines = describe(str(file))
    assert lines[1].startswith("task: 4 observations, 1 actions, 500 control steps")
    assert not any(line.startswith("algorithm") for line in lines)  # it has no train file yet
    assert lines[-1] == "it can be used; the keys without effect are named above"
    # A train file is checked with the task file that belongs to it.
    train = train_file(tmp_path / "cfg" / "train", "SwingUpPPO", "SwingUp")
    assert f"checked with task={file};" in describe(str(train))[0]
    assert any(line.startswith("algorithm: a2c") for line in describe(str(file)))
    file.write_text(SWING_UP.replace("episodeLength: 300", "maxEfort: 300"))
    with pytest.raises(ConfigError, match="maxEfort"):
        describe(str(file))


def test_a_strangers_file_runs_nothing(tmp_path: Path, capsys) -> None:
    canary = tmp_path / "canary"
    file = tmp_path / "AntPPO.yaml"
    call = f"{{_target_: builtins.open, file: {canary}, mode: w}}"
    for text, said in (
        (f"# @package _global_\nhydra: {{callbacks: {{x: {call}}}}}\n", "sets 'hydra'"),
        ("# @package _global_\ndefaults: [AntSAC, _self_]\nparams: {}\n", "header"),
        (f"params: {{network: {call}}}\n", "has a key '_target_'"),
        ("params: {config: {name: '${oc.env:HOME}'}}\n", "uses 'oc.env'"),
        ("defaults: [Other@_global_, _self_]\nparams: {}\n", "Other"),
    ):
        file.write_text(text)
        with pytest.raises(SystemExit) as ended:
            main([str(file)])
        error = capsys.readouterr().err
        assert (ended.value.code, error.count("\n")) == (2, 1)
        assert said in error
    assert not canary.exists()


def test_environments_of_rl_games_are_refused() -> None:
    with pytest.raises(ConfigError, match="env_name=openai_gym: expected rlgpu"):
        describe("AntPPO", ["train.params.config.env_name=openai_gym"])
