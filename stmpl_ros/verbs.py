"""The verbs of a robot's day: one function each, which the command line calls; what a verb needs is imported in it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from stmpl_core.console import print_figures
from stmpl_core.errors import InvalidInput
from stmpl_core.extras import needed
from stmpl_core.methods import METHODS
from stmpl_core.methods import method as method_named
from stmpl_core.outputs import writable_file
from stmpl_core.regions import REGIONS
from stmpl_ros.parameters import DemoConfig, LinksConfig, NodeConfig, ProbeConfig, RecordConfig, RobotConfig
from stmpl_ros.scene import SceneConfig
from stmpl_ros.view.config import ViewConfig

if TYPE_CHECKING:
    from bags.run import Run
    from stmpl_core.methods.base import Method

Json = Annotated[bool, tyro.conf.arg(name="json")]
Flat = tyro.conf.arg(name="")  # a configuration whose fields are flags of the verb itself
BagPath = Annotated[Path, tyro.conf.Positional]  # a run's folder, or its .mcap file
MethodName = Literal["fem", "moment_net", "unet", "linear", "winkler", "naive", "ladder"]

DEMO, NODE, PROBE, ROBOT = DemoConfig(), NodeConfig(), ProbeConfig(), RobotConfig()
SCENE, VIEW = SceneConfig(), ViewConfig()

ros_arguments: list[str] = []  # arguments of ROS, from --ros-args on


def demo(config: Annotated[DemoConfig, Flat] = DEMO) -> int:
    """Node, a robot that massages and recorder on this machine; then the run against FEM, with a film and a report.

    Example: stmpl demo --robot.force 5 10 --frames 6
    Scripted presses, on one sheet on the bone as in the paper: stmpl demo --device probe --node.tissue paper
    """
    from stmpl_ros.demo import run

    return run(config)


def node(config: Annotated[NodeConfig, Flat] = NODE) -> int:
    """Answers contacts with the displacement of the skin. ROS arguments may follow.

    Example: stmpl node --part left_arm --edge-length 0.004 --ros-args -r __ns:=/left
    One sheet on the bone, as in the paper: stmpl node --tissue paper
    """
    from stmpl_ros.node import run

    return run(config, ros_arguments)


def probe(config: Annotated[ProbeConfig, Flat] = PROBE) -> int:
    """Simulated devices: mesh, pose and wrench along a script, on the skin of a running node.

    Example: stmpl probe --scripts press --rate 500
    """
    from stmpl_ros.probe import run

    return run(config, ros_arguments)


def robot(config: Annotated[RobotConfig, Flat] = ROBOT) -> int:
    """A simulated robot massages the skin of a running node: mesh, poses, wrench, joints and clock over ROS.

    Example: stmpl node --ros-args -p use_sim_time:=true & stmpl robot --force 5 --laps 1
    Without ROS: stmpl sim
    """
    needed("stmpl robot", "sim", "mujoco")
    from stmpl_ros.robot import run

    return run(config, ros_arguments)


def links(config: Annotated[LinksConfig, Flat]) -> int:
    """Soft skin for a simulator that talks ROS: poses of links in, wrenches on links out, one for each instant.

    Example: stmpl links --body forearm --tools finger=finger.stl
    Gazebo: stmpl links --body arm::forearm --tools hand::tip=tip.stl --wrench-type entity --wrenches /world/lab/wrench

    Args:
        config: settings.
    """
    from stmpl_ros.links import run

    return run(config, ros_arguments)


def view(path: Annotated[Path | None, tyro.conf.Positional] = None, live: bool = False,
         config: Annotated[ViewConfig, Flat] = VIEW) -> int:  # fmt: skip
    """A page in the browser with the deforming skin: of a recording, of the running node, or under a tool to drag.

    Example: stmpl view runs/latest
    Live from the node: stmpl view --live. Without any robot: stmpl view --tool ball

    Args:
        path: folder or .mcap file of a run.
        live: answers of the running node instead of a recording.
    """
    needed("stmpl view", "view", "viser", "shapely")
    from stmpl_ros.view.serve import run

    return run(config, path, live, ros_arguments)


def foxglove(host: str = "127.0.0.1", port: int = 8765, topics: tuple[str, ...] = ()) -> int:
    """Serves the node's topics to Foxglove over its websocket, live: the deformed skin, its colours, tools, wrenches.

    Example: stmpl foxglove
    In Foxglove connect to ws://localhost:8765 and import stmpl_ros/foxglove/stmpl.json.

    Args:
        host: address to listen at; 0.0.0.0: any, so that others may look too.
        port: port to listen at.
        topics: regular expressions of whole topic names; the node's own and /tf unless given.
    """
    if not 0 <= port < 2**16:
        raise InvalidInput(f"--port is {port}; allowed is 0 to 65535.")
    needed("stmpl foxglove", "foxglove", "foxglove")
    from stmpl_ros.forwarder import run

    return run(host, port, topics, ros_arguments)


def record(config: Annotated[RecordConfig, Flat], topics: tuple[str, ...] = ()) -> int:
    """Records topics as they come over the wire, as MCAP, until Ctrl-C.

    Example: stmpl record --path runs/mine
    Any topics: stmpl record --path runs/mine --topics '/left/.*' /tf /tf_static

    Args:
        config: folder and files of the recording.
        topics: regular expressions of whole topic names; what a replay needs unless given.
    """
    from stmpl_ros.recorder import run

    return run(config, ros_arguments, topics)


def replay(
    path: BagPath,
    method: MethodName | None = None,
    every: int = 1,
    tolerance_mm: float | None = None,
    namespace: str = "",
    publish: bool = False,
    speed: float = 1.0,
    topics: tuple[str, ...] = (),
    as_json: Json = False,
) -> int:
    """Answers the recorded contacts again, offline; exits with 1 if the recorded method gives other answers now.

    Example: stmpl replay runs/latest --every 10
    To a running node (max_age:=0): stmpl replay runs/latest --publish --topics /contact_mesh '/tools/.*' --speed 0.5

    Args:
        path: folder or .mcap file of a run.
        method: method that answers; the one that was recorded unless given, and another one may differ.
        every: step from frame to frame; 1 takes each.
        tolerance_mm: largest difference that is allowed at any vertex [mm]; pressure and wrenches may be off by the
            share that it is of 1 mm. Unless given, 0 where this processor recorded the run, and 1e-4 where another did.
        namespace: namespace of the robot that is meant, /left, where several were recorded.
        publish: publication of the recorded messages on their topics instead, with the timing of the recording.
        speed: speed of publishing; 1 as recorded, 0 as fast as possible.
        topics: topics to publish, regular expressions of whole names; all unless given.
        as_json: figures as JSON, for machines.
    """
    from bags.replay import replay_run
    from bags.run import Run

    unused = {"--every": every != 1, "--method": method, "--tolerance-mm": tolerance_mm is not None}
    if not publish:
        unused = {"--speed": speed != 1, "--topics": topics}
    if given := [flag for flag, one in unused.items() if one]:
        raise InvalidInput(f"{' and '.join(given)} {'has' if len(given) == 1 else 'have'} no meaning "
                           f"{'with' if publish else 'without'} --publish: leave out one or the other.")  # fmt: skip
    if publish:
        from stmpl_ros.player import run as play

        return play(path, speed, topics, ros_arguments, namespace=namespace)
    if every < 1:
        raise InvalidInput(f"--every {every} takes no frame; 1 takes each.")
    tolerance = _tolerance(tolerance_mm)
    with _waiting(f"replaying {path}", as_json):
        run = Run(path, namespace)
        answering = _method(method) if method else _recorded_method(run)
        summary = replay_run(run, answering, every=every, tolerance=tolerance)
        if method is not None and tolerance is None:
            summary = dataclasses.replace(summary, held=False)
    print_figures(vars(summary) | {"passed": summary.passed} if as_json else str(summary))
    return 0 if summary.passed else 1


def compare(
    path: BagPath,
    reference: Literal["rigid", MethodName] = "rigid",
    other: Annotated[Path | None, tyro.conf.arg(name="with")] = None,
    tolerance_mm: float | None = None,
    namespace: str = "",
    frames: int = 12,
    as_json: Json = False,
) -> int:
    """Compares a recorded run on a sample of its frames; exits with 1 past a tolerance or if a frame is not judged.

    Example: stmpl compare runs/latest --frames 6 --tolerance-mm 0.3
    Against another recording of the same contacts: stmpl compare runs/latest --with runs/before --tolerance-mm 0

    Args:
        path: folder or .mcap file of a run.
        reference: judge; rigid: of the recorded answers, by the same tools pressed in by finite elements; any
            other: of the run's method, under the recorded pressures.
        other: another bag that judges instead, at the stamps that both answer.
        tolerance_mm: allowed mean error under the contact, in the worst frame [mm]; two recordings of one method are
            held to it in all answers, as by replay. Unless given, nothing is held to a tolerance but these: to 0 where
            one processor made both, 1e-4 where two did.
        namespace: namespace of the robot that is meant, /left, where several were recorded; in both bags.
        frames: number of frames that the reference solves.
        as_json: figures as JSON, for machines.
    """
    from bags.compare import compare_bags
    from bags.survey import survey
    from fem_tools import RigidFem
    from stmpl_ros.tables import compare_with_progress, comparison_table, figures_of

    tolerance = _tolerance(tolerance_mm)
    with _waiting(f"reading {path}", as_json):
        run = survey(path, namespace)
    if other is not None:
        comparison = compare_bags(run, survey(other, namespace), frames=frames, tolerance=tolerance)
    elif reference == "rigid":
        comparison = compare_with_progress(run, RigidFem(), frames, quiet=as_json)
    else:
        method = _recorded_method(run.bag)
        comparison = compare_with_progress(run, _method(reference), frames, method=method, quiet=as_json)
    if tolerance is not None:
        comparison = dataclasses.replace(comparison, tolerance=tolerance)
    print_figures(figures_of(comparison) if as_json else comparison_table(comparison))
    return 0 if comparison.passed else 1


def info(path: Annotated[Path | None, tyro.conf.Positional] = None, part: str | None = None,
         as_json: Json = False) -> int:  # fmt: skip
    """Says what a recording holds, and exits with 1 if it is damaged or not finished; or what a body is made of.

    Example: stmpl info runs/latest
    Skin, fat and muscle with their sources: stmpl info --part back

    Args:
        path: folder or .mcap file of a run.
        part: region of the body instead of a run: forearm (where neither is given), upper_arm, shoulder, neck, back,
            abdomen, thigh or calf.
        as_json: figures as JSON, for machines.
    """
    if path is None:
        from stmpl_ros.tables import part_figures, part_table

        print_figures(part_figures(part or "forearm") if as_json else part_table(part or "forearm"))
        return 0
    if part is not None:
        raise InvalidInput("Give the path of a recording or --part with a region of the body, not both.")
    if not path.exists() and str(path).removeprefix("left_").removeprefix("right_") in REGIONS:
        raise InvalidInput(f"there is no recording '{path}'. Is the part of the body meant? stmpl info --part {path}")
    from bags.reader import Bag
    from stmpl_ros.tables import bag_figures, bag_memory, bag_table, memory_sentence, provenance_sentence

    bag = Bag(path)
    skins = {name: repr(layer) for name, layer in bag.known_layers().items()}
    print_figures(bag_figures(bag) | {"skins": skins} if as_json else bag_table(bag))
    for name, layer in skins.items() if not as_json else ():
        print_figures(f"skin {name}: {layer}")
    if not as_json and (memory := memory_sentence(bag_memory(bag))):
        print_figures(memory)
    sound = sum(topic.messages for topic in bag.topics.values())
    if not as_json and bag.expected not in (None, sound):
        print_figures(f"{sound} of {bag.expected} messages are sound")
    if not as_json and (made := provenance_sentence(bag.provenance)):
        print_figures(made)
    return 0 if bag.finished and not bag.damage else 1


def needs(config: Annotated[SceneConfig, Flat] = SCENE, out: Path | None = None, as_json: Json = False) -> int:
    """Says which of skin, tension, muscle, time, slip and mesh a scene needs, and the smallest model that serves.

    Example: stmpl needs --part back --radius 20 --force 10

    A range of tools, forces and speeds: stmpl needs --part thigh --radius 5 40 --force 1 20 --speed 5 50 --drag 0.3

    A massage: stmpl needs --part back --force 10 --speed 50 --duration 2 --path 100 --friction oiled

    A tissue of your own: stmpl needs --thickness 30 --modulus 3 --muscle-depth 8 --muscle-modulus 12 --radius 10

    Its answer for a node: stmpl needs --part forearm --out arm.json; stmpl node --part left_forearm --tissue arm.json

    Args:
        config: tissue, tools and forces.
        out: file for the smallest model that serves: its tissue, whether it relaxes, and its friction.
        as_json: figures as JSON, for machines.
    """
    from stmpl_core.living import write_tissue
    from stmpl_ros.needs_table import needs_figures, needs_table

    if out:
        writable_file(out)
    found = config.needs()
    if out:
        write_tissue(out, *config.model(found))
    title = f"{config.part}, {config.tone}" if config.part else "tissue of your own"
    print_figures(needs_figures(found) if as_json else needs_table(found, title))
    return 0


def recover(path: BagPath, target: Path | None = None) -> int:
    """Brings back what is sound in a recording that was not finished.

    Example: stmpl recover runs/broken/run_0.mcap --target runs/mended

    Args:
        path: folder or .mcap file of a run.
        target: folder or .mcap file of the sound part.
    """
    from bags.recover import recover as bring_back

    recovery = bring_back(path, target)
    print_figures(str(recovery))
    return 0


def generate(
    preset: Literal["tiny", "default", "paper", "contacts", "tissue", "tables"] = "default",
    out: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    start: tuple[Path, ...] = (),
    flat: Path | None = None,
    as_json: Json = False,
) -> int:
    """Makes the data set that networks learn from, or goes on with one that was stopped.

    Example: stmpl generate --preset tiny --out data/tiny

    Args:
        preset: size of the data: tiny (seconds), default (under an hour on two cores), paper (hours); contacts
            (rigid tools), tissue (the same on stacks to the bone): hours; tables (new contacts to judge by, which
            nothing was learnt from: some twenty minutes of one core).
        out: folder of the data; data/<preset> unless given.
        workers: local processes; one a core unless given.
        scheduler: address of a Dask scheduler that does the work instead.
        start: files of released contacts to go on from; for tissue benchmarks/limbs_v3.npz, deep_v2.npz, and, all of
            them _v1.npz, {stout,trunk,thin}.
        flat: file of released presses of its flat stacks, benchmarks/rounds_v2.npz; without, forty minutes more.
        as_json: manifest as JSON, for machines.
    """
    if workers is not None and workers < 1:
        raise InvalidInput(f"--workers {workers} makes nothing; give 1 or more.")
    needed("stmpl generate", "learn", "anny", "torch", "zarr", "shapely")
    from fem_tools.generate import generate as make
    from fem_tools.sampling import PRESETS
    from stmpl_core.console import contacts_bar
    from stmpl_ros.tables import data_table

    with contacts_bar(preset, quiet=as_json) as show:
        folder = out or Path("data") / preset
        manifest = make(PRESETS[preset], folder, workers=workers, scheduler=scheduler, start=start, flat=flat,
                        on_progress=show)  # fmt: skip
    print_figures(manifest if as_json else data_table(manifest, folder))
    return 0


def _recorded_method(run: Run) -> Method:
    """The method that a run was recorded with. Raises InvalidInput if there is none of that name."""
    if run.method not in METHODS:
        raise InvalidInput(f"{run.file} was recorded with {run.method or 'no named method'}; "
                           f"known are {', '.join(METHODS)}. "
                           "Name one with replay --method, or compare with rigid.")  # fmt: skip
    return method_named(run.method)


def _tolerance(millimetres: float | None) -> float | None:
    """A tolerance in metres. Raises InvalidInput if it is below 0."""
    if millimetres is None:
        return None
    if not millimetres >= 0:
        raise InvalidInput(f"--tolerance-mm {millimetres} allows nothing; give 0 or more.")
    return millimetres * 1e-3


def _method(name: MethodName) -> Method:
    """A method that judges: where the network is out of its range, finite elements answer."""
    return method_named(name, fallback=method_named("fem")) if name == "moment_net" else method_named(name)


def _waiting(what: str, quiet: bool):
    from rich.console import Console

    return Console(stderr=True, quiet=quiet).status(what)
