"""A simulated haptic device on the real contact: what it feels, whether that stays passive, and how stiff it may be.

python -m benchmarks.haptics [--parts cost continuity slide session stiffness map] [--picture docs/pictures/z_width.png]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.haptic_device import Device, Felt, Hand, Spot, arm_spot, play
from stmpl_core import Contact
from stmpl_core.body import Body
from stmpl_core.haptics import DeviceLoop, LoopSettings
from stmpl_core.history import History
from stmpl_core.living import living
from stmpl_core.local_contact import local_contact, local_contacts
from stmpl_core.provenance import machine
from stmpl_core.regions import HELD_SKIN
from stmpl_core.toucher import Toucher

HARD = 5e5  # Pa: a skin beside which the coupling is soft, 5 kN/m under 1 N
LEVELS = [round(100 * 2 ** (k / 4)) for k in range(31)]  # N/m, of the coupling: 100 to 18,100
MODULI = [1e3 * 2**k for k in range(11)]  # Pa, of the skin: 1 kPa to 1 MPa
COUPLING = 1000.0  # N/m, unless it is varied
RATES, DELAYS = (500, 1000, 2000, 4000), (0.0, 2e-3, 5e-3)  # Hz of the device, s of its force
NODE_DELAYS = (0.0, 20e-3)  # s of the local model
STROKE = Hand(stroke=8e-3)  # along the skin, 8 mm, then still
KINDS = {"elastic": (None, None), "relaxing": (HELD_SKIN, None), "mu 0.5": (None, 0.5), "both": (HELD_SKIN, 0.5)}


def settings_for(device: Device, coupling: float, controller: bool) -> LoopSettings:
    """Settings whose controller cannot make a light or late device unstable by damping it too much."""
    late = 1 / device.rate + device.delay_steps / device.rate
    return LoopSettings(coupling_stiffness=coupling, controller=controller, delay_steps=device.delay_steps,
                        most_damping=min(20.0, 0.25 * device.mass / late),
                        velocity_noise=np.pi * device.cutoff * device.resolution)


def stiffest_coupling(spot: Spot, rate: float, delay: float, controller: bool) -> float:
    """Stiffest coupling of LEVELS that stays passive against a hard skin [N/m]; 0 when none does."""
    device = Device(rate=rate, delay_steps=round(delay * rate))
    hard = spot.with_modulus(HARD)
    last = last_passive(LEVELS, lambda kc: play(device, Hand(), settings_for(device, kc, controller), hard))
    return 0.0 if last is None else LEVELS[last[0]]


def stiffest_stroke(spot: Spot, kind: str, delay: float, controller: bool) -> float:
    """The same at 1 kHz for a press and a stroke on a hard skin of one of KINDS."""
    device = Device(delay_steps=round(1e3 * delay))
    hard = spot.with_modulus(HARD)
    hard = hard if kind == "elastic" else hard.with_memory(*KINDS[kind])
    last = last_passive(LEVELS, lambda kc: play(device, STROKE, settings_for(device, kc, controller), hard))
    return 0.0 if last is None else LEVELS[last[0]]


def stiffest_contact(spot: Spot, node_delay: float, controller: bool, held_force: bool) -> float:
    """Stiffest contact that stays passive under models that come late, at 1 kHz [N/m at the hold]; 0 when none does.

    The skin's modulus is raised; without the stiffness of the models, the contact's is that found with it.
    """
    device = Device()
    settings = settings_for(device, COUPLING, controller)
    last = last_passive(MODULI, lambda e: play(device, Hand(), settings, spot.with_modulus(e), node_delay=node_delay,
                                                held_force=held_force))
    if last is None:
        return 0.0
    felt = play(device, Hand(), replace(settings, controller=True), spot.with_modulus(MODULI[last[0]]))
    return felt.stiffness[0]


def last_passive(levels: list, run: Callable[[float], Felt]) -> tuple[int, Felt] | None:
    """The last level up to which all are passive: beyond the first that is not, some may be again."""
    kept = None
    for n, level in enumerate(levels):
        if not (felt := run(level)).passive:
            break
        kept = n, felt
    return kept


def guide(rate: float, delay: float) -> float:
    """K < 2 b / (T + 2 d), b of device and hand together [N/m].

    At no delay that is K < 2 b / T of Colgate & Schenkel 1994 ("Passivity of a class of sampled-data systems", for a
    spring without virtual damping); a delay d of the force adds d to the T / 2 by which a held sample is late.
    """
    return 2 * (Device().damping + Hand().damping) / (1 / rate + 2 * delay)


def forces_along(spot: Spot, start: np.ndarray, end: np.ndarray, step: float) -> np.ndarray:
    """The reaction's force at every `step` [m] from one place of the ball's centre to another, (N, 3) [N]."""
    count = round(float(np.linalg.norm(end - start)) / step)
    return np.array([spot.force(start + (end - start) * k / count) for k in range(count + 1)])


def worst_jump(forces: np.ndarray) -> float:
    """Largest change of the force between neighbours [N]."""
    return float(np.linalg.norm(np.diff(forces, axis=0), axis=1).max())


def paths(spot: Spot) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Ways of the ball's centre: along the arm, around it over the UV seam, down into contact."""
    layer = spot.toucher.layer
    seam = layer.vertices[layer.chart.seam_vertices]
    near = seam[np.linalg.norm(seam - spot.place, axis=1).argsort()[:6]]
    along = np.linalg.svd(near - near.mean(axis=0))[2][0]
    across = np.cross(spot.out, along)
    across /= np.linalg.norm(across)
    deep = spot.centre(-2e-3)
    return {
        "across the UV seam, 2 mm deep": (deep - 4e-3 * across, deep + 4e-3 * across),
        "over edges along it, 2 mm deep": (deep - 4e-3 * along, deep + 4e-3 * along),
        "down, 0.5 mm over to 2 mm under": (spot.centre(0.5e-3), deep),
    }


