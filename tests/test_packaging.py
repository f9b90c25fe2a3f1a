"""What a wheel carries, and that the pinned set lies within the declared ranges."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import mujoco
import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import isaacgymenvs_lite

REPOSITORY = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
# Not part of the tested set.
UNPINNED = {"moviepy", "wandb"}


def pins() -> dict[str, str]:
    lines = (REPOSITORY / "constraints.txt").read_text().splitlines()
    entries = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {str(canonicalize_name(name)): version for name, version in entries}


def requirements() -> list[Requirement]:
    extras = PROJECT["optional-dependencies"].values()
    texts = [*PROJECT["dependencies"], *(text for extra in extras for text in extra)]
    return [r for r in map(Requirement, texts) if r.name not in (PROJECT["name"], *UNPINNED)]


def test_every_dependency_is_pinned_within_its_range():
    for requirement in requirements():
        version = pins()[str(canonicalize_name(requirement.name))]
        assert requirement.specifier.contains(version), requirement


def test_pins_name_versions_that_any_machine_can_get():
    for name, version in pins().items():
        assert re.fullmatch(r"[0-9][0-9a-z.]*", version), f"{name}=={version}"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    result = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    (file,) = folder.glob("*.whl")
    return file


@pytest.mark.slow
def test_the_wheel_of_the_sdist_is_the_same(wheel, tmp_path):
    def build(kind: str, folder: Path, out: Path) -> Path:
        command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(out)]
        subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
        return next(file for file in out.iterdir() if file.is_file())

    archive = build("sdist", REPOSITORY, tmp_path / "dist")
    with tarfile.open(archive) as sdist:
        sdist.extractall(tmp_path / "unpacked", filter="data")
    (folder,) = (tmp_path / "unpacked").iterdir()
    for name in ("docs/getting_started.md", "CHANGELOG.md", "tests/conftest.py", ".ci/run"):
        assert (folder / name).is_file(), name
    again = build("wheel", folder, tmp_path / "again")
    assert set(zipfile.ZipFile(again).namelist()) == set(zipfile.ZipFile(wheel).namelist())


def test_wheel_carries_configuration_and_assets(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    data = [
        file.relative_to(REPOSITORY).as_posix()
        for folder in ("cfg", "assets")
        for file in (REPOSITORY / folder).rglob("*")
        if file.is_file()
    ]
    assert "cfg/config.yaml" in data
    assert "assets/mjcf/amp_humanoid.xml" in data
    assert {f"isaacgymenvs_lite/{name}" for name in data} <= names
    assert "isaacgymenvs_lite/train.py" in names
    assert {name.split("/")[0] for name in names} <= {"isaacgymenvs_lite", info_folder()}
    assert not [name for name in names if "synthesis" in name]


def info_folder() -> str:
    return f"isaacgymenvs_lite-{isaacgymenvs_lite.__version__}.dist-info"


def test_models_of_the_wheel_compile(wheel, tmp_path):
    # They include files of their subfolder parts.
    zipfile.ZipFile(wheel).extractall(tmp_path)
    files = sorted((tmp_path / "isaacgymenvs_lite" / "assets" / "mjcf").glob("*.xml"))
    controls = {file.stem: mujoco.MjModel.from_xml_path(str(file)).nu for file in files}
    assert controls == {
        "amp_humanoid": 28,
        "amp_humanoid_sword_shield": 31,
        "ant": 8,
        "anymal": 12,
        "anymal_minimal": 12,
        "ball_balance": 3,
        "cartpole": 1,
        "g1": 29,
        # Tasks add the drives of arms and hands.
        **dict.fromkeys(("allegro_hand", "franka_panda", "shadow_hand", "trifinger"), 0),
        "sektion_cabinet": 0,
        "humanoid": 21,
        "ingenuity": 6,
        "quadcopter": 12,
        "quadruped": 12,
    }


def test_wheel_states_version_licence_and_command(wheel):
    archive = zipfile.ZipFile(wheel)
    version = isaacgymenvs_lite.__version__
    info = info_folder()
    metadata = archive.read(f"{info}/METADATA").decode()
    assert f"Version: {version}\n" in metadata
    assert "License-Expression: BSD-3-Clause\n" in metadata
    assert f"{info}/licenses/LICENSE" in archive.namelist()
    assert "isaacgymenvs_lite.train:main" in archive.read(f"{info}/entry_points.txt").decode()


def test_unpacked_wheel_finds_its_data(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    code = (
        "from isaacgymenvs_lite.config.compose import compose\n"
        "from isaacgymenvs_lite.paths import cfg_dir, assets_dir\n"
        "print(cfg_dir(), assets_dir(), compose(['num_envs=3']).task.name)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path / "site")},
        capture_output=True,
        text=True,
        check=False,
    )
    inside = tmp_path / "site" / "isaacgymenvs_lite"
    assert result.stdout.split() == [str(inside / "cfg"), str(inside / "assets"), "HumanoidAMP"], (
        result.stderr
    )


def test_the_citation_and_the_templates_can_be_read():
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert citation["version"] == isaacgymenvs_lite.__version__
    files = sorted((REPOSITORY / ".github").rglob("*.yml"))
    assert len(files) >= 4
    for file in files:
        assert isinstance(yaml.safe_load(file.read_text()), dict), file
