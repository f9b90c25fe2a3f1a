"""Tests the protocol on a real run of two epochs, whose policy falls within a second."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks import evaluate as command
from benchmarks import protocol
from benchmarks.protocol import EPISODES, SpeedProbe, evaluate_checkpoint
from benchmarks.records import read_records
from benchmarks.runs import Run, start_now
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.runner import run as train
from tests.tiny import CONFIG, TINY_AMP


def train_run(folder: Path, clip: Path, units: str = "[16,8]") -> Run:
    """Train with short episodes from the default pose, which differ from the protocol."""
    settings = [
        *TINY_AMP,
        "seed=5",
        f"task.env.motion_file={clip}",
        "task.env.episodeLength=4",
        "task.env.stateInit=Default",
        f"train.params.network.mlp.units={units}",
    ]
    own = ["+full_experiment_name=walk_seed5", f"+{CONFIG}.train_dir={folder}"]
    train(compose([*settings, *own]))
    run = Run.of(folder, "walk", 5)
    run.note_start(start_now(settings, "train.py", [0]))
    return run


@pytest.fixture(scope="module")
def trained(walk_clip, tmp_path_factory) -> Run:
    return train_run(tmp_path_factory.mktemp("runs"), walk_clip)


@pytest.fixture(autouse=True, scope="module")
def torch_threads():
    """Restore the number of threads, which a run changes for the whole process."""
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def checkpoint_of(run: Run) -> Path:
    checkpoint = run.newest_checkpoint()
    assert checkpoint is not None
    return checkpoint


def test_the_protocol_sets_the_episodes_whatever_the_run_had(trained):
    outcome = evaluate_checkpoint(checkpoint_of(trained))
    result = outcome.imitation
    assert result.num_episodes == EPISODES
    # The policy falls after more steps than the run's episodes had, from 32 phases of the clip.
    assert result.no_fall_share == 0.0
    assert 4 < result.mean_episode_steps < 200
    assert len(set(result.per_episode)) == EPISODES
    assert 0.0 < result.pose_error_m < 1.0
    assert outcome.clip_speed_m_s == pytest.approx(1.0, abs=1e-4)
    # The clip walks at 1 m/s.
    assert 0.1 < outcome.speed_m_s < 3.0


def test_the_same_seed_gives_the_same_numbers_and_another_does_not(trained):
    first, again, other = (
        evaluate_checkpoint(checkpoint_of(trained), seed).imitation for seed in (1, 1, 2)
    )
    assert first.per_episode.tolist() == again.per_episode.tolist()
    assert first.per_episode.tolist() != other.per_episode.tolist()


def test_every_policy_starts_from_the_same_states(trained, walk_clip, tmp_path, monkeypatch):
    starts = []
    evaluate = protocol.evaluate

    def evaluate_and_note(env, policy, *arguments, **others):
        def noting_policy(obs):
            if len(starts) == len(played):
                starts.append(obs["obs"].clone())
            return policy(obs)

        return evaluate(env, noting_policy, *arguments, **others)

    monkeypatch.setattr(protocol, "evaluate", evaluate_and_note)
    played: list[Run] = []
    # A network of another size draws other random values.
    for run in (trained, train_run(tmp_path, walk_clip, units="[20,4]")):
        evaluate_checkpoint(checkpoint_of(run))
        played.append(run)
    assert starts[0].shape == (EPISODES, 105)
    assert starts[0].equal(starts[1])


def test_record_of_a_run(trained, tmp_path, capsys):
    record = command.measure(trained)
    command.keep(record, tmp_path)
    assert (record.experiment, record.seed, record.run) == ("walk", 5, "walk_seed5")
    assert (record.frames, record.epoch) == (32, 2)
    assert record.minutes is not None and 0.0 < record.minutes < 1.0
    assert (record.minutes_to_280, record.frames_to_280) == (None, None)
    assert record.settings is not None
    assert "task.env.motion_file=walk.npz" in record.settings  # without its folder
    assert record.cores == 1
    assert read_records(tmp_path / "walk.jsonl") == [record]
    assert capsys.readouterr().out.splitlines()[0] == str(record)


def test_command_line(trained, tmp_path, capsys, monkeypatch):
    target = str(checkpoint_of(trained))
    arguments = ["evaluate", target, "--evaluation-seed", "3", "--markdown"]
    monkeypatch.setattr("sys.argv", arguments)
    command.main()
    line, header, _, row = capsys.readouterr().out.splitlines()
    assert line.startswith("walk seed 5: 0.00 M frames")
    assert header.startswith("| experiment | seeds |")
    assert row.startswith("| walk | 1 |")

    monkeypatch.setattr("sys.argv", ["evaluate", "run", "--runs-dir", str(tmp_path)])
    with pytest.raises(SystemExit, match="error: 'run': neither a run folder"):
        command.main()


# --- speed ------------------------------------------------------------------------------------


def test_speed_by_hand():
    probe = SpeedProbe(2, dt_s=0.5)
    # Environment 0 moves 3 m and 1 m in 0.5 s each. Environment 1 ends after 5 m in 0.5 s.
    ways = [
        ([[0, 0, 1], [0, 0, 1]], [0, 0]),
        ([[3, 0, 9], [3, 4, 1]], [0, 1]),
        ([[3, 1, 0], [90, 90, 90]], [0, 0]),
    ]
    for positions, dones in ways:
        probe.step(torch.tensor(positions, dtype=torch.float32), torch.tensor(dones))
    assert probe.mean_m_s() == pytest.approx(((3 + 1) / 1.0 + 5 / 0.5) / 2)
