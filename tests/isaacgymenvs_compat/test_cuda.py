"""A script's cuda where there is no GPU; the machine's own GPU plays no part."""

from __future__ import annotations

import torch
from torch import nn

from isaacgymenvs_lite.isaacgymenvs_compat.cuda import CudaIsCpu


def test_tensors_and_modules_stay_on_the_cpu() -> None:
    with CudaIsCpu():
        made = (
            torch.rand(2, device="cuda:0"),
            torch.tensor([1.0], device=torch.device("cuda")),
            torch.arange(3, device="cuda"),
            torch.zeros(2).to("cuda:0"),
            torch.zeros(2).to(device="cuda:1", dtype=torch.float64),
            torch.zeros(2).to(torch.device("cuda"), torch.float64, non_blocking=True),
            torch.zeros(2).cuda(),
            nn.Linear(2, 2).to("cuda:0").weight,
            nn.Linear(2, 2).cuda().weight,
            torch.zeros_like(torch.zeros(2), device="cuda"),
        )
        assert torch.ones(2, device="meta").device.type == "meta"
        assert "cuda" not in f"{torch.zeros(2)}"
    assert {tensor.device.type for tensor in made} == {"cpu"}
    assert [tensor.dtype for tensor in made[4:6]] == [torch.float64] * 2
