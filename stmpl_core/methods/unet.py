"""UNet: the STMPL paper's learned simulator, an image network on the body's own UV chart."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from stmpl_core.arrays import PerVertex
from stmpl_core.chart import PADDING, UvChart
from stmpl_core.errors import InvalidInput, sentence_of
from stmpl_core.extras import needed
from stmpl_core.layer import SoftLayer, single
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.networks import NETWORKS
from stmpl_core.trust import Displacement, Trust

if TYPE_CHECKING:
    from collections.abc import Callable

    import torch

    from stmpl_core.methods.pix2pix import Pix2PixUNet

    Runs = Callable[[torch.Tensor], torch.Tensor]

THICKNESS = (2.5e-3, 12.5e-3)  # thicknesses that are drawn as 0 and 1 [m] (STMPL paper)
MOTION = 30e-3  # displacement that is drawn as 1 [m] (STMPL paper)
MODULUS = 1e3  # Young's modulus that the forces are meant for [Pa] (STMPL paper)
RANGE_MARGIN = 0.02  # share by which a scene may exceed what was seen: samples fall short of their distribution

Range = tuple[float, float]


class Seen(BaseModel):
    """Range of a network's training data.

    Args:
        kind: kind of load, as the data set calls it.
        peak_ratio: largest p / E [-].
        thickness: thickness of the layers [m].
        poisson_ratio: Poisson's ratios of the tissues [-].
        edge_length: median edge length of the skins [m]; with fewer vertices, a force on each is less pressure.
        uv: place of the part on the body's chart, (u0, v0, u1, v1).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: str
    peak_ratio: float
    thickness: Range
    poisson_ratio: Range
    edge_length: Range
    uv: tuple[float, float, float, float]


