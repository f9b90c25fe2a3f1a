"""Files from outside cfg/: found by their paths, and doing nothing but describe a task or an agent.

Every door has a canary: a file that the door would write, or a variable that it would set. The
files are read as a user names them, in this process through `compose` and through train.py's own
`main`, whose runner is replaced by a stand-in that must not be reached.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from isaacgymenvs_lite import train
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.resolvers import forbidden_resolver
from isaacgymenvs_lite.config.staging import is_foreign, read_yaml
from isaacgymenvs_lite.config.train_files import load_train_file
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import cfg_dir
from tests.train_command import make_train_command

REPOSITORY = Path(__file__).resolve().parents[2]
VARIABLE = "ISAACGYMENVS_LITE_TEST"

CALLBACK = "hydra: {callbacks: {x: {_target_: builtins.open, file: CANARY, mode: w}}}\n"
# What each makes Hydra do, if it is let: open CANARY for writing, or set the variable.
HYDRA_SECTIONS = {
    "callback": CALLBACK,
    "launcher": "hydra: {launcher: {_target_: os.abort}}\n",
    "log handler": (
        "hydra: {job_logging: {version: 1, handlers: {h: {'()': builtins.open, file: CANARY,"
        " mode: w}}, root: {handlers: [h]}}}\n"
    ),
    "environment": f"hydra: {{job: {{env_set: {{{VARIABLE}: set}}}}}}\n",
    "folder": "hydra: {run: {dir: CANARY}}\n",
    "search path": "hydra: {searchpath: ['pkg://os']}\n",
}
TRAIN = "defaults: [CartpolePPO, _self_]\n"
# A train file that trains as another, and says what Hydra does.
GLOBAL = "# @package _global_\ndefaults: [CartpolePPO@_global_.train, _self_]\n"

Write = Callable[[str, str], Path]


@pytest.fixture
def canary(tmp_path, monkeypatch) -> Path:
    monkeypatch.delenv(VARIABLE, raising=False)
    return tmp_path / "canary"


@pytest.fixture
def write(tmp_path, canary) -> Write:
    """Write a file of a stranger's folder; CANARY stands for the canary's path."""

    def write_file(name: str, text: str) -> Path:
        path = tmp_path / "stranger" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.replace("CANARY", str(canary)))
        return path

    return write_file


@pytest.fixture
def call(monkeypatch, tmp_path) -> Callable[..., int]:
    """Run train.py's command line in an empty folder, without a runner; returns its exit code."""
    folder = tmp_path / "working"
    folder.mkdir()
    return make_train_command(monkeypatch, folder, lambda *_: (tmp_path / "trained").touch())


def assert_refused(call: Callable[..., int], capsys, tmp_path: Path, *arguments: str) -> str:
    """Assert that a command line is refused in one line and that nothing was run for it."""
    assert call(*arguments) == train.EXIT_USER_ERROR
    output = capsys.readouterr()
    assert output.err.startswith("error: ")
    assert output.err.count("\n") == 1
    assert output.out == ""
    assert VARIABLE not in os.environ
    assert {path.name for path in tmp_path.iterdir()} <= {"stranger", "working"}
    assert list((tmp_path / "working").iterdir()) == []
    return output.err


# --- Hydra's section -----------------------------------------------------------------------------


