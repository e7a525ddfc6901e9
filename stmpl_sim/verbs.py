"""The verbs `sim` and `fmu`: a robot massages a limb in a simulator; soft skin as a unit for others."""

from __future__ import annotations

import sys
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast, get_args

import tyro

from stmpl_core.console import print_figures
from stmpl_core.errors import InvalidInput, check_millimetres
from stmpl_core.extras import needed
from stmpl_core.outputs import writable_folder

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np

    from stmpl_core.layer import SoftLayer
    from stmpl_sim.massage import Log, Massage, Phase

FILM_RATE = 20.0  # frames a second
LEAST_MM = 0.5  # least radius and speed of the verb [mm, mm/s]: what is told in metres is smaller
LARGEST_OFF_N = 0.2  # difference of the mean force of a phase from what was asked for that is told
MOST_GRIP_OFF = 0.1  # difference of the grip of the fingers from what was asked for, over it, that is told
LARGEST_OFF_M = 1e-3  # distance off the course that is told
SINGLE_MODULUS = 20e3  # Young's modulus of the limb of one material [Pa]
ros_arguments: list[str] = []  # arguments of ROS, from --ros-args on; this verb has no use for them


def sim(
    out: Path = Path("runs/sim"),
    part: str = "left_forearm",
    phenotype: str = "",
    tissue: Literal["relaxed", "tensed", "single"] = "relaxed",
    force: tuple[float, ...] = (5.0, 10.0),
    speed: float = 50.0,
    circle: float = 12.0,
    laps: float = 2.0,
    radius: float = 20.0,
    mount: Literal["auto", "fixed", "springs", "rest"] = "auto",
    grip: float | None = None,
    robot: Path | None = None,
    end: str | None = None,
    at: tuple[float, float, float] = (0.5, 0.0, 0.25),
    rate: float = 1000.0,
    every: int = 1,
    damping: float = 0.0,
    friction: str = "none",
    relaxing: bool = False,
    film: Literal["auto", "egl", "osmesa", "software", "none"] = "auto",
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """A robot presses on a limb and circles on it, two fingers grip and lift it: MuJoCo, no ROS; figures and a film.

    Example: stmpl sim --force 5 --laps 1 --tissue single
    With your own robot: stmpl sim --robot arm.urdf --end tool0 --at 0.6 0 0.3

    Args:
        out: folder for log.npz and film.webp.
        part: part of the body: left_forearm, right_thigh, back.
        phenotype: phenotype of the body, each value from 0 to 1: 'weight=0.7 muscle=0.3'; 0.5 unless given.
        tissue: tissue of it; relaxed, tensed: skin, fat and muscle as measured in its region, with the muscle so;
            single: one material of 20 kPa, 7.5 mm thick.
        force: forces to press with, one after the other [N].
        speed: speed along the circles [mm/s].
        circle: radius of the circles [mm].
        laps: laps with each force.
        radius: radius of the ball that presses [mm].
        mount: mount of the limb: fixed, on springs, or on a rest, hinged at its thicker end; auto: on a rest if it is
            gripped, else fixed.
        grip: force with which each of two fingers grips the limb in the end, to lift it [N]; 0: not; unless given,
            10 on a forearm.
        robot: MJCF or URDF file; the 7-axis arm that ships unless given. Its actuators become torque motors.
        end: body or site of the robot that carries the ball, z axis towards the skin; the last body unless given.
        at: place of the limb in the robot's world [m].
        rate: rate of physics, with contact at every step [Hz].
        every: steps from one at which the contact law is asked to the next; in between contact goes on to first order.
        damping: damping of the contact [s/m], not measured on tissue; 0: none.
        friction: coefficient of friction, or dry, moist, oiled, glove, typical, or none.
        relaxing: stress that fades, as in skin that was stretched and held (assumed of all materials).
        film: renderer of the film: auto takes the first that works here; none makes no film.
        as_json: figures as JSON, for machines.
    """
    needed("stmpl sim", "sim", "mujoco")
    if not 50 <= rate <= 20_000:
        raise InvalidInput(f"--rate is {rate:g} Hz; allowed is 50 to 20000.")
    for flag, value in (("radius", radius), ("circle", circle), ("speed", speed)):
        check_millimetres(f"--{flag}", value, LEAST_MM)
    from stmpl_core.friction import friction_from
    from stmpl_core.warming import CompiledAhead
    from stmpl_sim.grip import mount_of, usual_force
    from stmpl_sim.massage import Course, Massage
    from stmpl_sim.scene import build, check_robot
    from stmpl_sim.site import Site

    writable_folder(out)  # what cannot be is said before the skin is made
    check_robot(robot, end)
    layer = limb(part, tissue, relaxing, phenotype)
    site = Site.thickest(layer)
    grip = usual_force(part) if grip is None else grip
    scene = build(layer, site, robot=robot, end=end, at=at, mount=mount_of(mount, grip), radius=1e-3 * radius,
                  timestep=1 / rate, gripper=grip > 0)  # fmt: skip
    course = Course(site.circle(1e-3 * circle), tuple(force), 1e-3 * speed, laps, grip)
    with CompiledAhead(layer.stacked, steps=True) as ahead:
        massage = Massage(scene, course, damping=damping, friction=friction_from(friction), every=every)
        massage.warm_up(ahead)
    shots: list[Any] | None = None if film == "none" else []
    try:
        log = _run(massage, shots, quiet=as_json)
    except KeyboardInterrupt:
        if massage.log is not None:
            print(f"stopped at {massage.log.time[-1]:.1f} of {course.duration:.1f} s; the log so far: "
                  f"{massage.log.save(out / 'log.npz')}", file=sys.stderr)  # fmt: skip
        raise
    log.save(out / "log.npz")
    figures = figures_of(log) | {"log": str(out / "log.npz"), "every": every}
    if shots is not None:
        from stmpl_sim.film import film as made

        done = made(scene.model, layer, shots, out / "film.webp", most=0.5 * float(layer.thickness[site.vertex]),
                    rate=FILM_RATE, backend=None if film == "auto" else film)  # fmt: skip
        figures |= {"film": str(done.path), "frames_by": done.frames_by}
    print_figures(figures if as_json else table(figures))
    return 0


def fmu(out: Path = Path("runs")) -> int:
    """Writes soft skin as a unit of FMI 3.0 for co-simulation: poses of a body and a tool in, wrenches out.

    Example: stmpl fmu --out runs

    Args:
        out: folder for SoftSkin.fmu.
    """
    from stmpl_sim.fmi import write_fmu

    print_figures(f"unit: {write_fmu(out)}")
    return 0


@lru_cache(maxsize=2)
def limb(part: str, tissue: str, relaxing: bool = False, phenotype: str = "") -> SoftLayer:
    """A part of a body. Raises InvalidInput: no such part, tissue or phenotype."""
    from stmpl_core.body import Body, phenotype_from
    from stmpl_core.living import held_skin, living
    from stmpl_core.regions import Tone
    from stmpl_core.tissue import Tissue

    if tissue not in (known := (*get_args(Tone), "single")):
        raise InvalidInput(f"there is no tissue '{tissue}'. Available: {', '.join(known)}.")
    body = Body.anny(pose=None, **phenotype_from(phenotype))
    if tissue == "single":
        layer = body.part(part, tissue=Tissue(youngs_modulus=SINGLE_MODULUS))
    else:
        layer = living(body, part, cast(Tone, tissue))
    return held_skin(layer) if relaxing else layer


def _run(massage: Massage, shots: list[Any] | None, *, quiet: bool) -> Log:
    """Runs the course under a progress bar; what a film will show is added to the shots."""
    from copy import copy

    from stmpl_core.console import steps_bar
    from stmpl_sim.film import Shot, caption_of

    dt = float(massage.scene.model.opt.timestep)
    steps, every = round(massage.course.duration / dt), max(1, round(1 / (FILM_RATE * dt)))
    with steps_bar("steps", quiet=quiet) as show:

        def see(run: Massage, at: float) -> None:
            k = round(at / dt)
            if k % 50 == 0:
                show(k, steps, run.course.phase(at).name)
            if shots is not None and k % every == 0:
                answer = run.skin.answer()
                shots.append(Shot(copy(run.data), run.skin.skin_points(run.data, answer), run.limb_pose(),
                                  answer.magnitude, answer.pressure, caption_of(at, answer.touches)))  # fmt: skip

        log = massage.run([see])
        show(steps, steps, massage.course.phase(massage.course.duration).name)
        return log


def figures_of(log: Log) -> dict[str, Any]:
    """What a run kept, SI units."""
    import numpy as np

    phases = []
    for phase, rows in held(log):
        force, depth, met = log.force[rows], log.depth[rows], np.isfinite(log.depth[rows])
        phases.append({
            "name": phase.name, "asked_N": phase.force, "mean_N": float(force.mean()),
            "deviation_N": float(force.std()), "worst_N": float(np.abs(force - phase.force).max()),
            "depth_m": float(depth[met].mean()) if met.any() else float("nan"),
            "off_course_m": float(log.off[rows].max()), "pressed": float(met.mean()),
            "in_range": float(log.trusted[rows][met].mean()) if met.any() else 0.0,
        })  # fmt: skip
    most = float(log.energy.max())
    return {
        "phases": phases,
        "grip": gripped(log),
        "highest_force_N": float(log.force.max()),
        "stored_J": most,
        "given_out_J": -float(log.energy[-1]),
        "given_out_of_stored": -float(log.energy[-1]) / most if most > 0 else 0.0,
        "limb_moved_m": float(np.linalg.norm(log.limb[:, :3, 3] - log.limb[0, :3, 3], axis=1).max()),
        "rate_Hz": 1 / float(log.time[1] - log.time[0]),
        "real_time_factor": log.real_time_factor,
        "real_time_factor_of_processor_time": log.own_core_factor,
        "touch_s": float(np.median(log.touch_s)),
        "step_s": float(np.median(log.step_s)),
        "notes": [*force_missed(log), *grip_missed(log), *course_left(log), *log.notes],
    }


def held(log: Log) -> Iterator[tuple[Phase, np.ndarray]]:
    """Phases in which a force is held, and the log's rows that are judged of each."""
    for phase in log.phases:
        if phase.name in ("press", "circle"):
            yield phase, log.during(phase)


def force_missed(log: Log) -> Iterator[str]:
    """Which forces were not kept in the mean, one sentence each."""
    for phase, rows in held(log):
        mean = float(log.force[rows].mean())
        if abs(mean - phase.force) > LARGEST_OFF_N:
            yield f"the robot kept {mean:.2f} N of {phase.force:g} N during '{phase.name}'"


def grip_missed(log: Log) -> Iterator[str]:
    """Whether the fingers did not grip as they were to, one sentence."""
    if (grip := gripped(log)) and abs(grip["mean_N"] - grip["asked_N"]) > MOST_GRIP_OFF * grip["asked_N"]:
        yield f"the fingers gripped with {grip['mean_N']:.2f} N of {grip['asked_N']:g} N each"


def course_left(log: Log) -> Iterator[str]:
    """When the tool left its course while a force was held, one sentence each."""
    for phase, rows in held(log):
        off = float(log.off[rows].max())
        if off > LARGEST_OFF_M:
            yield f"the tool was up to {1e3 * off:.1f} mm off its course during '{phase.name}' with {phase.force:g} N"


def gripped(log: Log) -> dict[str, float] | None:
    """What a gripper kept while it lifted the limb, SI units; None without one."""
    import numpy as np

    lifting = {p.name: p for p in log.phases if p.name in ("lift", "hold", "lower")}
    if not lifting or not log.squeeze.size:
        return None
    start, end = lifting["lift"].start, lifting["lower"].start
    rows = (log.time >= start) & (log.time < end)
    still = (log.time >= lifting["hold"].start) & (log.time < end)
    closing = np.abs(log.fingers[:, :, 0])  # the drives close along x
    middle = log.finger[:, :, :3, 3].mean(axis=1)  # between the fingers, in the limb's axes
    grips = np.einsum("nij,nj->ni", log.limb[:, :3, :3], middle[rows][0][None]) + log.limb[:, :3, 3]
    return {
        "asked_N": lifting["hold"].force,
        "mean_N": float(closing[rows].mean()),
        "deviation_N": float(closing[rows].std()),
        "carried_N": float(-log.fingers[still, :, 2].sum(axis=1).mean()),
        "lifted_m": float(grips[still, 2].mean() - grips[rows][0, 2]),
        "crept_m": float(np.linalg.norm(middle[rows] - middle[rows][0], axis=1).max()),
        "stored_J": float(log.grip_energy.max()),
        "given_out_J": -float(log.grip_energy[-1]),
    }


def _often(every: int) -> str:
    return "at every step" if every == 1 else f"asked at every {every} steps, to first order between"


def table(figures: dict[str, Any]) -> Any:
    """The figures for people."""
    from rich.console import Group
    from rich.table import Table

    shown = Table(title="force kept", title_justify="left")
    for heading in ("phase", "asked [N]", "kept [N]", "worst [N]", "depth [mm]", "off course [mm]", "pressed [%]",
                    "in range [%]"):  # fmt: skip
        shown.add_column(heading, justify="left" if heading == "phase" else "right", no_wrap=heading == "kept [N]")
    for p in figures["phases"]:
        shown.add_row(p["name"], f"{p['asked_N']:.3g}", f"{p['mean_N']:.2f} ± {p['deviation_N']:.2f}",
                      f"{p['worst_N']:.2f}", f"{1e3 * p['depth_m']:.1f}", f"{1e3 * p['off_course_m']:.2f}",
                      f"{100 * p['pressed']:.0f}", f"{100 * p['in_range']:.0f}")  # fmt: skip
    lines = [
        f"highest force {figures['highest_force_N']:.1f} N; limb moved {1e3 * figures['limb_moved_m']:.1f} mm",
        f"energy: stored {1e3 * figures['stored_J']:.2f} mJ at most, given out beyond what was put in "
        f"{1e3 * figures['given_out_J']:+.3f} mJ ({100 * figures['given_out_of_stored']:+.1f} %; below 0: lost)",
        f"{figures['rate_Hz']:.0f} Hz, contact {_often(figures['every'])}: "
        f"{figures['real_time_factor']:.2f} of real time here, "
        f"{figures['real_time_factor_of_processor_time']:.2f} by processor time "
        f"(contact {1e3 * figures['touch_s']:.2f} of {1e3 * figures['step_s']:.2f} ms, median)",
        f"log: {figures['log']}",
    ]
    if grip := figures["grip"]:
        lines.insert(1, f"grip: {grip['mean_N']:.2f} ± {grip['deviation_N']:.2f} N a finger ({grip['asked_N']:.1f} N "
                     f"asked), {grip['carried_N']:.1f} N carried, limb lifted {1e3 * grip['lifted_m']:.1f} mm "
                     f"there, fingers crept {1e3 * grip['crept_m']:.1f} mm")  # fmt: skip
    lines += [f"to note: {note}" for note in figures["notes"]]
    if "film" in figures:
        lines.append(f"film: {figures['film']}, frames by {figures['frames_by']}")
    return Group(shown, *lines)
