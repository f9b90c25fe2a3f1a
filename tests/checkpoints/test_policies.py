from __future__ import annotations

import pytest

from isaacgymenvs_lite.commands.policies import main
from isaacgymenvs_lite.paths import shipped_policies


def test_a_checkpoint_is_packed(full_checkpoint, shipped_dir, caplog):
    with caplog.at_level("INFO"):
        assert main(["pack", f"checkpoint={full_checkpoint}", "name=tiny"]) == 0
    assert shipped_policies() == {"tiny": shipped_dir / "tiny.pth"}
    assert "tiny.pth: HumanoidAMP of walk.npz" in caplog.text
    assert "MiB" in caplog.text


def test_the_newest_checkpoint_is_packed_into_another_folder(full_checkpoint, tmp_path):
    runs = full_checkpoint.parents[2]
    words = ["pack", "checkpoint=last", f"runs={runs}", "name=tiny", f"out={tmp_path / 'mine'}"]
    assert main(words) == 0
    assert (tmp_path / "mine" / "tiny.pth").is_file()


def test_the_list_has_a_line_for_each_policy(full_checkpoint, shipped_dir, capsys):
    assert main(["list"]) == 0
    assert capsys.readouterr().out == ""
    for name in ("second", "first"):
        main(["pack", f"checkpoint={full_checkpoint}", f"name={name}"])
    assert main(["list"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("first ") and second.startswith("second ")
    assert "HumanoidAMP of walk.npz, 0.0 M frames" in first


def test_a_mistake_is_one_line_and_exit_code_2(capsys):
    for words, message in [
        (["checkpoint=none.pth", "name=a"], "no file"),
        (["checkpoint=''", "name=a"], "checkpoint= is empty"),
        (["name=a"], "'checkpoint' is missing"),
        (["checkpiont=a.pth"], "did you mean 'checkpoint'"),
        (["a.pth"], "expected key=value"),
    ]:
        with pytest.raises(SystemExit) as caught:
            main(["pack", *words])
        assert caught.value.code == 2
        shown = capsys.readouterr().err
        assert shown.startswith("error: ")
        assert message in shown
        assert shown.count("\n") == 1