def test_a_file_has_no_say_in_what_hydra_does(call, write, capsys, tmp_path):
    for door in HYDRA_SECTIONS:
        section = HYDRA_SECTIONS[door]
        named = ["task=Cartpole", f"train={write('Mine.yaml', GLOBAL + section)}"]
        error = assert_refused(call, capsys, tmp_path, *named)
        assert "'# @package _global_', which names another section; expected 'train'" in error
        named = ["task=Cartpole", f"train={write('Mine.yaml', TRAIN + section)}"]
        assert "Mine.yaml sets 'hydra'" in assert_refused(call, capsys, tmp_path, *named)
        root = (cfg_dir() / "config.yaml").read_text().partition("hydra:\n")[0]
        folder = write("cfg/config.yaml", root + section).parent
        error = assert_refused(call, capsys, tmp_path, "--config-path", str(folder))
        assert "config.yaml sets 'hydra', which decides what is run" in error
        write("mine/train/Mine.yaml", TRAIN + section)
        folder = tmp_path / "stranger" / "mine"
        words = ["--config-dir", str(folder), "task=Cartpole", "train=Mine"]
        assert "Mine.yaml sets 'hydra'" in assert_refused(call, capsys, tmp_path, *words)


def test_a_header_names_the_files_own_group(write):
    for header in ["hydra", "task", "train.params", "_here_", "_global_.train.x"]:
        file = write("Mine.yaml", f"# @package {header}\n{TRAIN}")
        with pytest.raises(ConfigError, match=rf"header '# @package {header}'"):
            compose(["task=Cartpole", f"train={file}"])


def test_the_header_of_the_own_group_is_welcome(write):
    for header in ["train", "_group_", "_global_.train"]:
        file = write(
            "Mine.yaml", f"# @package {header}\n{TRAIN}params: {{config: {{gamma: 0.5}}}}\n"
        )
        cfg = compose(["task=Cartpole", f"train={file}"])
        assert cfg.train.params.config.gamma == 0.5
        assert set(cfg) == set(compose(["task=Cartpole"]))


def test_a_defaults_list_stays_in_its_own_group(write):
    for entry in [
        *("Other@_global_", "/train/Other@_global_", "../config", "pkg://os", "~/Other", "3"),
        *("'${oc.env:HOME}'", "{Other@_global_: x}", "{/task: Ant}", "{sub: [../x]}"),
        "{override hydra/launcher: basic}",
        "{a: b, override hydra/launcher: basic}",
    ]:
        write("Other.yaml", CALLBACK)
        file = write("Mine.yaml", f"defaults:\n  - CartpolePPO\n  - _self_\n  - {entry}\n")
        with pytest.raises(ConfigError, match=r"Mine.yaml: .*(defaults list leads out of|uses )"):
            compose(["task=Cartpole", f"train={file}"])


def test_a_defaults_list_may_name_files_beside_it_and_below(write, tmp_path):
    write("task/env/fast.yaml", "# @package task.env\nmaxEffort: 77\n")
    write("task/Base.yaml", "defaults: [Cartpole, _self_]\n")
    file = write("task/Mine.yaml", "defaults: [Base, _self_, {env: fast}, {optional sim: none}]\n")
    for words, folder in ([f"task={file}"], None), (["task=Mine"], tmp_path / "stranger"):
        cfg = compose([*words, "train=CartpolePPO"], folder)
        assert (cfg.task.name, cfg.task.env.maxEffort) == ("Cartpole", 77)


def test_a_circle_of_defaults_lists_is_one_line(write, tmp_path):
    itself = write("CartpolePPO.yaml", TRAIN)
    write("train/A.yaml", "defaults: [B, _self_]\n")
    write("train/B.yaml", "defaults: [A, _self_]\n")
    with pytest.raises(ConfigError, match="run in a circle"):
        compose(["task=Cartpole", f"train={itself}"])
    with pytest.raises(ConfigError, match="run in a circle"):
        compose(["task=Cartpole", "train=A"], tmp_path / "stranger")


# As IsaacGymEnvs' root file ends.
PUBLISHED_ROOT = """\
defaults:
  - task: Ant
  - train: ${task}PPO
  - pbt: no_pbt
  - override hydra/job_logging: disabled
  - _self_
hydra:
  output_subdir: null
  run:
    dir: .
"""


