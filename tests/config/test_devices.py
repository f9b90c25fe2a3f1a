import pytest
import torch

from isaacgymenvs_lite.config.devices import check_device
from isaacgymenvs_lite.errors import DeviceError


@pytest.fixture
def two_gpus(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)


@pytest.mark.parametrize("name", ["cpu", "cuda", "cuda:0", "cuda:1"])
def test_existing_devices(two_gpus, name):
    check_device(name, "rl_device")


def test_index_beyond_the_last_gpu_lists_the_devices(two_gpus):
    with pytest.raises(
        DeviceError, match=r"rl_device=cuda:2: this machine has cpu, cuda:0, cuda:1"
    ):
        check_device("cuda:2", "rl_device")


@pytest.mark.parametrize("name", ["", "gpu", "CUDA:0", "cuda:", "cuda:-1", "cuda:0 ", "cpu:0", "1"])
def test_misspelt_devices(two_gpus, name):
    with pytest.raises(DeviceError, match="expected cpu, cuda or cuda:N"):
        check_device(name, "sim_device")
