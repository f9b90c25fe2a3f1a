from __future__ import annotations

from pathlib import Path

import pytest
import torch

from isaacgymenvs_lite.checkpoints.llc_reference import (
    SHIPPED_LLC,
    llc_checkpoint_for,
    make_reference,
    shipped_reference,
)
from isaacgymenvs_lite.errors import CheckpointError

WEIGHTS = {"mu.weight": torch.arange(6.0).view(2, 3), "sigma": torch.zeros(2)}


def test_null_means_the_shipped_low_level():
    assert llc_checkpoint_for(None, {}) == SHIPPED_LLC
    assert llc_checkpoint_for("", {}) == ""
    assert llc_checkpoint_for("own.pth", {"load_checkpoint": True}) == "own.pth"


def test_the_fingerprint_is_of_names_and_weights():
    first = make_reference("low.pth", WEIGHTS)
    assert first["checkpoint"] == str(Path("low.pth").absolute())
    assert make_reference("low.pth", dict(reversed(WEIGHTS.items()))) == first
    others = (
        {**WEIGHTS, "sigma": torch.tensor([0.0, 1e-7])},
        {"mu.weight": WEIGHTS["mu.weight"], "tau": WEIGHTS["sigma"]},
    )
    for weights in others:
        assert make_reference("low.pth", weights)["fingerprint"] != first["fingerprint"]


def test_a_low_level_is_found_among_the_shipped_by_its_weights(shipped_dir):
    reference = make_reference("/gone/low.pth", WEIGHTS)
    torch.save({"model": {"mu.weight": torch.ones(2, 3)}}, shipped_dir / "other.pth")
    with pytest.raises(CheckpointError, match=r"/gone/low.pth, which does not ship; pack that"):
        shipped_reference(reference)
    torch.save({"model": WEIGHTS}, shipped_dir / "skills.pth")
    assert shipped_reference(reference) == {**reference, "checkpoint": "skills"}
