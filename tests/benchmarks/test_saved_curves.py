from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.learning_curve import read_learning_curve
from benchmarks.saved_curves import find_saved_curves, load_curve, save_curve
from isaacgymenvs_lite.errors import ConfigError


def test_a_short_curve_is_kept_whole(write_events, tmp_path):
    write_events(tmp_path / "summaries", [None, 20.0, 31.25], poses={2: 0.0625})
    curve = read_learning_curve(tmp_path / "summaries")
    save_curve(curve, tmp_path / "new" / "walk_seed1.json")
    again = load_curve(tmp_path / "new" / "walk_seed1.json")
    assert again.series.keys() == curve.series.keys()
    for name, series in curve.series.items():
        for own, other in zip(
            (again[name].frames, again[name].minutes, again[name].values),
            (series.frames, series.minutes, series.values),
            strict=True,
        ):
            np.testing.assert_allclose(own, other)
    assert len(again["no_fall_share"]) == 0


def test_where_a_run_was_resumed_is_kept(write_events, tmp_path):
    (tmp_path / "config.yaml").write_text("task: {env: {numEnvs: 10}}\n")
    write_events(tmp_path / "summaries", [20.0, 20.0])
    write_events(tmp_path / "summaries", [1.0, 2.0], first_epoch=2, start_s=9_000.0)
    save_curve(read_learning_curve(tmp_path / "summaries"), tmp_path / "walk_seed1.json")
    again = load_curve(tmp_path / "walk_seed1.json")
    assert again.num_envs == 10
    assert again["episode_length"].resumed_at == (200.0,)
    assert again.even("episode_length").values.tolist() == [20.0, 20.0]


def test_of_a_long_curve_the_ends_and_the_first_good_value_are_kept(write_events, tmp_path):
    lengths = [float(i % 7) for i in range(3000)]
    lengths[1234] = 280.0
    lengths[1235] = 290.0
    write_events(tmp_path / "summaries", lengths)
    curve = read_learning_curve(tmp_path / "summaries")
    save_curve(curve, tmp_path / "walk_seed1.json")
    thin = load_curve(tmp_path / "walk_seed1.json")["episode_length"]
    assert 100 <= len(thin) <= 101
    whole = curve["episode_length"]
    assert thin.frames[[0, -1]].tolist() == whole.frames[[0, -1]].tolist()
    assert thin.first_reach(280) == pytest.approx(whole.first_reach(280))
    assert (np.diff(thin.frames) > 0).all()


def test_seeds_of_one_experiment_only(write_events, tmp_path):
    for name, length in (("walk_seed10", 3.0), ("walk_seed2", 2.0), ("walk+fp32_seed1", 1.0)):
        write_events(tmp_path / name, [length])
        save_curve(read_learning_curve(tmp_path / name), tmp_path / f"{name}.json")
    found = [c["episode_length"].last for c in find_saved_curves("walk", tmp_path)]
    assert found == [2.0, 3.0]
    assert len(find_saved_curves("walk+fp32", tmp_path)) == 1
    with pytest.raises(ConfigError, match=r"'run': no saved curve.*walk_seed2"):
        find_saved_curves("run", tmp_path)


def test_a_scalar_that_an_older_file_lacks_has_no_values(write_events, tmp_path):
    write_events(tmp_path / "summaries", [3.0])
    save_curve(read_learning_curve(tmp_path / "summaries"), tmp_path / "walk_seed1.json")
    columns = json.loads((tmp_path / "walk_seed1.json").read_text())
    del columns["fall_rate"]
    (tmp_path / "walk_seed1.json").write_text(json.dumps(columns))
    again = load_curve(tmp_path / "walk_seed1.json")
    assert len(again["fall_rate"]) == 0
    assert again["episode_length"].last == 3.0


def test_frames_and_minutes_are_written_once(write_events, tmp_path):
    """Files of before have them for each series, and are read, too."""
    write_events(tmp_path / "summaries", [20.0, 31.25], poses={1: 0.0625})
    file = tmp_path / "walk_seed1.json"
    save_curve(read_learning_curve(tmp_path / "summaries"), file)
    columns = json.loads(file.read_text())
    clock = columns["fps"][:2]
    assert columns["episode_length"] == ["fps", [20.0, 31.25]]
    assert columns["pose_error_m"][:2] != clock
    columns["episode_length"] = [*clock, [20.0, 31.25]]
    (tmp_path / "before_seed1.json").write_text(json.dumps(columns))
    for name in ("walk", "before"):
        (curve,) = find_saved_curves(name, tmp_path)
        series = curve["episode_length"]
        assert [series.frames.tolist(), series.minutes.tolist()] == clock
        assert series.values.tolist() == [20.0, 31.25]