class UNetCard(BaseModel):
    """Record beside a network's weights: its settings, the range of its training data, its errors, its origin.

    Args:
        size, width: numbers of Pix2PixUNet.
        highest_force: force at a vertex that is drawn as 1, of skin with E = 1 kPa [N].
        seen: range of the training data.
        error_ratio: largest error at any vertex over (p / E) t, at the 95 % quantile of held-out contacts [-].
        about: data, settings, versions, machine and figures, for people.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: int = 1
    size: int
    width: int
    highest_force: float
    seen: Seen
    error_ratio: float | None = None
    about: dict[str, Any] = {}


class UNet:
    """Thickness and nodal force as images on the UV chart -> Pix2PixUNet -> displacement, sampled at the vertices.

    As in the STMPL paper: global axes, the images square, one force at each vertex whatever area it stands for (so the
    mesh must be about as fine as the training data's). Forces are scaled by 1 kPa / E, which is exact: only p / E
    matters. Pressures act as the nodal forces that they are at rest. The image shows the part alone, not the whole
    body's chart, most of which one limb leaves empty.

    Args:
        path: path of a .safetensors file with its .json card beside it; None: the weights that come with stmpl.
        device: device of torch, "cpu" or "cuda".
        half: choice of half precision inside the network: float16 on a GPU, bfloat16 on a CPU.
        graph: choice to record the network as a CUDA graph on the first call, which is then launched as one piece.

    Raises:
        InvalidInput: a path without weights, a card that does not fit them, or a device or graph that torch has not.
    """

    name = "unet"

    def __init__(self, path: str | Path | None = None, *, device: str = "cpu", half: bool = False,
                 graph: bool = False) -> None:  # fmt: skip
        needed("the method unet", "learn", "torch")
        import torch

        device = str(device)
        try:
            cuda = torch.device(device).type == "cuda"
            if not cuda:
                torch.zeros(1, device=device).cpu()
        except (RuntimeError, AssertionError) as error:  # NotImplementedError, too
            raise InvalidInput(f"torch has no device {device!r:.40} here. Try device='cpu'.") from error
        if graph and not cuda:
            raise InvalidInput(f"a graph of CUDA was asked for on {device}. Try device='cuda', or graph=False.")
        if cuda and not torch.cuda.is_available():
            raise InvalidInput(f"{device} was asked for, and torch sees no CUDA device here. Try device='cpu'.")
        self.card, self.network = load_unet(NETWORKS["unet"].path if path is None else Path(path), device)
        self.device, self.half, self.graph = device, half, graph
        self._run: Runs | None = None
        self._layer: SoftLayer | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """Draws the thickness. Raises InvalidInput if the layer has no UV chart, for a skin or a stack."""
        single(layer, "UNet")
        self._chart = square_chart(layer, self.card.size)
        self._images = np.zeros((2, self.card.size, self.card.size), np.float32)
        self._images[0] = self._chart.to_texels(drawn_thickness(layer.thickness))[..., 0]
        self._scene = _outside(self.card.seen, layer)
        self._layer = layer
        return self

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`. Raises NotPrepared, or InvalidInput if the load does not fit the layer."""
        layer = prepared(self._layer, self)
        pressure = load.check(layer).pressure_on(layer)
        if not load.loaded.size:
            return Displacement(np.zeros_like(layer.vertices), Trust(), self.name, pressure)
        force = np.linalg.norm(load.forces_on(layer), axis=1) * MODULUS / layer.tissue.youngs_modulus
        self._images[1] = self._chart.to_texels((force / self.card.highest_force).astype(np.float32))[..., 0]
        displacement = MOTION * self._chart.to_vertices(self._predict()).astype(np.float64)
        return Displacement(displacement, self._trust(layer, load), self.name, pressure)

    def _predict(self) -> np.ndarray:
        """The network's answer to the images, (size, size, 3) [-]."""
        import torch

        with torch.inference_mode():
            images = torch.from_numpy(self._images)[None].to(self.device)
            if self._run is None:
                self._run = recorded(self._through, images) if self.graph else self._through
            return self._run(images)[0].permute(1, 2, 0).contiguous().cpu().numpy()

    def _through(self, images: torch.Tensor) -> torch.Tensor:
        import torch

        kind = self.device.split(":")[0]
        with torch.autocast(kind, torch.bfloat16 if kind == "cpu" else torch.float16, enabled=self.half,
                            cache_enabled=not self.graph):  # fmt: skip
            return self.network(images).float()

    def _trust(self, layer: SoftLayer, load: Load) -> Trust:
        seen, ratio = self.card.seen, load.peak_ratio(layer)
        trust = Trust(figures={"peak_ratio": ratio})
        for why in self._scene:
            trust = trust.also(why, in_range=False)
        if ratio > (1 + RANGE_MARGIN) * seen.peak_ratio:
            trust = trust.also(f"p/E is {ratio:.2g}, the network has seen up to {seen.peak_ratio:.2g}", in_range=False)
        if (load.values < 0).any():
            trust = trust.also("the load pulls, the network knows no sign of a force", in_range=False)
        if (load.kind == "nodal") != (seen.kind == "nodal"):
            trust = trust.also(f"the network has learnt loads of kind {seen.kind}, this one is of kind {load.kind}")
        elif trust.in_range and self.card.error_ratio is not None:
            bound = self.card.error_ratio * ratio * float(layer.thickness[load.loaded].max())
            trust = Trust(error_bound=bound, figures=trust.figures)
        return trust


def recorded(run: Runs, images: torch.Tensor) -> Runs:
    """The same as `run`, recorded as a CUDA graph for images of this shape: its kernels are launched as one piece."""
    import torch

    given, side = images.clone(), torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):  # kernels are chosen before they are recorded
        for _ in range(3):
            run(given)
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        out = run(given)

    def again(images: torch.Tensor) -> torch.Tensor:
        given.copy_(images)
        graph.replay()
        return out

    return again


