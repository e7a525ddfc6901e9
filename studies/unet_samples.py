"""What the paper's network is trained on: samples held in memory, and drawn as images a batch at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from fem_tools.dataset import Subset
from stmpl_core.chart import UvChart
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.unet import MODULUS, MOTION, drawn_thickness


class Images:
    """Draws values at vertices as images, a batch at a time, on any device: what UvChart.to_texels does for one."""

    def __init__(self, chart: UvChart, device: torch.device) -> None:
        index, corners, weights = chart._raster
        self.index, self.corners = (torch.from_numpy(table).long().to(device) for table in (index, corners))
        self.weights = torch.from_numpy(weights).to(device)
        self.mask = torch.from_numpy(chart.mask).to(device)
        self.shape = chart.shape

    def of(self, values: Tensor) -> Tensor:
        """Values (B, V, k) as images (B, k, H, W), zero off the chart."""
        texels = sum(values[:, self.corners[:, c]] * self.weights[:, c, None] for c in range(3))
        images = values.new_zeros(len(values), self.shape[0] * self.shape[1], values.shape[2])
        images[:, self.index] = texels  # type: ignore[assignment]
        return images.unflatten(1, self.shape).permute(0, 3, 1, 2)


class Samples:
    """Training samples in memory: half-precision values at the vertices, a hundredth of the images' size.

    Forces are held in mN (for E = 1 kPa), displacements in mm, where half precision is good to 5e-4 of the value.
    """

    def __init__(self, subset: Subset, layers: dict[str, SoftLayer], on_read: Callable[[int, int], None]) -> None:
        vertices = len(next(iter(layers.values())).vertices)
        self.force = torch.zeros(len(subset), vertices, dtype=torch.float16)
        self.motion = torch.zeros(len(subset), vertices, 3, dtype=torch.float16)
        self.body = torch.zeros(len(subset), dtype=torch.long)
        self.thickness = torch.stack([torch.from_numpy(drawn_thickness(x.thickness)) for x in layers.values()])
        names, self.peak_ratio = list(layers), 0.0
        for k, sample in enumerate(subset):
            force = np.linalg.norm(sample.load.forces_on(sample.layer), axis=1)
            self.force[k] = torch.from_numpy(1e3 * force * MODULUS / sample.layer.tissue.youngs_modulus)
            self.motion[k] = torch.from_numpy(1e3 * sample.displacement)
            self.body[k] = names.index(sample.info["body"])
            self.peak_ratio = max(self.peak_ratio, sample.load.peak_ratio(sample.layer))
            on_read(k + 1, len(subset))

    def __len__(self) -> int:
        return len(self.body)

    def batch(self, rows: Tensor, images: Images, highest_force: float) -> tuple[Tensor, Tensor]:
        """Inputs (B, 2, H, W) and targets (B, 3, H, W) of some samples, scaled as the network wants them."""
        device = images.weights.device
        chosen = self.thickness[self.body[rows]], self.force[rows], self.motion[rows]
        thickness, force, motion = (values.to(device).float() for values in chosen)
        inputs = images.of(torch.stack([thickness, force / (1e3 * highest_force)], dim=-1))
        return inputs, images.of(motion / (1e3 * MOTION))
