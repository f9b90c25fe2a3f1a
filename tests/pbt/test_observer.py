"""Policies of one population, one after the other in this process."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.checkpoints.run_config import resumed_tree
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.pbt import workspace
from isaacgymenvs_lite.pbt.observer import population_of
from isaacgymenvs_lite.pbt.restart import RestartRequest
from isaacgymenvs_lite.report.scalars import read_scalars
from isaacgymenvs_lite.runner import run
from isaacgymenvs_lite.schema import plain
from tests.tiny import CONFIG, DOWNHILL, TINY_DISCRIMINATOR, TINY_PBT, TINY_SAC, UPHILL

GOOD = [*TINY_PBT, DOWNHILL, "pbt.policy_idx=0", "seed=1"]
BAD = [*TINY_PBT, UPHILL, "pbt.policy_idx=1", "seed=2"]
ALL_SCALARS = [f"+{CONFIG}.defer_summaries_sec=0", f"+{CONFIG}.summaries_interval_sec_min=0"]
RATE = f"{CONFIG}.learning_rate"


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    caplog.set_level("INFO", "isaacgymenvs_lite")


def restart_of(words: Sequence[str]) -> RestartRequest:
    with pytest.raises(RestartRequest) as raised:
        run(compose(words))
    return raised.value


def run_of(index: int) -> Path:
    (folder,) = Path("runs").glob(f"Ant_pbt_{index:02d}_*")
    return folder


def record(index: int, iteration: int) -> dict[str, Any]:
    return yaml.safe_load(Path(f"runs/ws/{index:03d}/{iteration:06d}.yaml").read_text())


def same_weights(one: dict, other: dict) -> bool:
    return all(torch.equal(value, other["model"][name]) for name, value in one["model"].items())


def is_free(folder: Path) -> bool:
    return not list(folder.glob("**/.lock"))


def test_the_worse_policy_goes_on_with_the_weights_of_the_better_one():
    run(compose(GOOD))
    files = sorted(path.name for path in Path("runs/ws/000").iterdir())
    assert files == [
        *("000001.pth", "000001.yaml", "000002.pth", "000002.yaml", "policy.yaml"),
    ]
    request = restart_of(BAD)
    donor = load_checkpoint("runs/ws/000/000001.pth")
    own = load_checkpoint("runs/ws/001/000001.pth")
    start = load_checkpoint(request.settings["checkpoint"])
    assert same_weights(start, donor) and not same_weights(start, own)
    assert (start["frame"], start["epoch"]) == (128, 4)
    first, changed = record(1, 1)["params"], request.settings
    steps = f"{CONFIG}.mini_epochs"  # may stay at its least, 1
    assert all(changed[path] != v for path, v in first.items() if v != 0 and path != steps)
    assert record(0, 1)["true_objective"] > 1.0 > -1.0 > record(1, 1)["true_objective"]

    # The process is to start again: nothing is left open, and the run goes on in its folder.
    assert is_free(Path("runs"))
    kept = OmegaConf.load(run_of(1) / "config.yaml")
    assert OmegaConf.select(kept, RATE) == first[RATE]
    words = request.words([*BAD, "pbt.start_after=100000"])
    run(compose(words))
    kept = OmegaConf.load(run_of(1) / "config.yaml")
    assert OmegaConf.select(kept, RATE) == changed[RATE]
    (last,) = run_of(1).glob("nn/last_Ant_ep_12_*.pth")
    assert load_checkpoint(last)["frame"] == 12 * 32
    assert record(1, 2)["params"] == {path: changed[path] for path in first}
    assert record(1, 2)["experiment_name"] == run_of(1).name
    (best,) = Path("runs/ws/best1").glob("*.pth")
    assert re.fullmatch(r"Ant_best_obj_0{7,}\d\.\d{5}_iter_0001_policy000_frame128\.pth", best.name)


@pytest.mark.slow
def test_mutations_depend_on_the_seed_and_the_policy_alone():
    def rate(seed: int, index: int, workspace: str) -> float:
        words = [f"seed={seed}", f"pbt.policy_idx={index}", f"pbt.workspace={workspace}"]
        run(compose([*TINY_PBT, *words, f"experiment={workspace}", "max_iterations=1"]))
        (folder,) = Path("runs").glob(f"{workspace}_pbt_*")
        return OmegaConf.select(OmegaConf.load(folder / "config.yaml"), RATE)

    rates = [rate(3, 0, "a"), rate(3, 0, "b"), rate(3, 1, "c"), rate(4, 0, "d")]
    assert rates[0] == rates[1]
    assert len(set(rates)) == 3
    assert all(3e-4 / 1.5 <= rate <= 3e-4 * 1.5 for rate in rates)


@pytest.mark.slow
def test_a_run_that_is_resumed_stays_in_its_population(caplog):
    run(compose([*BAD, "max_iterations=4", f"{CONFIG}.save_frequency=2"]))
    rate = OmegaConf.select(OmegaConf.load(run_of(1) / "config.yaml"), RATE)
    run(compose(GOOD))
    typed = [f"resume={run_of(1)}", "max_iterations=14"]
    with pytest.raises(RestartRequest) as raised:
        run(resumed_tree(typed))
    assert record(1, 2)["params"][RATE] == rate  # not changed by the start
    request = raised.value
    words = request.words(typed)
    assert words[0] == f"resume={run_of(1).absolute()}"
    cfg = resumed_tree([*words, "pbt.start_after=100000"])
    assert (cfg.resume, cfg.checkpoint) == ("", request.settings["checkpoint"])
    run(cfg)
    assert record(1, 3)["params"][RATE] == request.settings[RATE] != rate
    assert list(run_of(1).glob("nn/last_Ant_ep_14_*.pth"))


def test_the_file_of_a_run_does_not_choose_where_the_workspace_is(tmp_path):
    run(compose([*BAD, "max_iterations=2"]))
    cfg = OmegaConf.load(run_of(1) / "config.yaml")
    cfg.train.params.config.train_dir, cfg.pbt.workspace = str(tmp_path), "elsewhere"
    OmegaConf.save(cfg, run_of(1) / "config.yaml")
    run(resumed_tree([f"resume={run_of(1)}", "max_iterations=5"]))
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_policy_that_was_trained_does_not_begin_again():
    run(compose(GOOD))
    with pytest.raises(ConfigError) as error:
        run(compose([*GOOD, "experiment=again"]))
    assert f"policy 0 has been trained there; go on with it: resume={run_of(0)}, choose" in str(
        error.value
    )
    assert sorted(path.name for path in Path("runs").iterdir()) == [run_of(0).name, "ws"]


def test_the_first_of_several_processes_decides_for_all():
    sent = RestartRequest({RATE: 0.5}, Path("runs/Ant"))
    with population_of(plain(compose(BAD)), 2, Path("runs"), decides=False) as follower:
        assert follower is not None
        follower.after_init(None)
        follower.share = lambda own: own
        follower.after_steps()  # nothing was decided
        follower.share = lambda own: sent if own is None else own
        with pytest.raises(RestartRequest) as received:
            follower.after_steps()
    assert received.value is sent
    assert not Path("runs").exists()


@pytest.mark.slow
def test_a_broken_file_during_a_training_is_left_out(caplog):
    run(compose(GOOD))
    file = Path("runs/ws/000/000001.yaml")
    run(compose([*BAD, "max_iterations=2"]))  # joined; nothing written yet
    for broken in (
        "iteration: [",
        "just text",
        "iteration: 1\n",
        f"{file.read_text()}iteration: 7",
    ):
        file.write_text(broken)
        run_again = [*BAD, "++pbt_restart=True", "experiment=x", "max_iterations=5"]
        run(compose(run_again))
        assert "runs/ws/000/000001.yaml is broken: " in caplog.text
        assert "left out of the comparison" in caplog.text
        assert "(1 of 2 known)" in caplog.text
        caplog.clear()


class _Evil:
    def __reduce__(self):
        return Path("harm").touch, ()


def _runs_code(checkpoint: dict, record: dict) -> None:
    checkpoint["model"] = _Evil()


def _not_finite(checkpoint: dict, record: dict) -> None:
    checkpoint["model"]["a2c_network.mu.weight"][0, 0] = torch.nan


def _of_other_shapes(checkpoint: dict, record: dict) -> None:
    checkpoint["model"]["a2c_network.mu.weight"] = torch.zeros(2, 3)


def _impossible_settings(checkpoint: dict, record: dict) -> None:
    record["params"][RATE] = -1.0


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (_runs_code, "policy 0 is left out of the comparison (checkpoint=.*/000001.pth: refused"),
        (_not_finite, "policy 0 is left out .*a2c_network.mu.weight has values that are not"),
        (_of_other_shapes, "policy 0 is left out .*a2c_network.mu.weight is 2x3 float32, expected"),
        (_impossible_settings, "policy 1 does not go on as policy 0 .*learning_rate"),
    ],
)
def test_a_broken_policy_is_left_out(damage, expected, caplog, monkeypatch):
    monkeypatch.setattr("isaacgymenvs_lite.pbt.observer._TAKE_SETTINGS", 1.0)
    run(compose(GOOD))
    for file in Path("runs/ws/000").glob("*.pth"):
        checkpoint = load_checkpoint(file)
        content = yaml.safe_load(file.with_suffix(".yaml").read_text())
        damage(checkpoint, content)
        torch.save(checkpoint, file)
        file.with_suffix(".yaml").write_text(yaml.safe_dump(content))
    run(compose([*BAD, f"{CONFIG}.save_frequency=1"]))
    assert re.search(expected.replace("(", r"\("), caplog.text)
    assert [file.name for file in (run_of(1) / "resume").iterdir()] == ["12.pth"]
    assert not Path("harm").exists()
    is_usable = damage is _impossible_settings
    assert is_usable == any("policy000" in f.name for f in Path("runs/ws/best1").iterdir())


def test_a_full_disk_does_not_end_the_training(caplog, monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(workspace, "write_atomically", full)
    run(compose(GOOD))
    assert caplog.text.count("no comparison at frame") == 2
    assert not Path("runs/ws").exists()  # nothing half-written
    assert list(run_of(0).glob("nn/last_Ant_ep_12_*.pth"))


def test_scalars_show_the_settings():
    run(compose([*GOOD, *ALL_SCALARS]))
    scalars = read_scalars(run_of(0) / "summaries")
    assert "pbt/00_best_objective" in scalars
    assert scalars[f"pbt/{RATE}"].values[0] == pytest.approx(record(0, 1)["params"][RATE])


@pytest.mark.slow
def test_amp_and_sac_are_policies_too(walk_clip):
    debugged = ("pbt.num_policies=1", "pbt.dbg_mode=True", "pbt.mutation_rate=1")
    times = ("pbt.interval_steps=64", "pbt.start_after=0", "pbt.initial_delay=0")
    amp = ["task=HumanoidAMP", *TINY_PBT[1:8], f"task.env.motion_file={walk_clip}"]
    amp += [*TINY_DISCRIMINATOR, f"{CONFIG}.imitation_frequency=0", "max_iterations=8"]
    amp += [f"+{CONFIG}.games_to_track=1", "task.env.episodeLength=4"]
    request = restart_of([*amp, "pbt=pbt_default", *debugged, *times])
    run(compose([*amp, "pbt=pbt_default", *debugged, *times[:1], *request.overrides]))

    folder = Path("cfg/pbt/mutation")
    folder.mkdir(parents=True)
    (folder / "sac.yaml").write_text(f"{CONFIG}.actor_lr: mutate_float\n")
    sac = [*TINY_SAC, "rl_device=cpu", "num_threads=1", "task.env.episodeLength=4"]
    sac += ["pbt=pbt_default", *debugged, *times, "pbt/mutation=sac", "max_iterations=12"]
    with pytest.raises(RestartRequest) as raised:
        run(compose([*sac, "pbt.workspace=sac"], "cfg"))
    words = [*sac, "pbt.workspace=sac", *raised.value.overrides, "pbt.start_after=100000"]
    run(compose(words, "cfg"))
    newest = max(Path("runs/sac/000").glob("*.pth"))
    (group,) = load_checkpoint(newest)["actor_optimizer"]["param_groups"]
    assert group["lr"] == pytest.approx(raised.value.settings[f"{CONFIG}.actor_lr"])
