"""The model of a robot's task as files beside its policy, for simulators without this package."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import mujoco

from isaacgymenvs_lite.errors import ConfigError, one_line
from isaacgymenvs_lite.tasks.base.mjcf_task import MjcfTask
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.utils.files import written_for_user

log = logging.getLogger(__name__)

_FIRST_LINE = "<!-- Written by isaacgymenvs_lite.export: what the policy was trained in. -->\n"


@dataclass(frozen=True)
class Scene:
    """The robot with its drives and sensors on the floor, as MJCF.

    Attributes:
        path: of the MJCF.
        text: of it.
        assets: contents of meshes and textures by name, in a folder called as `path`.
    """

    path: Path
    text: str
    assets: dict[str, bytes]

    def write(self) -> None:
        """Write all files.

        Raises:
            ConfigError: one cannot be written.
        """
        for name, content in self.assets.items():
            with written_for_user(self.path.with_suffix("") / name, "out") as partial:
                partial.write_bytes(content)
        with written_for_user(self.path, "out") as partial:
            partial.write_text(self.text, encoding="utf-8")


def scene_of(task: VecTask, policy: Path) -> Scene | None:
    """Return what a robot's task simulates, as `<policy>_scene.xml`; None of other tasks.

    None too, with a warning, if MuJoCo cannot write the model: the policy does not need it.

    Args:
        task: of the policy.
        policy: path of the exported policy.

    Raises:
        ConfigError: there is a file of this name that is no earlier scene.
    """
    if not isinstance(task, MjcfTask) or task.robot_description() is None:
        return None
    path = policy.with_name(f"{policy.stem}_scene.xml")
    if path.is_file() and not path.read_bytes().startswith(_FIRST_LINE.encode()):
        raise ConfigError(
            f"{path}: a file that no export wrote has the name of the policy's scene; choose"
            " another out="
        )
    try:
        spec = task.scene()
        if spec is None:
            return None
        assets = dict(spec.assets)
        if assets:
            spec.meshdir = spec.texturedir = path.stem
        return Scene(path, _FIRST_LINE + spec.to_xml(), assets)
    except (ValueError, mujoco.FatalError) as error:
        log.warning("%s: left out, MuJoCo cannot write it: %s", path, one_line(error))
        return None
