"""Opens a run of Weights & Biases that mirrors TensorBoard, with IsaacGymEnvs' keys."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

from rl_games.common.algo_observer import AlgoObserver

from isaacgymenvs_lite.config.launch import LaunchSettings
from isaacgymenvs_lite.schema import select

log = logging.getLogger(__name__)

_ATTEMPTS = 3


class WandbObserver(AlgoObserver):
    """Opens a run of wandb before the agent makes the TensorBoard writer that wandb mirrors.

    A failure (no network, no login) is logged, and the training continues without wandb. The run in
    wandb has the name of the run folder unless `wandb_name` differs from the name in the train
    file.
    """

    def __init__(self, tree: dict[str, Any], settings: LaunchSettings, run_name: str) -> None:
        super().__init__()
        self._tree = tree
        self._settings = settings
        self._run_name = run_name
        self._run: Any = None

    def before_init(self, base_name: str, config: dict[str, Any], experiment_name: str) -> None:
        """Open the run in up to three attempts with growing pauses."""
        for attempt in range(1, _ATTEMPTS + 1):
            try:
                self._open()
            except Exception as error:  # no error of wandb may end a training
                log.warning("wandb: attempt %d of %d failed: %s", attempt, _ATTEMPTS, error)
                if attempt < _ATTEMPTS:
                    time.sleep(attempt)
            else:
                return
        log.error("wandb could not be opened; training goes on without it")

    def close(self) -> None:
        """Upload the remaining data and end the run, so that this process can open another run."""
        if self._run is None:
            return
        try:
            self._run.finish()
        except Exception as error:
            log.warning("wandb: the run could not be finished: %s", error)
        self._run = None

    def _open(self) -> None:
        import wandb  # type: ignore[import-not-found]  # the extra [wandb]

        settings = self._settings
        name = settings.wandb_name
        if name in ("", select(self._tree, "train.params.config.name")):
            name = self._run_name
        self._run = wandb.init(
            project=settings.wandb_project,
            entity=settings.wandb_entity or None,
            group=settings.wandb_group or None,
            tags=settings.wandb_tags,
            id=f"uid_{self._run_name}".replace("/", "_"),
            name=name,
            resume="allow",
            sync_tensorboard=True,
            config=self._tree,
        )
        if settings.wandb_logcode_dir:
            self._run.log_code(root=settings.wandb_logcode_dir)


def log_video(path: Path) -> None:
    """Add a video to the open run; a failure is logged."""
    import wandb  # type: ignore[import-not-found]

    if wandb.run is None:
        return
    try:
        wandb.log({"video": wandb.Video(str(path), format="mp4")})
    except Exception as error:  # no error of wandb may end a training
        log.warning("wandb: %s was not added: %s", path, error)
