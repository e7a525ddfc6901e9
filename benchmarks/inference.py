"""How long an answer takes, end to end (a load in, every vertex's displacement out): our network, its parts, others.

OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.inference [--weights FILE] [--seconds 3]
python -m benchmarks.inference --picture docs/pictures/thinning.png

Times are the processor's; on a GPU those of the clock.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from fem_tools import PatchFem
from fem_tools.scenes import Site, UnusableContact, ellipse
from stmpl_core import Load
from stmpl_core.body import Body
from stmpl_core.layer import SoftLayer
from stmpl_core.methods import Linear, Method, MomentNet, UNet, Winkler
from stmpl_core.methods import moment_net as parts
from stmpl_core.methods.pix2pix import Pix2PixUNet
from stmpl_core.methods.unet import recorded
from stmpl_core.provenance import machine

NO_CUDA = "not measured: no CUDA device"


def footprints(layer: SoftLayer) -> dict[str, np.ndarray]:
    """A fingertip, a palm and a band on the arm."""
    site, out = Site(layer), {}
    order = np.random.default_rng(0).permutation(len(layer.vertices))
    makers = {
        "fingertip, 8 mm": lambda v: site.press_flat(v, ellipse(0.008, 0.008), 0.0),
        "disc, 20 mm": lambda v: site.press_flat(v, ellipse(0.02, 0.02), 0.0),
        "band, 25 mm": lambda v: site.strap(v, 0.025, 0.0),
    }
    for name, make in makers.items():
        for vertex in order:
            try:
                out[name] = make(int(vertex)).footprint
                break
            except UnusableContact:
                continue
    return out


def timed(call: Callable[[], object], seconds: float, clock: Callable[[], float] = time.process_time
          ) -> tuple[float, float]:  # fmt: skip
    """Median and 99th percentile [ms] of the time that `clock` tells of calls over so many seconds, after a first."""
    call()
    spent: list[float] = []
    end = clock() + seconds
    while clock() < end or len(spent) < 5:
        start = clock()
        call()
        spent.append(1e3 * (clock() - start))
    return float(np.median(spent)), float(np.quantile(spent, 0.99))


def draw(net: MomentNet, layer: SoftLayer, loads: dict[str, Load], out: Path) -> None:
    """Who is pressed, who is asked and who is filled in, seen from above the contact."""
    assert net._near is not None
    figure, axes = plt.subplots(1, len(loads), figsize=(6 * len(loads), 5.6), layout="constrained")
    for axis, (name, load) in zip(axes, loads.items(), strict=True):
        asked = net._near.asked(load.loaded)
        peak = int(np.argmax(net.solve(load).magnitude))
        frame, here = net._near.frames[peak], layer.vertices[peak]
        facing = layer.normals @ frame[2] > 0.1
        kinds = {"filled in": (asked.between, 3, "0.75"), "asked": (asked.vertices, 9, "tab:blue"),
                 "pressed": (load.loaded, 9, "tab:red")}  # fmt: skip
        for kind, (vertices, size, colour) in kinds.items():
            x, y, _ = 1e3 * frame @ (layer.vertices[vertices[facing[vertices]]] - here).T
            axis.scatter(x, y, size, colour, lw=0, label=f"{kind}: {len(vertices):,}")
        axis.set(title=name, xlabel="mm", aspect="equal", xlim=(-75, 75), ylim=(-75, 75))
        axis.legend(loc="upper right", fontsize=9, markerscale=2)
    figure.savefig(out, dpi=90)


def main() -> None:
    """Prints the tables."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--weights", default=None, help="weights of MomentNet; those that ship unless given")
    given.add_argument("--seconds", type=float, default=3.0, help="time of each measurement [s]")
    given.add_argument("--picture", type=Path, help="file for a drawing of the asked vertices; measures nothing then")
    options = given.parse_args()

    layer = Body.anny().part("left_arm", edge_length=3e-3, thickness=7.5e-3)
    print(f"{layer}\n{machine()}; load {os.getloadavg()[0]:.1f} before the run\n")
    net = MomentNet(options.weights)
    loads = {name: Load.pressure(0.5 * layer.tissue.youngs_modulus * footprint)
             for name, footprint in footprints(layer).items()}  # fmt: skip
    if options.picture:
        draw(net.prepare(layer), layer, dict(list(loads.items())[:2]), options.picture)
        return
    methods: dict[str, Method] = {
        "winkler": Winkler(), "linear": Linear(), "moment_net": net,
        "unet, reduced": UNet(), "patch FEM": PatchFem(),
    }  # fmt: skip
    for method in methods.values():
        method.prepare(layer)
    head = f"{'end to end':24} {'pressed':>8} {'feel it':>8} {'asked':>8} "
    print(head + "".join(f"{name:>22}" for name in methods) + "   ms, p99")
    for name, load in loads.items():
        assert net._near is not None
        asked = net._near.asked(load.loaded)
        cells = []
        for method in methods.values():
            median, p99 = timed(lambda m=method, x=load: m.solve(x), options.seconds)
            cells.append(f"{median:12.2f} ({p99:7.2f})")
        feel = len(asked.vertices) + len(asked.between)
        print(f"{name:24} {len(load.loaded):8} {feel:8} {len(asked.vertices):8} " + "".join(f"{c:>22}" for c in cells))
        sources = parts.source_fields(load.values, layer.tissue, load.loaded)
        median, _ = timed(lambda s=sources, a=asked: net._near.felt(s, a), options.seconds / 3)  # type: ignore[union-attr]
        print(f"    of that, feeling the load: {median:.2f} ms", flush=True)
    ours, _ = timed(lambda: net.solve(loads["disc, 20 mm"]), options.seconds)
    print("\nthe paper's UNet, 512 x 512, the network alone; beside it MomentNet end to end, times as long:")
    for name, told in papers(options.seconds, ours).items():
        print(f"    {name:44} {told}")


