from __future__ import annotations

import torch

from isaacgymenvs_lite.isaacgymenvs_compat.rna_util import RandomNetworkAdversary


def test_probabilities_of_bins_differ_between_environments_until_masks_are_drawn() -> None:
    torch.manual_seed(3)
    network = RandomNetworkAdversary(4, in_dims=3, out_dims=2, softmax_bins=8, device="cpu")
    same = torch.ones(4, 3)
    with torch.no_grad():
        first = network(same)
        again = network(same)
        network.refresh_dropout_masks()
        later = network(same)
    assert first.shape == (4, 2, 8)
    torch.testing.assert_close(first.sum(-1), torch.ones(4, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first[0], first[1])  # an own mask each
    assert not torch.equal(first, later)
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    assert shapes["fc2.weight"] == (1024, 512)
    assert shapes["fc3.weight"] == (16, 1024)
