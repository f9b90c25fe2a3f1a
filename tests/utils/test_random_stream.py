from __future__ import annotations

import torch

from isaacgymenvs_lite.utils.random_stream import RandomStream


def test_an_unseeded_stream_is_that_of_everybody():
    torch.manual_seed(1)
    expected = torch.rand(4)
    torch.manual_seed(1)
    stream = RandomStream()
    with stream:
        first = torch.rand(2)
    assert torch.equal(torch.cat((first, torch.rand(2))), expected)


def test_a_seeded_stream_goes_on_where_it_was_and_leaves_others_alone():
    torch.manual_seed(1)
    others = torch.rand(4)
    torch.manual_seed(2)
    own = torch.rand(4)
    torch.manual_seed(1)
    stream = RandomStream()
    stream.seed(2)
    drawn = []
    for _ in range(2):
        with stream:
            drawn.append(torch.rand(2))
        drawn.append(torch.rand(2))
    assert torch.equal(torch.cat(drawn[0::2]), own)
    assert torch.equal(torch.cat(drawn[1::2]), others)
