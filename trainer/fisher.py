"""The geometry of a policy step: divergence between policies, products with the Fisher matrix, and a solver.

Shapes: B samples, f inputs, a actions, P policy parameters.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import nn

from trainer.policy import Policy


def conjugate_gradient(
    product: Callable[[torch.Tensor], torch.Tensor],
    b: torch.Tensor,
    iterations: int,
    tolerance: float = 1e-10,
) -> torch.Tensor:
    """Solves A x = b for a symmetric positive definite A (Hestenes and Stiefel 1952).

    Args:
        product: Multiplies a vector (P,) by A.
        b: Right-hand side, (P,).
        iterations: At most this many; P of them are exact but for rounding.
        tolerance: Stop when the squared residual is below this.

    Returns:
        x, (P,).
    """
    x, residual, direction = torch.zeros_like(b), b.clone(), b.clone()
    square = residual @ residual
    for _ in range(iterations):
        if square < tolerance:
            break
        image = product(direction)
        length = square / (direction @ image)
        x += length * direction
        residual -= length * image
        square, previous = residual @ residual, square
        direction = residual + square / previous * direction
    return x


def mean_kl(
    old_mean_Ba: torch.Tensor,
    old_log_std: torch.Tensor,
    new_mean_Ba: torch.Tensor,
    new_log_std: torch.Tensor,
) -> torch.Tensor:
    """Mean KL(old || new) of diagonal Gaussians, nats.

    Args:
        old_mean_Ba: (B, a).
        old_log_std: (a,).
        new_mean_Ba: (B, a).
        new_log_std: (a,).
    """
    variance_ratio = torch.exp(2 * (old_log_std - new_log_std))
    shift_Ba = (new_mean_Ba - old_mean_Ba) * torch.exp(-new_log_std)
    kl_Ba = 0.5 * (variance_ratio + shift_Ba.square() - 1) + new_log_std - old_log_std
    return kl_Ba.sum(-1).mean()


def fisher_product(
    policy: Policy, inputs_Bf: torch.Tensor, damping: float
) -> Callable[[torch.Tensor], torch.Tensor]:
    """The function v -> (F + damping I) v, F the mean Fisher matrix of the policy at the inputs.

    F is the Hessian of KL(policy now || policy) at the policy now (Schulman et al. 2015, appendix C).
    For a Gaussian that is F = mean of J^T S^-1 J for the network of the mean, J its Jacobian and S the
    covariance, and 2 I for the log deviations. The product runs forwards (J v) and backwards (J^T u)
    through the tanh network, with its activations worked out once: half the arithmetic of
    differentiating the KL twice.

    Args:
        policy: Not changed; its parameters at the time of the call count.
        inputs_Bf: Normalised inputs, (B, f).
        damping: Added to the diagonal.
    """
    layers = [layer for layer in policy.mean if isinstance(layer, nn.Linear)]
    weights = [layer.weight.detach().clone() for layer in layers]
    shapes = [shape for layer in layers for shape in (layer.weight.shape, layer.bias.shape)]
    sizes = [shape.numel() for shape in shapes]
    precision_a = torch.exp(-2 * policy.log_std.detach()) / len(inputs_Bf)
    activations, slopes = [inputs_Bf], []
    for layer in layers[:-1]:
        activations.append(torch.tanh(layer(activations[-1])).detach())
        slopes.append(1 - activations[-1].square())

    def product(v_P: torch.Tensor) -> torch.Tensor:
        parts = v_P.split([*sizes, len(precision_a)])
        steps = [part.view(shape) for part, shape in zip(parts[:-1], shapes, strict=True)]
        tangent = torch.addmm(steps[1], activations[0], steps[0].T)
        for i in range(1, len(layers)):
            tangent.mul_(slopes[i - 1])
            tangent = torch.addmm(steps[2 * i + 1], tangent, weights[i].T).addmm_(
                activations[i], steps[2 * i].T
            )
        grads: list[torch.Tensor] = [2 * parts[-1]]
        back = tangent * precision_a
        for i in range(len(layers) - 1, -1, -1):
            grads[:0] = [(back.T @ activations[i]).reshape(-1), back.sum(0)]
            if i:
                back = (back @ weights[i]).mul_(slopes[i - 1])
        return torch.cat(grads).add_(v_P, alpha=damping)

    return product
