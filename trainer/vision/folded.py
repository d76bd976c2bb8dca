"""EfficientNet-Lite0 made ready for looking only: the same function in fewer and longer steps.

Batch normalisation is folded into the convolution before it, what follows a convolution is done in
place, and wide maps go through one frame at a time.

Shapes: b frames, C channels, H rows, W columns.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

SIDE = 224
"""Rows and columns of the network's input."""

BATCH = 4
"""Frames at a time for which it is made; other numbers give the same, a little slower."""

_SMALL_SIDE = 28


class Folded:
    """The convolutions of an EfficientNet-Lite of ``efficientnet_lite_pytorch``, up to the last.

    Args:
        network: The package's network with its weights; not changed.
    """

    def __init__(self, network: Any) -> None:
        self._stem = _Layer(network._conv_stem, network._bn0, SIDE, clamp=True)
        side = self._stem.side
        self._blocks: list[tuple[list[_Layer], bool]] = []
        for block in network._blocks:
            expand = [(block._expand_conv, block._bn0, True)] if hasattr(block, "_expand_conv") else []
            layers = []
            for convolution, normalisation, clamp in (
                *expand,
                (block._depthwise_conv, block._bn1, True),
                (block._project_conv, block._bn2, False),
            ):
                layers.append(_Layer(convolution, normalisation, side, clamp=clamp))
                side = layers[-1].side
            about = block._block_args
            stays = block._depthwise_conv.stride[0] == 1 and about.input_filters == about.output_filters
            self._blocks.append((layers, bool(block.id_skip and stays)))
        self._head = _Layer(network._conv_head, network._bn1, side, clamp=True)
        sides = [layers[-1].side for layers, _ in self._blocks]
        self._wide = next(i for i, side in enumerate(sides) if side <= _SMALL_SIDE) + 1

    def __call__(self, pixels_b3HW: torch.Tensor) -> torch.Tensor:
        """The last convolution's maps, (b, 1280, 7, 7), of scaled pixels. In inference mode only."""
        # Wide maps one frame at a time: they stay in the core's cache. Small ones together: the
        # weights, larger there, are read once for all.
        frames = pixels_b3HW.contiguous(memory_format=torch.channels_last).split(1)
        x = torch.cat([_through(self._blocks[: self._wide], self._stem(frame)) for frame in frames])
        return self._head(_through(self._blocks[self._wide :], x))


def _through(blocks: list[tuple[list[_Layer], bool]], x: torch.Tensor) -> torch.Tensor:
    for layers, skip in blocks:
        y = x
        for layer in layers[:-1]:
            y = layer(y)
        x = layers[-1](y, x if skip else None)
    return x


class _Layer:
    """A convolution with all that comes before the next; ``side`` is that of its output."""

    def __init__(self, convolution: Any, normalisation: Any, side: int, *, clamp: bool) -> None:
        weight, bias = nn.utils.fuse_conv_bn_weights(
            convolution.weight, convolution.bias, normalisation.running_mean, normalisation.running_var,
            normalisation.eps, normalisation.weight, normalisation.bias,
        )  # fmt: skip
        start, end = getattr(convolution.static_padding, "padding", (0, 0))[:2]
        weight = weight.detach()
        self._pad = (0, 0, 0, 0)
        if convolution.in_channels == 3:
            self._pad, side, start, end = (start, end, start, end), side + start + end, 0, 0
        else:
            # TensorFlow pads one more at the end than at the start. Taps of zero at the start of the
            # kernel give the same with equal padding, and spare a copy of the whole input.
            weight = F.pad(weight, (end - start, 0, end - start, 0))
        self._weight = weight.contiguous(memory_format=torch.channels_last)
        self.side = (side + 2 * end - weight.shape[-1]) // convolution.stride[0] + 1
        self._bias, self._clamp = bias.detach(), clamp
        self._how = (convolution.stride, end, 1, convolution.groups)

    def __call__(self, x: torch.Tensor, skip: torch.Tensor | None = None) -> torch.Tensor:
        """The output; with ``skip`` it is added to that tensor, in place."""
        x = F.pad(x, self._pad) if any(self._pad) else x
        y = F.conv2d(x, self._weight, self._bias, *self._how)
        y = F.hardtanh_(y, 0.0, 6.0) if self._clamp else y
        return y if skip is None else skip.add_(y)
