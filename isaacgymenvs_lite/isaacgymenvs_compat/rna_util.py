"""The names of IsaacGymEnvs' `utils.rna_util`."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_HIDDEN_UNITS = (512, 1024)


class RandomNetworkAdversary(nn.Module):
    """A random network that disturbs actions, after OpenAI et al. 2019 (arXiv:1910.07113, B.3).

    The outputs are the probabilities of the bins of each action. All environments share the
    weights, but each environment has another mask of dropped units.
    """

    def __init__(
        self, num_envs: int, in_dims: int, out_dims: int, softmax_bins: int, device: str
    ) -> None:
        super().__init__()
        self.num_envs, self.device = num_envs, device
        self.in_dims, self.out_dims, self.softmax_bins = in_dims, out_dims, softmax_bins
        self.num_feats1, self.num_feats2 = first, second = _HIDDEN_UNITS
        self.fc1 = nn.Linear(in_dims, first)
        self.fc1_1 = nn.Linear(first, first)
        self.fc2 = nn.Linear(first, second)
        self.fc2_1 = nn.Linear(second, second)  # unused, but checkpoints contain it
        self.fc3 = nn.Linear(second, out_dims * softmax_bins)
        self.to(device)
        self._refresh()

    def _refresh(self) -> None:
        """Draw new weights and masks."""
        with torch.no_grad():
            for layer in (self.fc1, self.fc1_1, self.fc2, self.fc2_1, self.fc3):
                nn.init.kaiming_uniform_(layer.weight)
        self.eval()
        self.refresh_dropout_masks()

    def refresh_dropout_masks(self) -> None:
        """Draw new masks; in each environment a mask keeps a random share of a layer's units."""
        shares = torch.rand(2).tolist()
        self.dropout_masks1, self.dropout_masks2 = (
            torch.full((self.num_envs, units), share).bernoulli().to(self.device)
            for units, share in zip(_HIDDEN_UNITS, shares, strict=True)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return probabilities (N, A, B) for inputs (N, in_dims)."""
        features = self.fc1_1(torch.relu(self.fc1(x))) * self.dropout_masks1
        features = torch.relu(self.fc2(features)) * self.dropout_masks2
        return self.fc3(features).view(-1, self.out_dims, self.softmax_bins).softmax(dim=-1)
