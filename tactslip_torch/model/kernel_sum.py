"""The kernel machine that keeps its training bins: for kernels that do not fold.

Degree 3 and more, and the radial basis function. Its size and its latency grow with the number of
training bins; ``cost`` says by how much.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tactslip_torch.model.kernels import Cost, Kernel, Solved


class KernelSum(nn.Module):
    """``sum_i beta_i kernel(z, z_i)``.

    Args:
        support: ``[N, K]``, scaled training bins.
        beta: ``[N]``, their output weights.
        kernel: of the machine.

    Attributes:
        solved: how its numbers were solved for; ``None`` if read from a file or made by hand.

    Raises:
        ValueError: if shapes disagree.

    Example:
        >>> from tactslip_torch.model.kernels import RadialBasis
        >>> machine = KernelSum(torch.zeros(1, 2), torch.ones(1), RadialBasis(1.0))
        >>> machine(torch.tensor([[0.0, 0.0], [1.0, 0.0]]))
        tensor([1.0000, 0.3679])
    """

    support: Tensor
    beta: Tensor

    def __init__(self, support: Tensor, beta: Tensor, kernel: Kernel) -> None:
        super().__init__()
        self.solved: Solved | None = None
        if support.ndim != 2 or beta.shape != support.shape[:1]:
            raise ValueError(
                "expected support [N, K] and beta [N] with one N, got "
                f"{tuple(support.shape)} and {tuple(beta.shape)}"
            )
        self.register_buffer("support", support.clone())
        self.register_buffer("beta", beta.clone())
        self.kernel = kernel

    @property
    def num_features(self) -> int:
        """How many features it takes."""
        return self.support.shape[1]

    @property
    def cost(self) -> Cost:
        """Multiply-adds a bin and bytes; both grow with the number of training bins."""
        num_bins, num_features = self.support.shape
        num_values = num_bins * (num_features + 1)
        return Cost(num_values, num_values * self.support.element_size())

    @property
    def cost_note(self) -> str:
        """What keeping the sum costs, in a sentence for logs."""
        return (
            f"{self.kernel} does not fold into a quadratic form: the machine keeps all "
            f"{len(self.support)} training bins, {self.cost}"
        )

    def forward(self, z: Tensor) -> Tensor:
        """The score; holds a kernel matrix of all bins given by all training bins.

        Shape:
            - z: ``[*, K]``
            - output: ``[*]``
        """
        across = self.kernel(z[..., None, :], self.support)  # [*, 1, N]
        return torch.matmul(across, self.beta).squeeze(-1)