def load_unet(path: Path, device: str = "cpu") -> tuple[UNetCard, Pix2PixUNet]:
    """A network and its card. Raises InvalidInput where there is none, or the two do not fit one another."""
    needed("the method unet", "learn", "torch")
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    from stmpl_core.methods.pix2pix import Pix2PixUNet

    beside = path.with_suffix(".json")
    if not (path.is_file() and beside.is_file()):
        raise InvalidInput(f"there is no network at {path} with its card {beside.name}. Train one with stmpl train.")
    try:
        card = UNetCard.model_validate_json(beside.read_text())
        network = Pix2PixUNet(card.size, card.width)
        network.load_state_dict({name: tensor.float() for name, tensor in load_file(path).items()})
    except ValidationError as error:
        raise InvalidInput(f"{beside} is no card of a network: {sentence_of(error)}.") from error
    except (SafetensorError, RuntimeError) as error:
        said = " ".join(str(error).split())[:200]
        raise InvalidInput(f"{path} and {beside.name} do not make a network: {said}") from error
    layout = torch.channels_last if device.startswith("cuda") else torch.contiguous_format  # a third faster in float16
    return card, network.eval().to(device, memory_format=layout)  # type: ignore[call-overload]


def square_chart(layer: SoftLayer, size: int) -> UvChart:
    """The layer's own chart as an image of size x size texels, the part in its middle.

    Raises:
        InvalidInput: the layer has no UV chart.
    """
    if not isinstance(layer.chart, UvChart):
        raise InvalidInput("this layer has no UV chart, and an image network needs one. Make it with Body.anny().part"
                           "(...), or give SoftLayer a chart=UvChart(vertices, faces, uv).")  # fmt: skip
    low, high = layer.chart.uv.min(axis=(0, 1)), layer.chart.uv.max(axis=(0, 1))
    half = float((high - low).max()) * size / (size - 2 * PADDING) / 2
    (u, v) = (low + high) / 2
    return layer.chart.at(size, (u - half, v - half, u + half, v + half))


def drawn_thickness(thickness: PerVertex) -> np.ndarray:
    """Thickness [m] as the network sees it, (V,) float32: 2.5 to 12.5 mm as 0 to 1."""
    return ((thickness - THICKNESS[0]) / (THICKNESS[1] - THICKNESS[0])).astype(np.float32)


def seen_in(layers: list[SoftLayer], kind: str, peak_ratio: float) -> Seen:
    """The ranges over the layers that a network is trained on."""
    thickness = np.concatenate([layer.thickness for layer in layers])
    nu, edges = [layer.tissue.poisson_ratio for layer in layers], [layer.edge_length for layer in layers]
    uv = layers[0].chart.uv
    return Seen(kind=kind, peak_ratio=peak_ratio, thickness=_range(thickness), poisson_ratio=_range(nu),
                edge_length=_range(edges), uv=(*uv.min(axis=(0, 1)), *uv.max(axis=(0, 1))))  # fmt: skip


def _range(values: Any) -> Range:
    return float(np.min(values)), float(np.max(values))


def _outside(seen: Seen, layer: SoftLayer) -> list[str]:
    """In what a layer differs from those that were seen, one sentence each."""
    uv = np.concatenate([layer.chart.uv.min(axis=(0, 1)), layer.chart.uv.max(axis=(0, 1))])
    checks = (("the layer is %s mm thick", layer.thickness, seen.thickness, 1e3),
              ("nu is %s", layer.tissue.poisson_ratio, seen.poisson_ratio, 1),
              ("the skin's edges are %s mm", layer.edge_length, seen.edge_length, 1e3))  # fmt: skip
    reasons = []
    for text, values, (low, high), unit in checks:
        least, most = _range(values)
        if least < (1 - RANGE_MARGIN) * low or most > (1 + RANGE_MARGIN) * high:
            here = f"{unit * least:.3g}" if least == most else f"{unit * least:.3g}..{unit * most:.3g}"
            reasons.append(f"{text % here}, the network has seen {unit * low:.3g}..{unit * high:.3g}")
    if np.abs(uv - seen.uv).max() > RANGE_MARGIN * np.ptp(np.reshape(seen.uv, (2, 2)), axis=0).max():
        reasons.append("the skin lies elsewhere on the body's chart: another part than the network has seen")
    return reasons
