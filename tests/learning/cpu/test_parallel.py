"""Slices against the whole: the same numbers and gradients, whatever the number of threads."""

from __future__ import annotations

import copy
import io
import pickle
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.cpu.parallel import (
    NetworkExecutor,
    ParallelNetwork,
    evaluate_in_chunks,
    parallelize,
    serial_network,
    split_proportionally,
    sum_gradients,
)
from isaacgymenvs_lite.learning.modules.discriminator import input_gradient

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


class Model(nn.Module):
    """Shaped like rl_games' models."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.a2c_network = network


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def net() -> Net:
    torch.manual_seed(3)
    return Net()


def loss_of(net: Any, inputs: dict[str, Any], amp: Tensor) -> Tensor:
    mu, sigma, value, state = net(inputs)
    assert state is None
    logits, gradient = net.eval_disc_with_gradient(amp)
    terms = (mu * mu + sigma).mean(), value.square().mean(), net.eval_disc(amp).sigmoid().mean()
    return sum(terms, logits.exp().mean() + gradient.square().sum(-1).mean())


def gradients(net: Any, *args: Any) -> dict[str, Tensor]:
    net.zero_grad(set_to_none=True)
    loss_of(net, *args).backward()
    return {name: p.grad.clone() for name, p in net.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("threads", [2, 3])
def test_slices_give_the_outputs_and_gradients_of_the_whole(net, threads):
    inputs = {"obs": random(ROWS, 6), "latents": random(ROWS, 3, seed=1), "factor": 2.0}
    amp = random(ROWS, 4, seed=2)
    whole = [x for x in net(inputs) if x is not None]
    expected = gradients(net, inputs, amp)
    net.seen.clear()
    parallel = ParallelNetwork(net, "cpu", num_threads=threads)
    outputs = [x for x in parallel(inputs) if x is not None]
    assert sorted(net.seen) == sorted(len(x) for x in torch.arange(ROWS).tensor_split(threads))
    for own, other in zip(outputs, whole, strict=True):
        # a matrix product over fewer rows may add up in another order
        torch.testing.assert_close(own, other, rtol=1e-5, atol=1e-6)
    assert [x.requires_grad for x in outputs] == [x.requires_grad for x in whole]
    found = gradients(parallel, inputs, amp)
    assert found.keys() == expected.keys()
    assert "sigma" not in found
    for name, gradient in expected.items():
        torch.testing.assert_close(found[name], gradient, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_a_loss_of_slices_has_the_gradients_of_the_loss_of_the_whole(net, threads):
    rows = {"obs": random(ROWS, 6), "amp": random(ROWS // 4, 4, seed=2)}

    def loss_and_values(part: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        assert 4 * len(part["amp"]) == len(part["obs"])  # the same share of both
        loss = loss_of(parallel, {"obs": part["obs"]}, part["amp"])
        return loss, {"loss": loss, "obs": part["obs"] + 1.0}

    expected = gradients(net, {"obs": rows["obs"]}, rows["amp"])
    loss = loss_of(net, {"obs": rows["obs"]}, rows["amp"])
    parallel = ParallelNetwork(net, "cpu", num_threads=threads)
    net.seen.clear()
    learned = {name: p for name, p in net.named_parameters() if p.requires_grad}
    found, values = parallel.executor.gradients(loss_and_values, rows, list(learned.values()))
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
    parallel = ParallelNetwork(net, "cpu", num_threads=2)
    args = {"obs": random(ROWS, 6)}, random(ROWS, 4)
    first = gradients(parallel, *args)
    for _ in range(5):
        again = gradients(parallel, *args)
        assert all(torch.equal(again[name], value) for name, value in first.items())


def test_with_deterministic_algorithms_threads_change_no_bit(net, monkeypatch):
    monkeypatch.setattr(torch, "are_deterministic_algorithms_enabled", lambda: True)
    args = {"obs": random(8 * ROWS, 6)}, random(8 * ROWS, 4)
    one, *others = (
        gradients(ParallelNetwork(net, "cpu", num_threads=num_threads), *args)
        for num_threads in (1, 2, 3)
    )
    assert max(net.seen) == 2 * ROWS
    for other in others:
        assert all(torch.equal(other[name], value) for name, value in one.items())


def test_rows_can_be_differentiated_too(net):
    obs = random(ROWS, 6).requires_grad_()
    net.mu(obs).square().sum().backward()
    expected, obs.grad = obs.grad, None
    executor = NetworkExecutor("cpu", num_threads=2)
    (mu,) = executor.run(net, lambda rows: (net.mu(rows),), obs)
    mu.square().sum().backward()
    torch.testing.assert_close(obs.grad, expected, rtol=1e-5, atol=1e-6)


def test_without_gradients_nothing_is_kept(net):
    parallel = ParallelNetwork(net, "cpu", num_threads=2)
    with torch.no_grad():
        mu, *_ = parallel({"obs": random(ROWS, 6)})
        disc = parallel.eval_disc(random(ROWS, 4))
    assert net.seen == [ROWS // 2] * 2
    assert not mu.requires_grad
    assert not disc.requires_grad


def test_a_few_rows_stay_together(net):
    ParallelNetwork(net, "cpu", num_threads=2)({"obs": random(100, 6)})
    assert net.seen == [100]


@pytest.mark.parametrize(
    ("num_rows", "slices"),
    [(512, 1), (2048, 2), (8192, 4), (32_768, 8), (2**19, 16)],  # the root of rows / 500, cut off
)
def test_slices_are_few_enough_to_pay(net, num_rows, slices):
    executor = NetworkExecutor("cpu", num_threads=16, row_products=600_000)
    seen: list[int] = []

    def keep(rows: Tensor) -> tuple[Tensor, ...]:
        seen.append(len(rows))
        return (rows,)

    with torch.no_grad():
        executor.run(net, keep, torch.zeros(num_rows, 1))
    assert seen == [num_rows // slices] * slices


def test_a_small_network_is_computed_whole(net):
    """16 slices of 128 rows took several times as long as all rows at once."""
    before = torch.get_num_threads()
    torch.set_num_threads(16)
    try:
        model = Model(net)
        parallelize(model, "cpu", False)
        model.a2c_network({"obs": random(16 * ROWS, 6)})
    finally:
        torch.set_num_threads(before)
    assert net.seen == [16 * ROWS]


@pytest.mark.parametrize("layer", [nn.Dropout(0.5), nn.BatchNorm1d(6)])
def test_layers_that_mix_rows_or_draw_numbers_are_not_sliced(layer):
    net = Net(layer)
    parallel = ParallelNetwork(net, "cpu", num_threads=2)
    parallel({"obs": random(ROWS, 6)})
    assert net.seen == [ROWS]
    assert parallel.executor.num_threads == 1


def test_bfloat16_inside_and_float32_outside(net):
    dtypes = []
    net.value.register_forward_hook(lambda module, args, out: dtypes.append(out.dtype))
    inputs = {"obs": random(ROWS, 6)}
    exact = net(inputs)
    dtypes.clear()
    parallel = ParallelNetwork(net, "cpu", bfloat16=True, num_threads=2)
    rough = parallel(inputs)
    assert dtypes == [torch.bfloat16] * 2
    for own, other in zip(rough[:3], exact[:3], strict=True):
        assert own.dtype == torch.float32
        # eight bits of mantissa, a few products deep
        torch.testing.assert_close(own, other, rtol=0.05, atol=0.02)
    loss_of(parallel, inputs, random(ROWS, 4)).backward()
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
        model = Model(net)
        assert parallelize(model, "cpu", False).num_threads == 2
        ParallelNetwork(net, "cpu", num_threads=2)({"obs": random(ROWS, 6)})
        assert net.seen == [ROWS // 2] * 2
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.usefixtures("bfloat16")
def test_the_key_of_the_precision_is_checked(net):
    with pytest.raises(ConfigError, match="mixed_precision='sometimes'"):
        parallelize(Model(net), "cpu", "sometimes")
    assert parallelize(Model(net), "cpu", True).bfloat16 is True


# --- the network that a model holds -----------------------------------------------------------


def test_a_model_keeps_the_names_of_its_parameters_and_its_checkpoints(net):
    model = Model(net)
    state = {name: value.clone() for name, value in model.state_dict().items()}
    names = [name for name, _ in model.named_parameters()]
    parallelize(model, "cpu", False)
    assert isinstance(model.a2c_network, ParallelNetwork)
    assert list(model.state_dict()) == list(state)
    assert [name for name, _ in model.named_parameters()] == names
    assert all(map(torch.equal, model.state_dict().values(), state.values()))
    model.load_state_dict({name: torch.full_like(value, 0.5) for name, value in state.items()})
    assert net.value.weight.unique().tolist() == [0.5]


def test_everything_else_is_the_network_s_own(net):
    parallel = ParallelNetwork(net, "cpu", num_threads=2)
    assert parallel.value is net.value
    assert parallel.sigma is net.sigma
    assert parallel.seen is net.seen
    parallel.seen = [7]
    assert net.seen == [7]
    parallel.eval()
    assert (parallel.training, net.training, net.value.training) == (False,) * 3
    model = Model(parallel)
    model.train()
    assert (parallel.training, net.training, net.value.training) == (True,) * 3
    model.to(torch.float64)
    assert {p.dtype for p in net.parameters()} == {torch.float64}
    with pytest.raises(AttributeError, match="'Net' object has no attribute 'eval_encoder'"):
        parallel.eval_encoder(random(ROWS, 6))


def test_no_method_of_the_network_is_replaced(net):
    before = dict(vars(net))
    parallelize(Model(net), "cpu", False)
    assert vars(net) == before


def test_a_copy_has_parameters_and_threads_of_its_own(net):
    parallel = ParallelNetwork(net, "cpu", num_threads=2)
    inputs = {"obs": random(ROWS, 6)}
    expected = parallel(inputs)
    file = io.BytesIO(pickle.dumps(parallel))
    for other in (copy.deepcopy(parallel), pickle.load(file)):
        assert other.executor is not parallel.executor
        assert other.executor.num_threads == 2
        assert all(map(torch.equal, other(inputs)[:3], expected[:3]))
        other.value.bias.data.add_(1.0)
        torch.testing.assert_close(other(inputs)[2], expected[2] + 1.0)
        assert torch.equal(parallel(inputs)[2], expected[2])


def test_other_runtimes_get_the_network_itself(net):
    assert serial_network(ParallelNetwork(net, "cpu", num_threads=2)) is net
    assert serial_network(net) is net


# --- slices of rows ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lengths", "asked", "expected"),
    [
        ((12, 4), 2, [(6, 2), (6, 2)]),
        ((12, 4), 3, [(3, 1), (3, 1), (6, 2)]),
        ((12, 4), 9, [(3, 1)] * 4),
        ((12, 5), 4, [(12, 5)]),  # no common divisor
        ((7,), 2, [(3,), (4,)]),
    ],
)
def test_every_slice_has_the_same_share_of_all_tensors(lengths, asked, expected):
    rows = {str(i): torch.arange(n) for i, n in enumerate(lengths)}
    parts, shares = split_proportionally(rows, asked)
    assert [tuple(len(t) for t in part.values()) for part in parts] == expected
    assert shares == pytest.approx([part[0] / lengths[0] for part in expected])
    assert sum(shares) == pytest.approx(1.0)
    for name, tensor in rows.items():
        assert torch.equal(torch.cat([part[name] for part in parts]), tensor)


def test_gradients_that_a_slice_does_not_have_count_as_zero():
    one = torch.ones(2)
    assert sum_gradients((None, None)) is None
    assert torch.equal(sum_gradients((None, one, 2 * one)), 3 * one)
    assert torch.equal(sum_gradients((one, None)), one)


def test_more_rows_than_a_chunk_come_back_in_order_and_shape():
    rows = torch.arange(2.0 * 9000 * 3).view(2, 9000, 3).requires_grad_()
    seen: list[int] = []

    def sums(chunk: torch.Tensor) -> torch.Tensor:
        seen.append(len(chunk))
        return chunk.sum(dim=-1, keepdim=True).bfloat16()

    result = evaluate_in_chunks(sums, rows)
    assert seen == [8192, 8192, 1616]
    assert result.dtype == torch.float32
    assert not result.requires_grad
    assert torch.equal(result, rows.detach().sum(dim=-1, keepdim=True).bfloat16().float())
