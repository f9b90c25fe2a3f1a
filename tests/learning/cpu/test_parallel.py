"""Slices against the whole: the same numbers and gradients, whatever the number of threads."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.cpu.parallel import NetworkExecutor, attach_executor
from isaacgymenvs_lite.learning.losses import input_gradient

ROWS = 512


class Net(nn.Module):
    """Shaped like rl_games' networks: a dictionary in; mean, spread, value and no state out."""

    row_functions = ("eval_disc", "eval_disc_with_gradient")

    def __init__(self, layer: nn.Module | None = None) -> None:
        super().__init__()
        self.mu = nn.Sequential(nn.Linear(6, 16), nn.ReLU(), nn.Linear(16, 3))
        self.value = nn.Linear(6, 1)
        self.disc = nn.Sequential(nn.Linear(4, 16), nn.ReLU(), nn.Linear(16, 1))
        self.sigma = nn.Parameter(torch.zeros(3), requires_grad=False)
        self.layer = layer or nn.Identity()
        self.seen: list[int] = []

    def forward(self, inputs: dict[str, Any]) -> tuple[Any, ...]:
        obs = inputs["obs"]
        self.seen.append(len(obs))
        mu = self.mu(self.layer(obs)) * inputs.get("factor", 1.0)
        if "latents" in inputs:
            mu = mu + inputs["latents"]
        return mu, torch.zeros_like(mu) + self.sigma, self.value(obs), None

    def eval_disc(self, rows: Tensor) -> Tensor:
        return self.disc(rows)

    def eval_disc_with_gradient(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            rows = rows.detach().requires_grad_()
            logits = self.eval_disc(rows)
        return logits, input_gradient(logits, rows)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def net() -> Net:
    torch.manual_seed(3)
    return Net()


def attached(net: Net, threads: int, bfloat16: bool = False) -> Net:
    NetworkExecutor("cpu", bfloat16, threads).attach(net)
    net.seen.clear()
    return net


def loss_of(net: Net, inputs: dict[str, Any], amp: Tensor) -> Tensor:
    mu, sigma, value, state = net(inputs)
    assert state is None
    logits, gradient = net.eval_disc_with_gradient(amp)
    terms = (mu * mu + sigma).mean(), value.square().mean(), net.eval_disc(amp).sigmoid().mean()
    return sum(terms, logits.exp().mean() + gradient.square().sum(-1).mean())


def gradients(net: Net, *args: Any) -> dict[str, Tensor]:
    net.zero_grad(set_to_none=True)
    loss_of(net, *args).backward()
    return {name: p.grad.clone() for name, p in net.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("threads", [2, 3])
def test_slices_give_the_outputs_and_gradients_of_the_whole(net, threads):
    inputs = {"obs": random(ROWS, 6), "latents": random(ROWS, 3, seed=1), "factor": 2.0}
    amp = random(ROWS, 4, seed=2)
    whole = [x for x in net(inputs) if x is not None]
    expected = gradients(net, inputs, amp)
    attached(net, threads)
    outputs = [x for x in net(inputs) if x is not None]
    assert sorted(net.seen) == sorted(len(x) for x in torch.arange(ROWS).tensor_split(threads))
    for own, other in zip(outputs, whole, strict=True):
        # a matrix product over fewer rows may add up in another order
        torch.testing.assert_close(own, other, rtol=1e-5, atol=1e-6)
    assert [x.requires_grad for x in outputs] == [x.requires_grad for x in whole]
    found = gradients(net, inputs, amp)
    assert found.keys() == expected.keys()
    assert "sigma" not in found
    for name, gradient in expected.items():
        torch.testing.assert_close(found[name], gradient, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_a_loss_of_slices_has_the_gradients_of_the_loss_of_the_whole(net, threads):
    rows = {"obs": random(ROWS, 6), "amp": random(ROWS // 4, 4, seed=2)}

    def loss_and_values(part: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        assert 4 * len(part["amp"]) == len(part["obs"])  # the same share of both
        loss = loss_of(net, {"obs": part["obs"]}, part["amp"])
        return loss, {"loss": loss, "obs": part["obs"] + 1.0}

    expected = gradients(net, {"obs": rows["obs"]}, rows["amp"])
    loss = loss_of(net, {"obs": rows["obs"]}, rows["amp"])
    executor = NetworkExecutor("cpu", num_threads=threads)
    executor.attach(net)
    net.seen.clear()
    learned = {name: p for name, p in net.named_parameters() if p.requires_grad}
    found, values = executor.gradients(loss_and_values, rows, list(learned.values()))
    assert len(net.seen) == threads
    assert sum(net.seen) == ROWS
    torch.testing.assert_close(values["loss"], loss.detach(), rtol=1e-5, atol=1e-6)
    assert torch.equal(values["obs"], rows["obs"] + 1.0)
    for name, gradient in zip(learned, found, strict=True):
        torch.testing.assert_close(gradient, expected[name], rtol=1e-4, atol=1e-6)


def test_a_parameter_that_the_loss_does_not_depend_on_has_no_gradient(net):
    executor = NetworkExecutor("cpu", num_threads=2)

    def value_only(part: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        return net.value(part["obs"]).mean(), {}

    learned = {name: p for name, p in net.named_parameters() if p.requires_grad}
    rows = {"obs": random(ROWS, 6)}
    found, _ = executor.gradients(value_only, rows, list(learned.values()))
    with_gradient = {name for name, grad in zip(learned, found, strict=True) if grad is not None}
    assert with_gradient == {"value.weight", "value.bias"}


def test_repeated_evaluations_are_bit_identical(net):
    attached(net, 2)
    args = {"obs": random(ROWS, 6)}, random(ROWS, 4)
    first = gradients(net, *args)
    for _ in range(5):
        again = gradients(net, *args)
        assert all(torch.equal(again[name], value) for name, value in first.items())


def test_rows_can_be_differentiated_too(net):
    obs = random(ROWS, 6).requires_grad_()
    net.mu(obs).square().sum().backward()
    expected, obs.grad = obs.grad, None
    executor = NetworkExecutor("cpu", num_threads=2)
    (mu,) = executor.run(net, lambda rows: (net.mu(rows),), obs)
    mu.square().sum().backward()
    torch.testing.assert_close(obs.grad, expected, rtol=1e-5, atol=1e-6)


def test_without_gradients_nothing_is_kept(net):
    attached(net, 2)
    with torch.no_grad():
        mu, *_ = net({"obs": random(ROWS, 6)})
        disc = net.eval_disc(random(ROWS, 4))
    assert net.seen == [ROWS // 2] * 2
    assert not mu.requires_grad
    assert not disc.requires_grad


def test_a_few_rows_stay_together(net):
    attached(net, 2)
    net({"obs": random(100, 6)})
    assert net.seen == [100]


@pytest.mark.parametrize("layer", [nn.Dropout(0.5), nn.BatchNorm1d(6)])
def test_layers_that_mix_rows_or_draw_numbers_are_not_sliced(layer):
    net = attached(Net(layer), 2)
    net({"obs": random(ROWS, 6)})
    assert net.seen == [ROWS]


def test_bfloat16_inside_and_float32_outside(net):
    dtypes = []
    net.value.register_forward_hook(lambda module, args, out: dtypes.append(out.dtype))
    inputs = {"obs": random(ROWS, 6)}
    exact = net(inputs)
    dtypes.clear()
    attached(net, 2, bfloat16=True)
    rough = net(inputs)
    assert dtypes == [torch.bfloat16] * 2
    for own, other in zip(rough[:3], exact[:3], strict=True):
        assert own.dtype == torch.float32
        # eight bits of mantissa, a few products deep
        torch.testing.assert_close(own, other, rtol=0.05, atol=0.02)
    loss_of(net, inputs, random(ROWS, 4)).backward()
    assert {p.grad.dtype for p in net.parameters() if p.grad is not None} == {torch.float32}


def test_an_error_in_any_slice_reaches_the_caller(net):
    executor = NetworkExecutor("cpu", num_threads=2)

    def fails(rows: Tensor) -> tuple[Tensor, ...]:
        if rows[0, 0] > 1:
            raise ValueError("the second slice")
        return (rows,)

    rows = torch.arange(2.0 * ROWS).view(-1, 1)
    with pytest.raises(ValueError, match="the second slice"):
        executor.run(net, fails, rows)
    (good,) = executor.run(net, lambda rows: (rows,), rows)
    assert torch.equal(good, rows)


def test_torch_keeps_its_number_of_threads(net):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        executor = attach_executor(net, "cpu", False)
        assert executor.num_threads == 2
        net({"obs": random(ROWS, 6)})
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_the_key_of_the_precision_is_checked(net):
    with pytest.raises(ConfigError, match="mixed_precision='sometimes'"):
        attach_executor(net, "cpu", "sometimes")
    assert attach_executor(net, "cpu", True).bfloat16 is True
