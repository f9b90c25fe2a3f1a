import pytest
import torch

from isaacgymenvs_lite.config.launch import allow_cpu_fallback, check_device, check_device_name
from isaacgymenvs_lite.errors import DeviceError


@pytest.fixture
def two_gpus(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)


def test_existing_devices(two_gpus):
    for name in ["cpu", "cuda", "cuda:0", "cuda:1"]:
        assert check_device(name, "rl_device") == name


def test_index_beyond_the_last_gpu_lists_the_devices(two_gpus):
    with pytest.raises(
        DeviceError, match=r"rl_device=cuda:2: this machine has cpu, cuda:0, cuda:1"
    ):
        check_device("cuda:2", "rl_device")


def test_misspelt_devices(two_gpus):
    for name in ["", "gpu", "CUDA:0", "cuda:", "cuda:-1", "cuda:0 ", "cpu:0", "1"]:
        with pytest.raises(DeviceError, match="expected cpu, cuda or cuda:N"):
            check_device(name, "sim_device")


def test_names_are_read_without_looking_at_the_machine():
    indices = {name: check_device_name(name, "sim_device") for name in ("cpu", "cuda", "cuda:7")}
    assert indices == {"cpu": None, "cuda": 0, "cuda:7": 7}


def test_the_cpu_replaces_a_missing_gpu_where_that_is_allowed(monkeypatch, caplog, request):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DeviceError, match="torch sees no GPU on this machine; use rl_device=cpu"):
        check_device("cuda:0", "rl_device")
    request.addfinalizer(lambda: allow_cpu_fallback(False))
    allow_cpu_fallback()
    assert [check_device("cuda:0", "rl_device") for _ in range(3)] == ["cpu"] * 3
    expected = "rl_device=cuda:0: torch sees no GPU on this machine; the CPU is used"
    assert caplog.messages == [expected]
    with pytest.raises(DeviceError, match="expected cpu, cuda or cuda:N"):
        check_device("gpu", "rl_device")