def test_a_published_root_file_is_welcome(call, write, tmp_path):
    ours = (cfg_dir() / "config.yaml").read_text()
    keys = ours.partition("# What to run")[2].partition("# Hydra stays")[0]
    folder = write("cfg/config.yaml", keys + PUBLISHED_ROOT).parent
    for group in ("task", "train", "pbt"):
        (folder / group).symlink_to(cfg_dir() / group)
    assert call("--config-path", str(folder), "task=Cartpole") == 0
    assert (tmp_path / "trained").exists()
    assert list((tmp_path / "working").iterdir()) == []  # no log, no outputs/


def test_a_folder_may_have_a_broken_file_that_is_not_named(write, tmp_path):
    write("train/Broken.yaml", "params: [1, 2\n")
    write("train/Mine.yaml", TRAIN)
    compose(["task=Cartpole", "train=Mine"], tmp_path / "stranger")
    with pytest.raises(ConfigError, match=r"Broken.yaml is not valid YAML"):
        compose(["task=Cartpole", "train=Broken"], tmp_path / "stranger")


def test_a_group_of_hydra_in_a_folder_is_not_found(call, write, canary, tmp_path):
    write("hydra/callbacks/x.yaml", "x: {_target_: builtins.open, file: CANARY, mode: w}\n")
    call("--config-dir", str(tmp_path / "stranger"), "+hydra/callbacks=x")
    assert not canary.exists()


def test_pickles_of_hydra_are_not_read(call, write, capsys, tmp_path):
    pickle = write("job.pickle", "cbuiltins\nopen\n(VCANARY\nVw\ntR.")
    error = assert_refused(call, capsys, tmp_path, "--experimental-rerun", str(pickle))
    assert "--experimental-rerun reads a pickle" in error


def test_the_users_own_words_may_set_hydra(call, tmp_path, write):
    file = write("Mine.yaml", TRAIN)
    words = ["task=Cartpole", f"train={file}", f"+hydra.job.env_set.{VARIABLE}=set"]
    assert call(*words, f"hydra.run.dir={tmp_path / 'mine'}") == 0
    assert (tmp_path / "trained").exists()
    assert (tmp_path / "mine").is_dir()


# --- names of code, secrets ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    ["params: {a: [1, {b: [{_target_: os.system}]}]}\n", "a: &x {_target_: o.s}\nb: *x\n"],
)
def test_no_file_names_something_to_be_called(text, write):
    file = write("Mine.yaml", TRAIN + text)
    for read in (lambda: compose(["task=Cartpole", f"train={file}"]), lambda: read_yaml(file)):
        with pytest.raises(ConfigError, match="has a key '_target_', which names code"):
            read()


def test_interpolations_lead_to_other_settings_only(write, monkeypatch):
    for value in [
        *("${oc.env:SECRET}", "x ${oc.env:SECRET,default} y", "${ oc.env : SECRET}"),
        *("${hydra:runtime.cwd}", "${now:%Y}", "${eval:'1'}", "${${a}:SECRET}", "${a.${b}}"),
        *("${oc.${b}:SECRET}", "${if:True,${oc.env:SECRET},x}", r"\${oc.env:SECRET}"),
        *("$${if:True,'',''}{oc.env:SECRET}", "costs $5", "${unfinished"),
    ]:
        monkeypatch.setenv("SECRET", "s3cret")
        OmegaConf.register_new_resolver("eval", eval, replace=True)  # as many programs have it
        try:
            text = OmegaConf.to_yaml({"defaults": ["CartpolePPO"], "params": {"note": "PLACE"}})
            file = write("Mine.yaml", text.replace("PLACE", "'" + value.replace("'", "''") + "'"))
            with pytest.raises(ConfigError, match=r"Mine\.yaml: params\.note") as refused:
                compose(["task=Cartpole", f"train={file}"])
            assert "s3cret" not in str(refused.value)
        finally:
            OmegaConf.clear_resolver("eval")


