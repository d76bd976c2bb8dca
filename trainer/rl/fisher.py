"""The geometry of a policy step: divergence between policies, products with the Fisher matrix, and a solver.

Shapes: B samples, f inputs, a actions, P policy parameters.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import nn

from onedemo.rl.policy import Policy


def conjugate_gradient(
    product: Callable[[torch.Tensor], torch.Tensor],
    b: torch.Tensor,
    iterations: int,
    tolerance: float = 1e-10,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Solves A x = b for a symmetric positive definite A (Hestenes and Stiefel 1952).

    Args:
        product: Multiplies a vector (P,) by A.
        b: Right-hand side, (P,).
        iterations: At most this many; P of them are exact but for rounding.
        tolerance: Stop when the squared residual is below this.

    Returns:
        x and what is left of b, b - A x: both (P,).
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
    return x, residual


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
    policy: Policy, inputs_Bf: torch.Tensor, damping: float, *, chunk: int = 2048
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
        chunk: Samples at a time: what lies between two layers then stays in a core's cache.
    """
    layers = [layer for layer in policy.mean if isinstance(layer, nn.Linear)]
    shapes = [shape for layer in layers for shape in (layer.weight.shape, layer.bias.shape)]
    sizes = [shape.numel() for shape in shapes]
    weights = [layer.weight.detach().clone() for layer in layers]
    precision_a = torch.exp(-2 * policy.log_std.detach()) / len(inputs_Bf)
    passes = [_passes(policy.mean, weights, precision_a, inputs) for inputs in inputs_Bf.split(chunk)]

    def product(v_P: torch.Tensor) -> torch.Tensor:
        parts = v_P.split([*sizes, len(precision_a)])
        steps = [part.view(shape) for part, shape in zip(parts[:-1], shapes, strict=True)]
        out_P = damping * v_P
        out_P[-len(precision_a) :] += 2 * parts[-1]
        for through in passes:
            out_P[: -len(precision_a)] += through(steps)
        return out_P

    return product


def _passes(
    network: nn.Module, weights: list[torch.Tensor], precision_a: torch.Tensor, inputs_Bf: torch.Tensor
) -> Callable[[list[torch.Tensor]], torch.Tensor]:
    """The function v -> J^T S^-1 J v over some samples, for the parameters of the mean."""
    x, activations, slopes = inputs_Bf, [inputs_Bf], []
    with torch.no_grad():
        for layer in list(network.children())[:-1]:
            x = layer(x)
            if not isinstance(layer, nn.Linear):  # after the tanh
                activations.append(x)
                slopes.append(1 - x.square())

    def through(steps: list[torch.Tensor]) -> torch.Tensor:
        tangent = torch.addmm(steps[1], activations[0], steps[0].T)
        for i in range(1, len(weights)):
            tangent.mul_(slopes[i - 1])
            tangent = torch.addmm(steps[2 * i + 1], tangent, weights[i].T)
            tangent.addmm_(activations[i], steps[2 * i].T)
        back = tangent * precision_a
        grads: list[torch.Tensor] = []
        for i in range(len(weights) - 1, -1, -1):
            grads[:0] = [(back.T @ activations[i]).reshape(-1), back.sum(0)]
            if i:
                back = (back @ weights[i]).mul_(slopes[i - 1])
        return torch.cat(grads)

    return through