def slide(spot: Spot, way: tuple[np.ndarray, np.ndarray], *, blend: float, speed: float = 0.05,
          node_rate: float = 125.0) -> tuple[float, float]:
    """A device led along a way: the largest change of its force in 1 ms [N], and its RMS error at the proxy [N]."""
    loop, dt = DeviceLoop(LoopSettings(blend=blend)), 1e-3
    start, end = way
    count = round(float(np.linalg.norm(end - start)) / speed / dt)
    velocity = (end - start) / (count * dt)
    sent, errors, due = [], [], 0.0
    for k in range(-60, count + 1):  # it rests first, until the loop has settled
        place = start + (end - start) * max(k, 0) / count
        if k * dt >= due - 0.06 - 1e-9:
            loop.update(spot.model(loop.proxy if k > -60 else place))
            due += 1 / node_rate
        force = loop.step(place, velocity if k > 0 else np.zeros(3), dt).copy()
        if k >= 20:  # in contact from its first sample on, it first takes back what that gave out
            sent.append(force)
            errors.append(force + spot.force(loop.proxy))
    return worst_jump(np.array(sent)), float(np.sqrt(np.mean(np.square(errors))))


def cost(spot: Spot) -> None:
    """Prints what a local model and a step of the loop take."""
    print("what it takes                          median      p99")
    contact = Contact(spot.tool, spot.pose(spot.centre(-2e-3)))
    touch, history = spot.toucher.touch(contact), History(spot.toucher)
    model = local_contacts(history, [touch])[0]
    for name, call in (("touch", lambda: spot.toucher.touch(contact)),
                       ("local model beyond it", lambda: local_contacts(history, [touch])),
                       ("wrench of a model", lambda: model.wrench_at(contact.pose_body_from_tool))):  # fmt: skip
        median, p99 = _timed(call, 200)
        print(f"{name:35} {1e3 * median:7.2f}  {1e3 * p99:7.2f} ms")
    print(f"    the model holds within {1e3 * model.valid_m:.2f} mm and {np.degrees(model.valid_rad):.1f} degrees")
    loop, still = DeviceLoop(), np.zeros(3)
    loop.update(model)
    median, p99 = _timed(lambda: loop.step(spot.centre(-3e-3), still, 1e-3), 20_000)
    print(f"{'step of the device loop':35} {1e6 * median:7.2f}  {1e6 * p99:7.2f} us")
    matrix = model.stiffness[:3, :3]
    twisted = np.linalg.norm(matrix - matrix.T) / np.linalg.norm(matrix + matrix.T)
    print(f"the stiffness is skew by {100 * twisted:.1f} % (0 for a contact that stores all its work)\n")


