"""The `stmpl` command: one function a verb; what a verb needs is imported when it is used."""

from __future__ import annotations

import json
import logging
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from stmpl_core.errors import InvalidInput, StmplError
from stmpl_ros.parameters import METHODS, DemoConfig, NodeConfig, ProbeConfig, RecordConfig
from stmpl_ros.view.config import ViewConfig

if TYPE_CHECKING:
    from collections.abc import Callable

    from stmpl_core.methods.base import Method

Json = Annotated[bool, tyro.conf.arg(name="json")]
Flat = tyro.conf.arg(name="")  # a configuration whose fields are flags of the verb itself
BagPath = Annotated[Path, tyro.conf.Positional]  # a run's folder, or its .mcap file
MethodName = Literal["fem", "moment_net", "unet", "linear", "winkler", "naive"]

DEMO, NODE, PROBE, VIEW = DemoConfig(), NodeConfig(), ProbeConfig(), ViewConfig()

_ros_arguments: list[str] = []


def demo(config: Annotated[DemoConfig, Flat] = DEMO) -> int:
    """Node, simulated devices and recorder on this machine; then the run against FEM, with a report.

    Example: stmpl demo --frames 6 --node.method winkler
    """
    from stmpl_ros.demo import run

    return run(config)


def node(config: Annotated[NodeConfig, Flat] = NODE) -> int:
    """Answers contacts with the displacement of the skin. ROS arguments may follow.

    Example: stmpl node --part left_arm --edge-length 0.004 --ros-args -r __ns:=/left
    """
    from stmpl_ros.node import run

    return run(config, _ros_arguments)


def probe(config: Annotated[ProbeConfig, Flat] = PROBE) -> int:
    """Simulated devices: mesh, pose and wrench along a script, on the skin of a running node.

    Example: stmpl probe --scripts press --rate 500
    """
    from stmpl_ros.probe import run

    return run(config, _ros_arguments)


def record(config: Annotated[RecordConfig, Flat]) -> int:
    """Records the topics of a run as MCAP until Ctrl-C.

    Example: stmpl record --path runs/mine
    """
    from stmpl_ros.recorder import run

    return run(config, _ros_arguments)


def replay(path: BagPath, method: MethodName | None = None, every: int = 1, as_json: Json = False) -> int:
    """Answers the recorded contacts again, offline, and says whether the answers are the recorded ones.

    Example: stmpl replay runs/latest --every 10

    Args:
        path: a run's folder, or its .mcap file.
        method: that answers; the one that was recorded unless given.
        every: take each n-th frame only.
        as_json: print figures for machines.
    """
    from bags.reader import Bag
    from bags.replay import replay_run

    recorded = Bag(path).provenance.method
    if method is None and recorded not in METHODS:
        raise InvalidInput(f"{path} was recorded with {recorded or 'no named method'}. Name one with --method.")
    with _waiting(f"replaying {path}", as_json):
        summary = replay_run(path, METHODS[recorded]() if method is None else _method(method), every=every)
    _print_figures(vars(summary) if as_json else str(summary))
    return 0


def compare(
    path: BagPath, reference: Literal["rigid", MethodName] = "rigid", frames: int = 12, as_json: Json = False
) -> int:
    """Compares a recorded run with a reference on a sample of its frames.

    Example: stmpl compare runs/latest --frames 6

    Args:
        path: a run's folder, or its .mcap file.
        reference: that judges. rigid: the recorded answers, by the same tools pressed in by finite elements; any
            other: the run's method, under the recorded pressures.
        frames: of the run that the reference solves.
        as_json: print figures for machines.
    """
    from bags.reader import Bag
    from fem_tools import RigidFem
    from stmpl_ros.tables import compare_with_progress, comparison_table, figures_of

    if reference == "rigid":
        comparison = compare_with_progress(path, RigidFem(), frames, quiet=as_json)
    else:
        if (recorded := Bag(path).provenance.method) not in METHODS:
            raise InvalidInput(f"{path} was recorded with {recorded or 'no named method'}: compare it with rigid.")
        method = METHODS[recorded]()
        comparison = compare_with_progress(path, _method(reference), frames, method=method, quiet=as_json)
    _print_figures(figures_of(comparison) if as_json else comparison_table(comparison))
    return 0 if comparison.passed else 1


