"""Pix2PixUNet: the image network of the STMPL paper as a torch module; apart, so that torch is imported when asked."""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional

from stmpl_core.errors import InvalidInput

WIDEST = 8  # largest width over that of the first level
SPREAD = 0.02  # standard deviation of the weights at first
DROPS_FROM = 5  # levels above this one, but for the deepest, drop half of their channels' values in training


# What halves an image, and what doubles it.
HALVE = partial(nn.Conv2d, kernel_size=4, stride=2, padding=1)
DOUBLE = partial(nn.ConvTranspose2d, kernel_size=4, stride=2, padding=1)


class Pix2PixUNet(nn.Module):
    """The generator of pix2pix (Isola et al., CVPR 2017, "U-Net 256", one level deeper for 512 texels).

    log2(size) levels, each half as wide as the one before, down to one texel; going down LeakyReLU 0.2, going up ReLU
    and the same level's image from the way down; tanh at the end; weights drawn from N(0, 0.02). No normalisation
    (STMPL paper), hence biases at every level: without them, or with wider weights, it takes some five times as many
    steps to be better than zero. 512 texels and width 64 make 66,992,515 parameters.

    Args:
        size: width of the images [texels], a power of two from 32 on.
        width: channels of the first level; they double up to 8 times as many.
        dropout: share that is dropped in training, on the way up [-].

    Raises:
        InvalidInput: a size that is no such power of two, or width below 1.
    """

    def __init__(self, size: int = 512, width: int = 64, *, dropout: float = 0.5) -> None:
        super().__init__()
        levels = round(math.log2(size)) if size > 0 else 0
        if size < 32 or size != 2**levels or width < 1:
            raise InvalidInput(f"size is {size} and width {width}; allowed are powers of two from 32 on (512 in the "
                               "paper), and a width from 1 on (64 in the paper).")  # fmt: skip
        channels = [2] + [width * min(2**k, WIDEST) for k in range(levels)]
        self.down = nn.ModuleList(HALVE(channels[k], channels[k + 1]) for k in range(levels))
        self.up = nn.ModuleList(
            DOUBLE(channels[k + 1] * (1 if k == levels - 1 else 2), channels[k] if k else 3) for k in range(levels)
        )
        for name, parameter in self.named_parameters():
            nn.init.zeros_(parameter) if name.endswith("bias") else nn.init.normal_(parameter, 0.0, SPREAD)
        self.drops = [dropout if DROPS_FROM <= k + 1 < levels else 0.0 for k in range(levels)]

    def forward(self, images: Tensor) -> Tensor:
        """Thickness and force, (B, 2, size, size), to displacement, (B, 3, size, size), all scaled to 1."""
        kept, x = [], images
        for k, layer in enumerate(self.down):
            x = layer(functional.leaky_relu(x, 0.2) if k else x)
            kept.append(x)
        for k in reversed(range(len(self.up))):
            x = self.up[k](functional.relu(x))
            x = functional.dropout(x, self.drops[k], self.training)
            if k:
                x = torch.cat([kept[k - 1], x], dim=1)
        return torch.tanh(x)