def continuity(spot: Spot) -> None:
    """Prints the largest jump of the force for finer and finer steps of the tool."""
    steps = (1e-4, 2.5e-5, 6.25e-6)
    print("largest change of force, N per mm of way, at steps of " + ", ".join(f"{1e3 * s:g}" for s in steps) + " mm")
    for name, (start, end) in paths(spot).items():
        cells = [f"{worst_jump(forces_along(spot, start, end, s)) / s / 1e3:10.4f}" for s in steps]
        print(f"{name:35}" + "".join(cells))
    print()


def sliding(spot: Spot) -> None:
    """Prints how smooth and how right the loop's force is while the tool is led at 50 mm/s."""
    print("led at 50 mm/s, 125 models/s           blend    jump in 1 ms    RMS error")
    for name, way in paths(spot).items():
        for blend in (0.0, 8e-3):
            jump, error = slide(spot, way, blend=blend)
            print(f"{name:35} {1e3 * blend:6.0f} ms {1e3 * jump:10.2f} mN {1e3 * error:10.2f} mN")
    print()


def session(spot: Spot) -> None:
    """Prints presses at 1 kHz under models that come late: with and without their stiffness, and the controller."""
    late = 20e-3
    print(f"press, hold, let go at 1 kHz, coupling {COUPLING:g} N/m, 125 models/s {1e3 * late:g} ms late; energy: uJ\n"
          "       E   model        controller   contact     force   chatter     to the hand   least W")
    for modulus in (1e3, 2e4, 2e5):
        for held in (True, False):
            for controller in (False, True):
                settings = settings_for(Device(), COUPLING, controller)
                felt = play(Device(), Hand(), settings, spot.with_modulus(modulus), node_delay=late, held_force=held)
                print(f"{modulus / 1e3:4.0f} kPa   {'force only' if held else 'linear':12} "
                      f"{'on' if controller else 'off':>8} "
                      f"{felt.stiffness[0]:8.0f} N/m {felt.force_held:5.2f} N {felt.chatter:7.3f} N "
                      f"{1e6 * felt.given_out:14.0f} {1e6 * felt.balance.min():11.0f}   "
                      f"{'passive' if felt.passive else 'RINGS' if felt.rings else 'ACTIVE'}", flush=True)
    print()


def stiffness(spot: Spot) -> None:
    """Prints how far the stiffness of a model is off central differences of the touch, on the arm and on a forearm."""
    from tests.test_haptics import SHAPES, differences, error, standing

    forearm = Toucher(living(Body.anny(), "left_forearm", edge_length=4e-3))
    middle = int(np.linalg.norm(spot.toucher.layer.vertices - spot.place, axis=1).argmin())
    print(f"stiffness beside central differences [%]: all of it, along the normal\n{'':22}"
          + "".join(f"{name:>14}" for name in SHAPES))
    for where, toucher, vertex, depth in (("arm, 2.5 mm deep", spot.toucher, middle, 2.5e-3),
                                          ("forearm, 6 mm deep", forearm, 2443, 6e-3)):  # fmt: skip
        cells = []
        for tool in SHAPES.values():
            pose = standing(toucher.layer, vertex, depth)
            found = local_contact(toucher, Contact(tool, pose))
            true = differences(lambda at, t=toucher, one=tool: t.touch(Contact(one, at)).wrench, pose, 0.02)
            ours, theirs = (found.normal @ one[:3, :3] @ found.normal for one in (found.stiffness, true))
            cells.append(f"{100 * error(found.stiffness, true, 0.02):7.1f}, {100 * (ours / theirs - 1):+.1f}")
        print(f"{where:22}" + "".join(f"{cell:>14}" for cell in cells), flush=True)
    print()


