from pathlib import Path

import pytest

from isaacgymenvs_lite import paths


def test_checkout_has_its_data_beside_the_package():
    repository = Path(paths.__file__).resolve().parents[1]
    assert paths.cfg_dir() == repository / "cfg"
    assert paths.assets_dir() == repository / "assets"


def test_working_directory_plays_no_part(tmp_path, monkeypatch):
    before = paths.cfg_dir()
    (tmp_path / "cfg").mkdir()
    (tmp_path / "cfg" / "config.yaml").touch()
    monkeypatch.chdir(tmp_path)
    assert paths.cfg_dir() == before


def test_wheel_has_its_data_inside_the_package(tmp_path, monkeypatch):
    package = tmp_path / "isaacgymenvs_lite"
    (package / "assets" / "mjcf").mkdir(parents=True)
    (tmp_path / "assets" / "mjcf").mkdir(parents=True)  # another package's, in site-packages
    monkeypatch.setattr(paths, "_PACKAGE_DIR", package)
    assert paths.assets_dir() == package / "assets"


def test_unrelated_folder_of_the_same_name_is_not_taken(tmp_path, monkeypatch):
    (tmp_path / "cfg").mkdir()
    monkeypatch.setattr(paths, "_PACKAGE_DIR", tmp_path / "isaacgymenvs_lite")
    with pytest.raises(FileNotFoundError, match=r"'cfg'.*config\.yaml.*reinstall"):
        paths.cfg_dir()
