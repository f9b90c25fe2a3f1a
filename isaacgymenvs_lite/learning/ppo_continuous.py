"""rl_games' own PPO with what makes learning on a CPU fast here."""

from __future__ import annotations

from typing import Any

import torch

from isaacgymenvs_lite.config.train_params import torch_compile_setting
from isaacgymenvs_lite.learning.cpu.parallel import parallelize
from isaacgymenvs_lite.learning.cpu.precision import resolve_mixed_precision
from isaacgymenvs_lite.learning.modules.running_mean_std import replace_normalizers
from isaacgymenvs_lite.learning.safeguards import PPOSafeguards


class PPOAgent(PPOSafeguards):
    """The agent of `algo: name: a2c_continuous`: rl_games' loops, losses and checkpoints.

    On a CPU a `ParallelNetwork` evaluates its networks, the asymmetric critic's too, as in our own
    agents; on a GPU it is rl_games' agent as it is.

    Args:
        base_name: name for rl_games' bookkeeping.
        params: the section `params` of a train file, prepared by the Runner.

    Raises:
        ConfigError: mixed_precision is none of True, False, "auto", or an epoch has one sample.
    """

    def __init__(self, base_name: str, params: dict[str, Any]) -> None:
        config = params["config"]
        device = torch.device(config.get("device", "cuda:0"))
        precision = config.get("mixed_precision", False)
        on_cpu = device.type == "cpu"
        # rl_games' switch means CUDA autocast with a gradient scaler.
        config["mixed_precision"] = not on_cpu and resolve_mixed_precision(precision, device)
        asked = config.get("torch_compile")
        config["torch_compile"] = torch_compile_setting(asked, device.type, can_compile=True)
        super().__init__(base_name, params)
        if self.normalize_advantage:
            self._check_batch_size()
        self._sliced = on_cpu and not self.is_rnn
        if not on_cpu:
            return
        models = [self.model]
        if self.has_central_value:
            models.append(self.central_value_net.model)
        for model in models:
            replace_normalizers(model)
            parallelize(model, device, precision)
        if self.normalize_value:
            self.value_mean_std = models[-1].value_mean_std

    def env_reset(self) -> Any:
        """Reset the environment at the start of training.

        What is left beside the sliced networks is too small to be shared by torch's own threads.
        """
        if self._sliced:
            torch.set_num_threads(1)
        return super().env_reset()