def z_width(spot: Spot, kept: Path, seconds: float) -> dict[str, float]:
    """All cells of the maps; those already in `kept` are not measured again. Stops early after so many seconds."""
    cells: dict[str, float] = json.loads(kept.read_text()) if kept.exists() else {}
    wanted: dict[str, Callable[[], float]] = {}
    for kind in KINDS:
        for delay in DELAYS:
            for on in (False, True):
                wanted[f"stroke {kind} {delay:g} {on}"] = partial(stiffest_stroke, spot, kind, delay, on)
    for late in NODE_DELAYS:
        for on in (False, True):
            for held in (False, True):
                wanted[f"contact {late:g} {on} {held}"] = partial(stiffest_contact, spot, late, on, held)
    for delay in DELAYS:
        for on in (False, True):
            for rate in RATES:
                wanted[f"coupling {rate} {delay:g} {on}"] = partial(stiffest_coupling, spot, rate, delay, on)
    end = time.perf_counter() + seconds
    for name, measure in wanted.items():
        if name not in cells:
            if time.perf_counter() > end:
                print(f"stopped with {len(cells)} of {len(wanted)} cells; run it again")
                break
            cells[name] = measure()
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(cells, indent=1))
    return cells


def print_map(cells: dict[str, float]) -> None:
    """Prints both maps."""
    print("stiffest passive coupling against a hard skin [N/m], levels a factor 1.2 apart\n"
          "force late by   controller" + "".join(f"{r:>9} Hz" for r in RATES))
    for delay in DELAYS:
        _print_delay(cells, delay, [f"coupling {rate}" for rate in RATES])
        print(f"{'2 b / (T + 2 d)':>24}  " + "".join(f"{guide(r, delay):12.0f}" for r in RATES))
    print("\nthe same at 1 kHz, for a press and a stroke of 8 mm, by what the skin does\n"
          "force late by   controller" + "".join(f"{kind:>12}" for kind in KINDS))
    for delay in DELAYS:
        _print_delay(cells, delay, [f"stroke {kind}" for kind in KINDS])
    print("\nstiffest passive contact at 1 kHz, coupling 1 kN/m, 125 models/s [N/m], moduli a factor 2 apart\n"
          "models late by  controller  linear model  force only")
    for late in NODE_DELAYS:
        for on in (False, True):
            row = [cells.get(f"contact {late:g} {on} {held}", np.nan) for held in (False, True)]
            print(f"{1e3 * late:10.0f} ms {'on' if on else 'off':>10}  {row[0]:13.0f} {row[1]:11.0f}")
    print()


def _print_delay(cells: dict[str, float], delay: float, columns: Sequence[str]) -> None:
    """Prints two rows of a map, without and with the controller, for forces that are late by a delay [s]."""
    for on in (False, True):
        row = [cells.get(f"{column} {delay:g} {on}", np.nan) for column in columns]
        print(f"{1e3 * delay:10.0f} ms {'on' if on else 'off':>10}  " + "".join(f"{c:12.0f}" for c in row))