def test_published_interpolations_are_welcome():
    for value in [
        *("${....task.env.numEnvs}", "${resolve_default:Ant,${....experiment}}", "${a[0].b}"),
        '${if:${contains:"cuda",${....sim_device}},True,False}',
        "${if:${eq:${a},b},[512, 256],[1024, 512]}",
        *("runs_${seed}_${num_envs}", "${default_rl_device:}", "plain"),
    ]:
        assert forbidden_resolver(value) is None


def test_a_refusal_is_one_line_whatever_the_file_holds(write):
    for text in (
        'params: {"a\\nerror: b\\e[2J": {c: "${x:\\n}"}}\n',
        'defaults: ["a\\nb"]\n',
        "a: !%0Ab c\n",
        "# @package \x1b[2J\n",
        "a: &a [*a]\n",
        "!!python/object/apply:os.system [touch CANARY]\n",
        "\0",
    ):
        file = write("Mine.yaml", text)
        with pytest.raises(ConfigError) as refused:
            compose(["task=Cartpole", f"train={file}"])
        assert str(refused.value).isprintable(), text


def test_the_users_own_words_may_read_the_environment(monkeypatch):
    monkeypatch.setenv("GROUP", "mine")
    assert compose(["task=Cartpole", "wandb_group=${oc.env:GROUP}"]).wandb_group == "mine"


def test_files_that_are_read_alone_are_checked_as_well(write, monkeypatch):
    """The low level's train file of a hierarchy, and the config.yaml of a run."""
    monkeypatch.setenv("SECRET", "s3cret")
    file = write("llc.yaml", "params: {config: {name: '${oc.env:SECRET}'}}\n")
    with pytest.raises(ConfigError, match=r"uses 'oc\.env'"):
        load_train_file(file)
    run = write("run/config.yaml", "task: {name: x}\nhydra: {job: {env_set: {A: b}}}\n")
    with pytest.raises(ConfigError, match="sets 'hydra'"):
        load_train_file(run)


# --- where files are written ---------------------------------------------------------------------


def test_a_train_file_does_not_choose_a_folder_elsewhere(write):
    for folder in ["CANARY", "../canary", "${....experiment}", "[a]"]:
        text = folder if folder == "[a]" else f"'{folder}'"
        file = write("Mine.yaml", f"{TRAIN}params: {{config: {{train_dir: {text}}}}}\n")
        with pytest.raises(ConfigError, match="outside of the working folder; to write there"):
            compose(["task=Cartpole", f"train={file}", "experiment=/elsewhere"])


def test_it_may_choose_one_below_and_the_user_any(write, tmp_path):
    below = write("Mine.yaml", f"{TRAIN}params: {{config: {{train_dir: runs/mine}}}}\n")
    words = ["task=Cartpole", f"train={below}"]
    assert compose(words).train.params.config.train_dir == "runs/mine"
    chosen = compose([*words, f"train.params.config.train_dir={tmp_path}"])
    assert chosen.train.params.config.train_dir == str(tmp_path)


def test_only_what_lies_in_cfg_is_ours(tmp_path, monkeypatch):
    assert not is_foreign(cfg_dir() / "train" / "AntPPO.yaml")
    assert is_foreign(cfg_dir() / ".." / "x.yaml")
    assert is_foreign(Path(f"{cfg_dir()}_other/x.yaml"))
    monkeypatch.chdir(cfg_dir() / "train")
    assert not is_foreign(Path("AntPPO.yaml"))


# --- the command line in a process of its own -----------------------------------------------------


def test_nothing_is_run_from_the_real_command_line(write, canary, tmp_path):
    file = write("Mine.yaml", GLOBAL + CALLBACK)
    result = subprocess.run(
        [sys.executable, str(REPOSITORY / "train.py"), "task=Cartpole", f"train={file}"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == train.EXIT_USER_ERROR
    assert result.stderr.startswith(f"error: {file} has the header '# @package _global_'")
    assert result.stderr.count("\n") == 1
    assert not canary.exists()