def info(path: BagPath, as_json: Json = False) -> int:
    """Says what a recording holds, finished or not.

    Example: stmpl info runs/latest

    Args:
        path: a run's folder, or its .mcap file.
        as_json: print figures for machines.
    """
    from bags.reader import Bag
    from stmpl_ros.tables import bag_figures, bag_table

    bag = Bag(path)
    _print_figures(bag_figures(bag) if as_json else bag_table(bag))
    return 0


def recover(path: BagPath, target: Path | None = None) -> int:
    """Brings back what is sound in a recording that was not finished.

    Example: stmpl recover runs/broken/run.mcap --target runs/mended

    Args:
        path: a run's folder, or its .mcap file.
        target: where the sound part goes.
    """
    from bags.recover import recover as bring_back

    recovery = bring_back(path, target)
    _print_figures(str(recovery))
    return 0


def generate(
    preset: Literal["tiny", "default", "paper", "contacts"] = "default",
    out: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    as_json: Json = False,
) -> int:
    """Makes the data set that networks learn from, or goes on with one that was stopped.

    Example: stmpl generate --preset tiny --out data/tiny

    Args:
        preset: tiny (seconds), default (under an hour on two cores), paper (hours).
        out: folder of the data; data/<preset> unless given.
        workers: local processes; one a core unless given.
        scheduler: address of a Dask scheduler that does the work instead.
        as_json: print the manifest for machines.
    """
    from fem_tools.generate import generate as make
    from fem_tools.sampling import PRESETS
    from stmpl_ros.tables import contacts_bar, data_table

    with contacts_bar(preset, quiet=as_json) as show:
        folder = out or Path("data") / preset
        manifest = make(PRESETS[preset], folder, workers=workers, scheduler=scheduler, on_progress=show)
    _print_figures(manifest if as_json else data_table(manifest, folder))
    return 0


def train(
    preset: Literal[
        "default", "contacts", "paper", "paper-reduced", "paper-3-bodies", "paper-reduced-3-bodies"
    ] = "default",
    data: Path = Path("data/default"),
    out: Path | None = None,
    steps: int | None = None,
    seed: int = 0,
    as_json: Json = False,
) -> int:
    """Trains a network on a data set, or goes on where a run into the same folder was stopped.

    Example: stmpl train --preset default --data data/default
    Several GPUs: torchrun --nproc-per-node 4 -m stmpl_ros.cli train --preset paper --data data/paper

    Args:
        preset: default and contacts are ours (under an hour on two cores), paper the paper's UNet (a GPU),
            paper-reduced the same code at a size for one core; 3-bodies: its second set-up.
        data: folder of the data set; make it with stmpl generate.
        out: folder of the weights; runs/train/<preset> unless given.
        steps: of the optimiser; epochs for the paper's presets.
        seed: of weights and order.
        as_json: print the card for machines.
    """
    from fem_tools.train import train as learn
    from stmpl_ros.tables import steps_bar

    folder = out or Path("runs/train") / preset
    with steps_bar(f"train {preset}", quiet=as_json) as show:
        card = learn(preset, data, folder, steps=steps, seed=seed, on_progress=show)
    _print_figures(card if as_json else f"weights and their card are in {folder}")
    return 0


def tables(
    data: Path = Path("data/default"),
    limit: int | None = 400,
    unet: Path | None = None,
    unet_3_bodies: Path | None = None,
    moment_net: Path | None = None,
    out: Path | None = None,
    as_json: Json = False,
) -> int:
    """The paper's tables 1 to 3 on a data set: its printed figures, every method, and columns that its metric lacks.

    Example: stmpl tables --data data/default --limit 200

    Args:
        data: folder of the data set; make it with stmpl generate.
        limit: samples a table.
        unet: weights of the paper's network; those that come with the package unless given.
        unet_3_bodies: weights of its second set-up, for Table 3.
        moment_net: weights of ours; those that come with the package unless given.
        out: a file for the tables in Markdown; their figures go beside it as JSON.
        as_json: print the figures for machines.
    """
    from fem_tools.evaluate import THREE_BODY_ROW, evaluate
    from stmpl_core.methods import Linear, MomentNet, UNet
    from stmpl_ros.tables import steps_bar

    methods: dict[str, Callable[[], Method]] = {"linear": Linear, "unet": lambda: UNet(unet)}
    if unet_3_bodies is not None:
        methods[THREE_BODY_ROW] = lambda: UNet(unet_3_bodies)
    methods["moment_net"] = lambda: MomentNet(moment_net)
    with steps_bar("tables", quiet=as_json) as show:
        made = evaluate(data, methods, limit=limit, on_progress=lambda done, total: show(done, total, "samples"))
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(made.markdown() + "\n")
        out.with_suffix(".json").write_text(made.as_json() + "\n")
    sys.stdout.write((made.as_json() if as_json else made.text()) + "\n")
    return 0