def papers(seconds: float, ours: float) -> dict[str, str]:
    """The paper's network of random weights on the processor and on a GPU: what each took, or why it was not measured.

    Args:
        seconds: time of each measurement [s].
        ours: time of our answer to a disc [ms].
    """
    import torch

    told, network, maps = {}, Pix2PixUNet(512, 64).eval(), torch.zeros(1, 2, 512, 512)
    for device, half, graph in (("cpu", False, False), ("cpu", True, False), ("cuda", False, False),
                                ("cuda", True, False), ("cuda", True, True)):  # fmt: skip
        name = f"{device}{', half precision' if half else ''}{', CUDA graph' if graph else ''}"
        if device == "cuda" and not torch.cuda.is_available():
            told[name] = NO_CUDA
            continue
        layout = torch.channels_last if device == "cuda" else torch.contiguous_format
        on, images = network.to(device, memory_format=layout), maps.to(device)  # type: ignore[call-overload]

        def run(given: torch.Tensor, on: Pix2PixUNet = on, device: str = device, half: bool = half,
                graph: bool = graph) -> torch.Tensor:  # fmt: skip
            with torch.autocast(device, torch.bfloat16 if device == "cpu" else torch.float16, enabled=half,
                                cache_enabled=not graph):  # fmt: skip
                return on(given)

        with torch.inference_mode():
            last = recorded(run, images) if graph else run

        def whole(run: Callable[[torch.Tensor], torch.Tensor] = last, images: torch.Tensor = images) -> None:
            with torch.inference_mode():
                run(images)
                if images.is_cuda:
                    torch.cuda.synchronize()

        median, p99 = timed(whole, seconds, time.perf_counter if device == "cuda" else time.process_time)
        told[name] = f"{median:.1f} ms, p99 {p99:.1f}; {median / ours:.1f}"
    return told


if __name__ == "__main__":
    main()
