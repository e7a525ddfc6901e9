"""flat: presses into flat stacks (fem_tools.rounds) on plates of triangles, as a ContactNet sees them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import trimesh
from scipy.spatial import Delaunay

from fem_tools.axisymmetric import Profile, Round
from fem_tools.rounds import THICKNESS, Pressed
from stmpl_core.columns import Columns
from stmpl_core.contact_net import ContactNet
from stmpl_core.green import Green
from stmpl_core.layer import SoftLayer
from stmpl_core.sdf import SignedDistance
from stmpl_core.tissue import Tissue
from stmpl_core.tool import Tool
from studies.pressed import Rows, rows_of

EDGES = (0.3, 0.3)  # longest edges of a plate's triangles, over the thickness and over the tool's radius
BEYOND = 4  # edges of plate beyond what is touched
AROUND = 24  # points around the axis at which each ring's force is set down
TURNED = 0.37  # of a plate beneath its tool, and off its middle, so that no node stands on a vertex [edges, rad]


def tool_of(profile: Profile, height: float) -> Tool:
    """The solid of revolution, `height` [m] high, about the origin of its profile."""
    solid = trimesh.creation.revolve(1e3 * profile.outline(height), sections=96)
    return Tool("round", 1e-3 * np.asarray(solid.vertices), np.asarray(solid.faces))


def plate(tissue: Tissue, radius: float, edge: float) -> SoftLayer:
    """A flat stack of equilateral triangles to a radius [m], its outside up."""
    many = int(radius / edge) + 2
    x, y = np.meshgrid(np.arange(-many, many + 1.0), np.arange(-many, many + 1.0))
    places = edge * np.column_stack([(x + 0.5 * (y % 2)).ravel(), 0.5 * np.sqrt(3) * y.ravel()])
    places = places[np.hypot(*places.T) < radius]
    faces = Delaunay(places).simplices
    a, b, c = (places[faces[:, k]] for k in range(3))
    double = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    faces = np.where(double[:, None] > 0, faces, faces[:, ::-1])[np.abs(double) > 1e-3 * edge**2]
    cosine, sine = np.cos(TURNED), np.sin(TURNED)
    places = places @ np.array([[cosine, sine], [-sine, cosine]]) + TURNED * edge * np.array([1.0, 0.4])
    return SoftLayer(np.column_stack([places, np.zeros(len(places))]), faces, THICKNESS, tissue=tissue)


def pressure_on(layer: SoftLayer, one: Round) -> np.ndarray:
    """Pressure over E at the vertices of a plate, (V,): each ring's force on the corners of the triangles under it."""
    places, force = layer.vertices[:, :2], np.diff(one.carried, prepend=0.0)
    mesh = Delaunay(places)
    angle = 2 * np.pi * (np.arange(AROUND) + 0.5) / AROUND
    bears = np.flatnonzero(np.abs(force) > 1e-9 * np.abs(force).max())
    points = (one.radius[bears, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).reshape(-1, 2)
    found = mesh.find_simplex(points)
    to = mesh.transform[found]
    first = np.einsum("nij,nj->ni", to[:, :2], points - to[:, 2])
    shares = np.column_stack([first, 1 - first.sum(axis=1)])
    at_vertices = np.zeros(len(places))
    np.add.at(at_vertices, mesh.simplices[found], shares * (np.repeat(force[bears], AROUND) / AROUND)[:, None])
    return at_vertices / layer.vertex_areas / layer.tissue.youngs_modulus


def flat_rows(press: Pressed) -> Iterator[Rows]:
    """What a ContactNet sees of each depth of a press, and what is true there."""
    tissue, profile = press.tissue, press.tool
    if not press.rounds:
        return
    edge = min(EDGES[0] * THICKNESS, EDGES[1] * profile.width)
    layer = plate(tissue, max(profile.width, max(touched(one) for one in press.rounds)) + BEYOND * edge, edge)
    Green(layer, None).keep(layer)  # the coarse part of what is flat is nothing
    net, columns = ContactNet(layer), Columns(layer)
    field = SignedDistance.of(tool_of(profile, 2 * max(profile.width, THICKNESS)), margin=0.7 * THICKNESS)
    for one in press.rounds:
        pose = np.eye(4)
        pose[2, 3] = -one.depth - profile.lowest
        if (rows := rows_of(layer, columns.squeezed(field, pose).nodes, pressure_on(layer, one), net)) is not None:
            yield rows


def touched(one: Round) -> float:
    """Radius within which the skin carries all but a thousandth of the force [m]."""
    return float(one.radius[np.searchsorted(one.carried, 0.999 * one.force)])