def view(path: Annotated[Path | None, tyro.conf.Positional] = None, live: bool = False,
         config: Annotated[ViewConfig, Flat] = VIEW) -> int:  # fmt: skip
    """A page in the browser with the deforming skin: of a recording, of the running node, or under a tool to drag.

    Example: stmpl view runs/latest
    Live from the node: stmpl view --live. Without any robot: stmpl view --tool ball

    Args:
        path: a run's folder, or its .mcap file.
        live: show what the running node answers.
    """
    from stmpl_ros.view.serve import run

    return run(config, path, live, _ros_arguments)


def stability(critical_load: bool = False, out: Path = Path("runs/critical_load.png"), as_json: Json = False) -> int:
    """Where the finite elements lose stability: follower, dead and indenter loads, beside the closed form.

    Example: stmpl stability --critical-load --out critical_load.png

    Args:
        critical_load: press a flat layer by each load with each element and mesh width until it fails (minutes).
        out: the picture, a PNG.
        as_json: print the table for machines.
    """
    from fem_tools.critical_load import closed_form, draw
    from stmpl_ros.tables import critical_load_table, critical_loads_with_progress

    if not critical_load:
        least = min(closed_form(wavelength) for wavelength in (0.5, 1.0, 2.0))
        said = f"Under dead loads a bonded layer is unstable from p = {least:.2f} E on; under a follower pressure,"
        said += " up to 40 E, never. --critical-load shows what each element makes of it."
        _print_figures({"dead_load_p_over_e": least, "follower_load_p_over_e": None} if as_json else said)
        return 0
    rows = critical_loads_with_progress(quiet=as_json)
    picture = draw(rows, out)
    figures = {"picture": str(picture), "rows": [vars(row) for row in rows]}
    _print_figures(figures if as_json else critical_load_table(rows, picture))
    return 0


VERBS = {f.__name__: f for f in (demo, node, probe, view, record, replay, compare, info, recover, generate, train,
                                 tables, stability)}  # fmt: skip


def main(arguments: list[str] | None = None) -> None:
    """Runs a verb; exits with its code, or with 1 and one sentence if it refuses."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if "--ros-args" in given:
        at = given.index("--ros-args")
        _ros_arguments[:], given = given[at:], given[:at]
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    try:
        code = tyro.extras.subcommand_cli_from_dict(VERBS, prog="stmpl", description=__doc__, args=given)
        sys.stdout.flush()
    except StmplError as error:
        from rich.console import Console

        Console(stderr=True).print(f"stmpl: {error}", markup=False, highlight=False, soft_wrap=True, style="red")
        code = 1
    except KeyboardInterrupt:
        code = 130
    except BrokenPipeError:  # `stmpl ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    sys.exit(code)


def _method(name: MethodName) -> Method:
    from fem_tools import PatchFem
    from stmpl_core.methods import MomentNet

    if name == "fem":
        return PatchFem()
    return MomentNet(fallback=PatchFem()) if name == "moment_net" else METHODS[name]()


def _waiting(what: str, quiet: bool):
    from rich.console import Console

    return Console(stderr=True, quiet=quiet).status(what)


def _print_figures(shown: object) -> None:
    from rich.console import Console

    if isinstance(shown, dict):
        sys.stdout.write(json.dumps(shown, indent=2, default=str) + "\n")
    else:
        Console().print(shown)


if __name__ == "__main__":
    main()
