"""The `stmpl` command: one function a verb; what a verb needs is imported when it is used."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import shutil
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
MethodName = Literal["fem", "moment_net", "unet", "linear", "winkler", "naive", "ladder"]

STABILITY_METHODS = ("moment_net", "linear", "winkler", "naive", "zero")  # of fem_tools.stability.METHODS, fast ones
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


def record(config: Annotated[RecordConfig, Flat], topics: tuple[str, ...] = ()) -> int:
    """Records topics as they come over the wire, as MCAP, until Ctrl-C.

    Example: stmpl record --path runs/mine
    Any topics: stmpl record --path runs/mine --topics '/left/.*' /tf /tf_static

    Args:
        config: where to.
        topics: regular expressions of whole topic names; what a replay needs unless given.
    """
    from stmpl_ros.recorder import run

    return run(config, _ros_arguments, topics)


def replay(
    path: BagPath,
    method: MethodName | None = None,
    every: int = 1,
    publish: bool = False,
    speed: float = 1.0,
    topics: tuple[str, ...] = (),
    as_json: Json = False,
) -> int:
    """Answers the recorded contacts again, offline; exits with 1 if the recorded method gives other answers now.

    Example: stmpl replay runs/latest --every 10
    To a running node (max_age:=0): stmpl replay runs/latest --publish --topics /contact_mesh '/tools/.*' --speed 0.5

    Args:
        path: a run's folder, or its .mcap file.
        method: that answers; the one that was recorded unless given.
        every: take each n-th frame only.
        publish: publish the recorded messages on their topics instead, with the timing of the recording.
        speed: of publishing; 1 as recorded, 0 as fast as possible.
        topics: to publish, regular expressions of whole names; all unless given.
        as_json: print figures for machines.
    """
    from bags.replay import replay_run

    if publish:
        from stmpl_ros.player import run

        return run(path, speed, topics, _ros_arguments)
    if every < 1:
        raise InvalidInput(f"--every {every} takes no frame; 1 takes each.")
    answering = _method(method) if method else METHODS[_recorded_method(path)]()
    with _waiting(f"replaying {path}", as_json):
        summary = replay_run(path, answering, every=every)
    _print_figures(vars(summary) if as_json else str(summary))
    return 0 if method or summary.identical == summary.frames else 1


def compare(
    path: BagPath,
    reference: Literal["rigid", MethodName] = "rigid",
    other: Annotated[Path | None, tyro.conf.arg(name="with")] = None,
    tolerance_mm: float | None = None,
    frames: int = 12,
    as_json: Json = False,
) -> int:
    """Compares a recorded run on a sample of its frames; exits with 1 past a tolerance or if a frame is not judged.

    Example: stmpl compare runs/latest --frames 6 --tolerance-mm 0.3
    Against another recording of the same contacts: stmpl compare runs/latest --with runs/before --tolerance-mm 0

    Args:
        path: a run's folder, or its .mcap file.
        reference: that judges. rigid: the recorded answers, by the same tools pressed in by finite elements; any
            other: the run's method, under the recorded pressures.
        other: another bag that judges instead, at the stamps that both answer.
        tolerance_mm: allowed mean error under the contact, in the worst frame [mm].
        frames: of the run that the reference solves.
        as_json: print figures for machines.
    """
    from bags.compare import compare_bags
    from fem_tools import RigidFem
    from stmpl_ros.tables import compare_with_progress, comparison_table, figures_of

    if tolerance_mm is not None and not tolerance_mm >= 0:
        raise InvalidInput(f"--tolerance-mm {tolerance_mm} allows nothing; give 0 or more.")
    if other is not None:
        comparison = compare_bags(path, other, frames=frames)
    elif reference == "rigid":
        comparison = compare_with_progress(path, RigidFem(), frames, quiet=as_json)
    else:
        method = METHODS[_recorded_method(path)]()
        comparison = compare_with_progress(path, _method(reference), frames, method=method, quiet=as_json)
    if tolerance_mm is not None:
        comparison = dataclasses.replace(comparison, tolerance=tolerance_mm * 1e-3)
    _print_figures(figures_of(comparison) if as_json else comparison_table(comparison))
    return 0 if comparison.passed else 1


def info(path: BagPath, as_json: Json = False) -> int:
    """Says what a recording holds; exits with 1 if it was not finished or is damaged.

    Example: stmpl info runs/latest

    Args:
        path: a run's folder, or its .mcap file.
        as_json: print figures for machines.
    """
    from bags.reader import Bag
    from stmpl_ros.tables import bag_figures, bag_table

    bag = Bag(path)
    skins = {name: repr(layer) for name, layer in bag.layers.items()} if bag.has_layers else {}
    _print_figures(bag_figures(bag) | {"skins": skins} if as_json else bag_table(bag))
    for name, layer in skins.items() if not as_json else ():
        _print_figures(f"skin {name}: {layer}")
    sound = sum(topic.messages for topic in bag.topics.values())
    if not as_json and bag.expected not in (None, sound):
        _print_figures(f"{sound} of {bag.expected} messages are sound")
    if not as_json and bag.provenance.versions:
        made_by = ", ".join(f"{name} {version}" for name, version in bag.provenance.versions.items())
        _print_figures(f"method: {bag.provenance.method or 'not named'}; body: {bag.provenance.body or 'not named'}; "
                       f"made by {made_by}")
    return 0 if bag.finished and not bag.damage else 1


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


def chart(
    preset: Literal["default", "quick"] = "default",
    out: Path = Path("runs/chart"),
    redraw: bool = False,
    as_json: Json = False,
) -> int:
    """Speed against accuracy: every method, its own knob swept, on the same scenes; a picture, a page to point at.

    A run that was stopped goes on where it was.

    Example: stmpl chart --out runs/chart
    Peers that are installed (pip install .[peers]) are on it as well.

    Args:
        preset: default (the arm at 3 mm, five scenes, two loads; about twenty minutes), quick (a coarse forearm).
        out: folder of chart.png, chart.html, break_even.png and chart.json.
        redraw: draw out/chart.json again instead of measuring.
        as_json: print all points for machines.
    """
    from fem_tools.chart import CURVES, PRESETS, Chart, measure
    from fem_tools.chart.break_even import break_even, draw_break_even
    from fem_tools.chart.page import write_page
    from fem_tools.chart.picture import draw
    from stmpl_ros.tables import chart_table, steps_bar

    out.mkdir(parents=True, exist_ok=True)
    if redraw:
        measured = Chart.load(out / "chart.json")
    else:
        with steps_bar("chart", quiet=as_json) as show:
            measured = measure(PRESETS[preset], CURVES, parts=out / "parts", on_progress=show)
        measured.save(out / "chart.json")
        shutil.rmtree(out / "parts")
    draw(measured, out / "chart.png")
    write_page(measured, out / "chart.html")
    rows = break_even(measured)
    draw_break_even(rows, out / "break_even.png")
    _print_figures(dataclasses.asdict(measured) if as_json else chart_table(measured, rows, out))
    return 0


def calibrate(
    errors: bool = False,
    out: Path | None = None,
    contacts: Path | None = None,
    trials: Path = Path("runs/calibrate"),
    as_json: Json = False,
) -> int:
    """Measures what the ladder chooses by: each method's time on this machine; with --errors also how far off it is.

    Example: stmpl calibrate
    All anew (half an hour): stmpl calibrate --errors --out stmpl_core/weights/ladder.json --contacts data/contacts

    Args:
        errors: measure errors against finite elements as well, and print how often the stated bounds hold.
        out: file of the measured chart; the user's cache for times, runs/calibrate/ladder.json for errors.
        contacts: a data set of the preset contacts, for what rigid tools press with (with --errors).
        trials: folder of the single trials (with --errors), which are not measured twice.
        as_json: print the figures for machines.
    """
    from fem_tools import calibrate as measuring
    from stmpl_ros.tables import coverage_table, steps_bar, times_table

    with steps_bar("calibrate", quiet=as_json) as show:
        if not errors:
            found = measuring.times(on_progress=show)
        else:
            made = measuring.gather(trials, contacts=contacts, on_progress=show)
            found = measuring.fit(made)
    if errors:
        found.save(out or trials / "ladder.json")
        rows = measuring.coverage(made, found)
        _print_figures({"rows": [vars(row) for row in rows]} if as_json else coverage_table(rows))
        return 0
    found.save(out or measuring.times_file())
    _print_figures(dataclasses.asdict(found) if as_json else times_table(found, out or measuring.times_file()))
    return 0


def stability(
    methods: tuple[str, ...] = STABILITY_METHODS,
    preset: Literal["default", "quick"] = "default",
    out: Path | None = None,
    again: Path | None = None,
    critical_load: bool = False,
    as_json: Json = False,
) -> int:
    """Where methods fail: pressure, mesh, seam, noise and more, swept until a law breaks; a table and a picture.

    Example: stmpl stability --methods moment_net winkler
    Your own: stmpl stability --methods my_module:MyMethod
    One failure again: stmpl stability --again runs/stability/failures/pressure_5_E.moment_net.json
    The finite elements' own limits: stmpl stability --critical-load --out critical_load.png

    Args:
        methods: names (zero, naive, winkler, linear, moment_net, unet, fem_1_step, fem, ladder), or
            module:attribute.
        preset: default (minutes a method, on the arm), quick (seconds, on a round limb).
        out: folder of report, picture and failures, runs/stability unless given; the picture with --critical-load.
        again: a saved failure to run again with the same method.
        critical_load: press a flat layer by follower, dead and indenter loads with each element and mesh width until
            it fails, beside the closed form (minutes).
        as_json: print the figures for machines.
    """
    if critical_load:
        return _critical_load(out or Path("runs/critical_load.png"), as_json)
    from fem_tools.stability import PRESETS, maker
    from fem_tools.stability import again as run_again
    from fem_tools.stability import stability as sweep
    from fem_tools.stability.picture import draw
    from stmpl_ros.tables import stability_table, steps_bar

    if again is not None:
        row = run_again(again, maker)
        said = "\n".join(f"{b.law}: {b.measured} ({'flagged' if b.flagged else 'not flagged'})" for b in row.broken)
        told = f"{row.method} at {row.axis} {row.level}: {row.outcome}\n{said}".strip()
        _print_figures(dataclasses.asdict(row) if as_json else told)
        return 1 if row.broken else 0
    folder = out or Path("runs/stability")
    with steps_bar("stability", quiet=as_json) as show:
        report = sweep({name: maker(name) for name in methods}, PRESETS[preset], folder, on_progress=show)
    picture = draw(report, folder / "stability.png")
    _print_figures(report.as_dict() if as_json else stability_table(report, picture))
    return 0


def _critical_load(out: Path, as_json: bool) -> int:
    from fem_tools.critical_load import draw
    from stmpl_ros.tables import critical_load_table, critical_loads_with_progress

    rows = critical_loads_with_progress(quiet=as_json)
    picture = draw(rows, out)
    figures = {"picture": str(picture), "rows": [vars(row) for row in rows]}
    _print_figures(figures if as_json else critical_load_table(rows, picture))
    return 0


VERBS = {f.__name__: f for f in (demo, node, probe, view, record, replay, compare, info, recover, generate, train,
                                 tables, chart, calibrate, stability)}  # fmt: skip


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


def _recorded_method(path: Path) -> str:
    """The method that a run was recorded with, by its provenance, else by its first answer. Raises InvalidInput."""
    from bags.reader import Bag

    bag = Bag(path)
    recorded = bag.provenance.method or next((frame.method for frame in bag.frames()), "no named method")
    if recorded not in METHODS:
        raise InvalidInput(f"{path} was recorded with {recorded}; known are {', '.join(METHODS)}. "
                           "Name one with replay --method, or compare with rigid.")
    return recorded


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
