"""The verbs of studies: one function each, which the command line calls; what a verb needs is imported in it."""

from __future__ import annotations

import dataclasses
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from stmpl_core.console import print_figures, steps_bar
from stmpl_core.errors import InvalidInput
from stmpl_core.extras import needed
from stmpl_core.outputs import writable_file, writable_folder

if TYPE_CHECKING:
    from collections.abc import Callable

    from stmpl_core.methods.base import Method

Json = Annotated[bool, tyro.conf.arg(name="json")]

STABILITY_METHODS = ("moment_net", "linear", "winkler", "naive", "zero")  # of studies.stability.METHODS, fast ones


def train(
    preset: Literal[
        "default", "contacts", "tissue", "paper", "paper-reduced", "paper-3-bodies", "paper-reduced-3-bodies"
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
        preset: default, contacts and tissue are ours (under an hour on two cores), paper the paper's UNet (a GPU),
            paper-reduced the same code at a size for one core; 3-bodies: its second set-up.
        data: folder of the data set; make it with stmpl generate.
        out: folder of the weights; runs/train/<preset> unless given.
        steps: number of steps of the optimiser; of epochs for the paper's presets.
        seed: seed of weights and order.
        as_json: card on stdout, for machines.
    """
    needed("stmpl train", "learn", "torch", "zarr", "shapely")
    from studies.train import train as learn

    folder = writable_folder(out or Path("runs/train") / preset)
    with steps_bar(f"train {preset}", quiet=as_json) as show:
        card = learn(preset, data, folder, steps=steps, seed=seed, on_progress=show)
    print_figures(card if as_json else f"weights and their card are in {folder}")
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
        out: file for the tables in Markdown; their figures go beside it as JSON.
        as_json: figures on stdout, for machines.
    """
    needed("stmpl tables", "studies", "torch", "zarr", "shapely")
    if out is not None:
        writable_file(out)
    from stmpl_core.methods import Linear, MomentNet, UNet
    from studies.evaluate import THREE_BODY_ROW, evaluate

    methods: dict[str, Callable[[], Method]] = {"linear": Linear, "unet": lambda: UNet(unet)}
    if unet_3_bodies is not None:
        methods[THREE_BODY_ROW] = lambda: UNet(unet_3_bodies)
    methods["moment_net"] = lambda: MomentNet(moment_net)
    with steps_bar("tables", quiet=as_json) as show:
        made = evaluate(data, methods, limit=limit, on_progress=lambda done, total: show(done, total, "samples"))
    if out is not None:
        out.write_text(made.markdown() + "\n")
        out.with_suffix(".json").write_text(made.as_json() + "\n")
    sys.stdout.write((made.as_json() if as_json else made.text()) + "\n")
    return 0


def chart(
    preset: Literal["default", "quick"] = "default",
    out: Path = Path("runs/chart"),
    redraw: bool = False,
    as_json: Json = False,
) -> int:
    """Speed against accuracy: every method, its own knob swept, on the same scenes; a picture, a page to point at.

    A run that was stopped goes on where it was.

    Example: stmpl chart --out runs/chart
    Peers that are installed (pip install 'stmpl[peers]') are on it as well.

    Args:
        preset: default (the arm at 3 mm, five scenes, two loads; about twenty minutes), quick (a coarse forearm).
        out: folder of chart.png, chart.html, break_even.png and chart.json.
        redraw: pictures of out/chart.json again, without measuring.
        as_json: all points on stdout, for machines.
    """
    needed("stmpl chart", "studies", "torch", "threadpoolctl", "shapely")
    from studies.chart import CURVES, PRESETS, Chart, measure
    from studies.chart.break_even import break_even, draw_break_even
    from studies.chart.page import write_page
    from studies.chart.picture import draw
    from studies.show import chart_table

    writable_folder(out)
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
    print_figures(dataclasses.asdict(measured) if as_json else chart_table(measured, rows, out))
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
        errors: errors against finite elements as well, and how often the stated bounds hold.
        out: file of the measured chart; the user's cache for times, runs/calibrate/ladder.json for errors.
        contacts: folder of a data set of the preset contacts, for what rigid tools press with (with --errors).
        trials: folder of the single trials (with --errors), which are not measured twice.
        as_json: figures on stdout, for machines.
    """
    needed("stmpl calibrate", "studies", "anny", "torch", "zarr", "shapely")
    from fem_tools.ladder import times_file
    from studies import calibrate as measuring
    from studies.show import coverage_table, times_table

    file = writable_file(out or (trials / "ladder.json" if errors else times_file()))
    with steps_bar("calibrate", quiet=as_json) as show:
        if not errors:
            found = measuring.times(on_progress=show)
        else:
            made = measuring.gather(trials, contacts=contacts, on_progress=show)
            found = measuring.fit(made)
    if errors:
        found.save(file)
        rows = measuring.coverage(made, found)
        print_figures({"rows": [vars(row) for row in rows]} if as_json else coverage_table(rows))
        return 0
    found.save(file)
    print_figures(dataclasses.asdict(found) if as_json else times_table(found, file))
    return 0


def stability(
    methods: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--method"])] = STABILITY_METHODS,
    preset: Literal["default", "quick"] = "default",
    only: Literal["all", "pressures", "contacts", "strokes"] = "all",
    out: Path | None = None,
    again: Path | None = None,
    fuzz: int = 0,
    seed: int = 0,
    critical_load: bool = False,
    as_json: Json = False,
) -> int:
    """Where methods fail: pressures, meshes, tools and more, swept until a law breaks; a table and a picture.

    Example: stmpl stability --methods moment_net winkler
    Your own: stmpl stability --methods yours.py
    Random contacts: stmpl stability --fuzz 10000 --methods moment_net
    One failure again: stmpl stability --again runs/stability/failures/pressure_5_E.moment_net.json
    The finite elements' own limits: stmpl stability --critical-load --out critical_load.png

    Args:
        methods: names (zero, naive, winkler, linear, limb_linear, moment_net, unet, fem_1_step, fem, ladder), or a
            file of yours with a class that has prepare and solve; file.py:attribute or module:attribute where there are
            more.
        preset: default (minutes a method, on the arm), quick (seconds, on a round limb).
        only: axes to sweep: all, those of pressures, those of rigid tools, those of strokes with a state.
        out: folder of report, tables, picture and failures, runs/stability unless given; the picture with
            --critical-load.
        again: file of a failure to run again with the same method.
        fuzz: number of random contacts to ask each method for instead (5 to 50 ms each).
        seed: seed of the random contacts.
        critical_load: presses of a flat layer by follower, dead and indenter loads with each element and mesh width
            until it fails, beside the closed form (minutes).
        as_json: figures on stdout, for machines.
    """
    if critical_load:
        return _critical_load(out or Path("runs/critical_load.png"), as_json)
    from studies.show import stability_markdown, stability_table
    from studies.stability import PRESETS, maker
    from studies.stability import again as run_again
    from studies.stability import stability as sweep
    from studies.stability.picture import draw

    if again is not None:
        row = run_again(again, maker)
        said = "\n".join(f"{b.law}: {b.measured} ({'flagged' if b.flagged else 'not flagged'})" for b in row.broken)
        told = f"{row.method} at {row.axis} {row.level}: {row.outcome}\n{said}".strip()
        print_figures(dataclasses.asdict(row) if as_json else told)
        return 1 if row.broken else 0
    if fuzz < 0:
        raise InvalidInput(f"--fuzz is {fuzz}; how many contacts is needed, or 0 for the sweep.")
    if fuzz > 0:
        return _fuzz(methods, fuzz, seed, out or Path("runs/fuzz"), as_json)
    folder = writable_folder(out or Path("runs/stability"))
    with steps_bar("stability", quiet=as_json) as show:
        report = sweep({name: maker(name) for name in methods}, PRESETS[preset].only(only), folder, on_progress=show)
    picture = draw(report, folder / "stability.png")
    (folder / "stability.md").write_text(stability_markdown(report))
    print_figures(report.as_dict() if as_json else stability_table(report, picture))
    return 0


def validate(
    out: Path = Path("runs/validate"), quick: bool = False, multis: Path | None = None, as_json: Json = False
) -> int:
    """The model beside published measurements on people: value, spread, whether they meet, and why not.

    Rows that do not meet stay in the table. What a parameter was fitted on is shown, and not judged.

    Example: stmpl validate --quick

    Args:
        out: folder of report.json, table.md and validate.png.
        quick: rows of the closed form only (seconds); the others press balls by finite elements (half a minute).
        multis: folder or file of the public MULTIS data (see studies/validate/multis.py), whose rows are added.
        as_json: report on stdout, for machines.
    """
    needed("stmpl validate", "studies", "matplotlib")
    from studies.show import validation_table
    from studies.validate import ROWS, as_dict, judge, save
    from studies.validate.multis import read, rows

    writable_folder(out)
    asked = (*ROWS, *(rows(read(multis)) if multis else ()))
    with steps_bar("validate", quiet=as_json) as show:
        judged = judge(asked, quick=quick, on_progress=show)
    picture = save(judged, out)
    print_figures(as_dict(judged) if as_json else validation_table(judged, picture))
    return 0


def _fuzz(methods: tuple[str, ...], count: int, seed: int, out: Path, as_json: bool) -> int:
    from studies.show import fuzz_table
    from studies.stability import maker
    from studies.stability.fuzz import fuzz

    found = {}
    writable_folder(out)
    for name in methods:
        with steps_bar(f"contacts of {name}", quiet=as_json) as show:
            found[name] = fuzz(name, maker(name), count, seed, out / Path(name).stem, on_progress=show)
    told = {name: dataclasses.asdict(one) for name, one in found.items()}
    print_figures(told if as_json else fuzz_table(found, out))
    return int(any(one.outcomes.get(bad, 0) for one in found.values() for bad in ("silent", "crashed")))


def _critical_load(out: Path, as_json: bool) -> int:
    from studies.critical_load import critical_loads, draw, presses
    from studies.show import critical_load_table

    rows, total = [], len(presses())
    writable_file(out)
    with steps_bar("presses of a flat layer", quiet=as_json) as show:
        for row in critical_loads():
            rows.append(row)
            show(len(rows), total, "")
    picture = draw(rows, out)
    figures = {"picture": str(picture), "rows": [vars(row) for row in rows]}
    print_figures(figures if as_json else critical_load_table(rows, picture))
    return 0