def draw(cells: dict[str, float], path: Path) -> None:
    """Draws both maps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(15, 4.2), layout="constrained")
    for delay, colour in zip(DELAYS, plt.get_cmap("viridis")(np.linspace(0, 0.85, len(DELAYS))), strict=True):
        for on in (False, True):
            row = [cells.get(f"coupling {r} {delay:g} {on}", np.nan) for r in RATES]
            left.loglog(RATES, row, "o-" if on else "s--", color=colour, mfc=colour if on else "white",
                        label=f"force {1e3 * delay:.0f} ms late" if on else None)
        left.loglog(RATES, [guide(r, delay) for r in RATES], ":", color=colour, lw=1)
    left.plot([], [], "k-o", label="with the controller")
    left.plot([], [], "k--s", mfc="white", label="without")
    left.plot([], [], "k:", label="2 b / (T + 2 d)")
    left.set(xlabel="rate of the device loop [Hz]", ylabel="stiffest passive coupling [N/m]",
             title="Virtual coupling on a hard skin", ylim=(200, 1e5))
    left.set_xticks(RATES, [str(r) for r in RATES], minor=False)
    left.minorticks_off()
    left.legend(fontsize=8, ncols=2)
    for n, kind in enumerate(KINDS):
        for on in (False, True):
            row = [cells.get(f"stroke {kind} {delay:g} {on}", np.nan) for delay in DELAYS]
            middle.bar(np.arange(len(DELAYS)) + 0.2 * (n - 1.5), row, 0.18, color=f"C{n}", alpha=0.35 if on else 1.0,
                       zorder=2 if on else 3, label=None if on else kind)
    middle.set_yscale("log")
    middle.set_xticks(range(len(DELAYS)), [f"{1e3 * d:.0f} ms" for d in DELAYS])
    middle.set(xlabel="delay of the force", ylabel="stiffest passive coupling [N/m]", ylim=(100, None),
               title="Press and stroke at 1 kHz (pale: with the controller)")
    middle.legend(fontsize=8)
    late = 1e3 * np.array(NODE_DELAYS)
    for held, colour in ((False, "C0"), (True, "C3")):
        for on in (False, True):
            row = np.array([cells.get(f"contact {t:g} {on} {held}", np.nan) for t in NODE_DELAYS])
            name = "force held between answers" if held else "local model"
            right.semilogy(late, np.maximum(row, 10), "o-" if on else "s--", color=colour,
                           mfc=colour if on else "white", label=f"{name}, {'with' if on else 'without'} controller")
    right.set(xlabel="delay of the node's answers [ms]", ylabel="stiffest passive contact [N/m]",
              title="Contact, 125 answers/s, loop at 1 kHz")
    right.legend(fontsize=8)
    for axis in (left, middle, right):
        axis.grid(True, which="major", alpha=0.3)
    figure.savefig(path, dpi=130)


def _timed(call: Callable[[], object], count: int) -> tuple[float, float]:
    """Median and 99th percentile [s]."""
    spent = np.empty(count)
    for k in range(count):
        start = time.perf_counter()
        call()
        spent[k] = time.perf_counter() - start
    return float(np.median(spent)), float(np.quantile(spent, 0.99))


def main() -> None:
    """Prints the tables and draws the map."""
    parts = {"cost": cost, "continuity": continuity, "slide": sliding, "session": session, "stiffness": stiffness}
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--parts", nargs="+", default=[*parts, "map"], choices=[*parts, "map"])
    given.add_argument("--picture", type=Path, default=Path("docs/pictures/z_width.png"))
    given.add_argument("--cells", type=Path, default=Path("runs/z_width.json"), help="what the map has measured so far")
    given.add_argument("--seconds", type=float, default=3600.0, help="that the map may take")
    options = given.parse_args()
    spot = arm_spot()
    print(f"{spot.toucher.layer}\n{machine()}; load {os.getloadavg()[0]:.1f} before the run\n")
    for name in options.parts:
        if name in parts:
            parts[name](spot)
    if "map" in options.parts:
        cells = z_width(spot, options.cells, options.seconds)
        print_map(cells)
        draw(cells, options.picture)


if __name__ == "__main__":
    main()
