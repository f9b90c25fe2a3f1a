from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F

from isaacgymenvs_lite.learning.gen_amp_models import ModelGenAMPContinuous
from isaacgymenvs_lite.learning.gen_amp_network_builder import GenAMPBuilder
from tests.learning.test_gen_amp_network_builder import NETWORK

OBS, ACTIONS, AMP_OBS, LATENT = 5, 3, 7, 4


@pytest.fixture
def model() -> Any:
    torch.manual_seed(0)
    builder = GenAMPBuilder()
    small = {"units": [8, 6], "activation": "relu"}
    builder.load({**NETWORK, "mlp": {**NETWORK["mlp"], "units": [8, 6]}, "disc": small})
    return ModelGenAMPContinuous(builder).build(
        {
            "actions_num": ACTIONS,
            "input_shape": (OBS,),
            "num_seqs": 4,
            "value_size": 1,
            "normalize_value": True,
            "normalize_input": True,
            "amp_input_shape": (AMP_OBS,),
            "amp_latent_shape": (LATENT,),
        }
    )


def random(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def training_input() -> dict[str, Any]:
    return {
        "is_train": True,
        "obs": random(6, OBS),
        "prev_actions": random(6, ACTIONS, seed=2),
        "amp_latents": F.normalize(random(6, LATENT, seed=6), dim=-1),
        "amp_obs": random(4, AMP_OBS, seed=3),
        "amp_obs_replay": random(4, AMP_OBS, seed=4),
        "amp_obs_demo": random(4, AMP_OBS, seed=5),
        "amp_obs_latents": F.normalize(random(4, LATENT, seed=7), dim=-1),
    }


def test_the_encoder_judges_the_policys_own_observations(model):
    result = model(training_input())
    expected = model.a2c_network.eval_enc(training_input()["amp_obs"])
    torch.testing.assert_close(result["enc_pred"], expected)
    assert "enc_gradient" not in result
    with_gradient = model({**training_input(), "enc_gradient": True})
    assert with_gradient["enc_gradient"].shape == (4, AMP_OBS)
    torch.testing.assert_close(with_gradient["enc_pred"], expected)


def test_acting_needs_the_latents_only(model):
    latents = training_input()["amp_latents"]
    inputs = {"is_train": False, "obs": random(6, OBS), "prev_actions": None}
    model.eval()
    mus = model({**inputs, "amp_latents": latents})["mus"]
    others = model({**inputs, "obs": random(6, OBS), "amp_latents": latents.flip(0)})["mus"]
    assert (mus - others).abs().max() > 1e-3
    with pytest.raises(KeyError):
        model(dict(inputs))
