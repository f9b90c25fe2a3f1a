from __future__ import annotations

import argparse
from dataclasses import dataclass

import pytest

from isaacgymenvs_lite.command_line import read_settings, run_command
from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.schema import setting


@dataclass(frozen=True, kw_only=True)
class Settings:
    names: tuple[str, ...] = setting([])
    seconds: float = setting(5.0, above=0)
    out: str = setting("demo")


def test_values_are_read_as_in_yaml():
    assert read_settings(Settings, []) == Settings()
    words = ["names=[walk,run]", "seconds=2", "out=a/b.c=d"]
    assert read_settings(Settings, words) == Settings(
        names=("walk", "run"), seconds=2.0, out="a/b.c=d"
    )


def test_a_mistake_is_one_line():
    for word, message in [
        ("walk", "'walk': expected key=value; keys: names, seconds, out"),
        ("second=2", "unknown key 'second' (did you mean 'seconds'?)"),
        ("seconds=long", "seconds"),
        ("seconds=0", "seconds"),
        ("names=[walk", "not valid YAML"),
    ]:
        with pytest.raises(ConfigError) as caught:
            read_settings(Settings, [word])
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_command_runs_its_action():
    seen = []
    assert run_command(argparse.ArgumentParser(), Settings, seen.append, ["seconds=3"]) == 0
    assert seen == [Settings(seconds=3.0)]


def test_a_users_mistake_ends_with_exit_code_2(capsys):
    def action(settings: Settings) -> None:
        raise CheckpointError("no such file")

    with pytest.raises(SystemExit) as caught:
        run_command(argparse.ArgumentParser(), Settings, action, [])
    assert caught.value.code == 2
    assert capsys.readouterr().err == "error: no such file\n"


def test_ctrl_c_ends_with_exit_code_130(capsys):
    def action(settings: Settings) -> None:
        raise KeyboardInterrupt

    assert run_command(argparse.ArgumentParser(), Settings, action, []) == 130
    assert capsys.readouterr().err == ""
