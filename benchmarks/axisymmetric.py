"""A ball pressed deep into a flat stack: finite elements of the ground truth beside others of another make.

    .venv/bin/python -m benchmarks.axisymmetric     # prints; about five minutes

The others are axisymmetric: quadratic quadrilaterals of scikit-fem in the (r, z) plane, stresses written here from the
definitions of the energies (Bonet & Wood, 2nd ed., eq. 6.28; skin a membrane in plane stress, or elements of its own
with their bending), their derivatives by central differences, contact by a penalty. With them goes what a skin of
elements does that a membrane does not.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import skfem
from scipy.sparse.linalg import spsolve

from fem_tools.axisymmetric import Points, membrane, tangent_of
from fem_tools.tool_contact import Friction
from stmpl_core.tissue import Membrane, Ply, Tissue

WIDE = 4.0  # radius of the plate, whose rim is held [thicknesses]
PENALTY = 400.0  # stiffness of the contact [E over the ball's radius]
SOFT = 1e-3  # depth in the ball over its radius by which that stiffness is reached, from 0
TOLERANCE = 1e-7  # residual over the largest force of the step before
UPDATES = 4  # updates of the contact's multipliers at each depth that is asked for
LONGEST = 0.025  # longest step of the ball [thicknesses]
MOST = 40  # Newton steps a depth
Energy = Callable[[np.ndarray], np.ndarray]  # F_rr, F_rz, F_zr, F_zz, F_tt to their conjugate stresses


@dataclass(frozen=True)
class Plate:
    """A flat stack on a rigid base.

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness [m].
        solid_skin: whether the skin is elements of its thickness on top, not a membrane.
        fine: factor on the number of elements each way.
    """

    tissue: Tissue
    thickness: float
    solid_skin: bool = False
    fine: float = 1.0


def neo_hookean(modulus: float, nu: float, film: float = 0.0) -> Energy:
    """First Piola-Kirchhoff stress of mu/2 (I_C - 3) - mu ln J + lambda/2 (ln J)^2 + film (a - 1).

    a is the area stretch of planes z = const: a film of constant tension, spread through the depth [Pa].
    """
    mu, lam = modulus / (2 * (1 + nu)), modulus * nu / ((1 + nu) * (1 - 2 * nu))

    def stress(f: np.ndarray) -> np.ndarray:
        rr, rz, zr, zz, tt = f
        plane = rr * zz - rz * zr
        log = np.log(plane * tt)
        inverse = np.array([zz / plane, -zr / plane, -rz / plane, rr / plane, 1 / tt])  # of F transposed
        out = mu * (f - inverse) + lam * log * inverse
        along = np.sqrt(rr * rr + zr * zr)
        out[0] += film * tt * rr / along
        out[2] += film * tt * zr / along
        out[4] += film * along
        return out

    return stress


def forces(plate: Plate, radius: float, depths: Sequence[float]) -> list[float]:
    """Force on a ball without friction at depths that increase [N].

    Args:
        plate: stack.
        radius: radius of the ball [m].
        depths: depths of its lowest point below the skin at rest [m].

    Raises:
        RuntimeError: a depth at which Newton does not converge.
    """
    mesh, kinds = _mesh(plate, radius, max(depths))
    element = skfem.ElementVector(skfem.ElementQuad2())
    basis = skfem.Basis(mesh, element, intorder=4)
    top = mesh.facets_satisfying(lambda x: np.isclose(x[1], mesh.p[1].max()))
    inside, skin = Points(basis), Points(skfem.FacetBasis(mesh, element, facets=top, intorder=6))
    held = basis.get_dofs(lambda x: np.isclose(x[1], mesh.p[1].min()) | np.isclose(x[0], mesh.p[0].max())).all()
    axis = basis.get_dofs(lambda x: np.isclose(x[0], 0.0)).all("u^1")
    free = np.setdiff1d(np.arange(basis.N), np.union1d(held, axis))
    sheet = plate.tissue.skin if not plate.solid_skin else None
    pull = membrane(sheet) if sheet else None
    penalty = PENALTY * plate.tissue.youngs_modulus / radius
    laws = [(law, np.flatnonzero(kinds == k)) for k, law in enumerate(_laws(plate))]
    rest = np.array([1.0, 0, 0, 1, 1])[:, None, None]

    def equations(u: np.ndarray, centre: float, given: np.ndarray) -> tuple[np.ndarray, Any, np.ndarray]:
        """Residual [N], tangent [N/m] and pressure on the ball [Pa], with multipliers `given` [Pa]."""
        f = rest + inside.at(u, inside.strain)
        if ((f[0] * f[3] - f[1] * f[2]) * f[4]).min() <= 0:
            raise FloatingPointError
        stress, tangent = np.empty_like(f), np.empty((5, *f.shape))
        for law, own in laws:
            stress[:, own], tangent[:, :, own] = law(f[:, own]), tangent_of(law, f[:, own])
        residual, stiffness = inside.assembled(inside.strain, stress, tangent)
        if pull:
            g = rest + skin.at(u, skin.strain)
            more = skin.assembled(skin.strain, pull(g), tangent_of(pull, g))
            residual, stiffness = residual + more[0], stiffness + more[1]
        way = skin.place + skin.at(u, skin.value) - np.array([0.0, centre])[:, None, None]
        away = np.hypot(*way)
        deep, normal, soft = np.maximum(radius - away + given / penalty, 0.0), way / away, SOFT * radius
        pressure = penalty * np.where(deep < soft, deep**2 / (2 * soft), deep - soft / 2)
        across = np.eye(2)[..., None, None] - normal[:, None] * normal
        stiff = penalty * np.minimum(deep / soft, 1) * normal[:, None] * normal - pressure / away * across
        push = -pressure * normal
        more = skin.assembled(skin.value, push, stiff)
        return residual + more[0], stiffness + more[1], pressure

    def force_on(u: np.ndarray, centre: float, pressure: np.ndarray) -> float:
        way = skin.place + skin.at(u, skin.value) - np.array([0.0, centre])[:, None, None]
        return abs(float((pressure * way[1] / np.hypot(*way) * skin.weight).sum()))

    def solved(u: np.ndarray, centre: float, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Motion and pressure in equilibrium."""
        scale = 0.0
        for _ in range(MOST):
            residual, tangent, pressure = equations(u, centre, given)
            wrong = float(np.abs(residual[free]).max())
            scale = max(scale, wrong, float((pressure * skin.weight).sum()) * 1e-2)
            if wrong < TOLERANCE * scale:
                return u, pressure
            step = np.zeros(basis.N)
            step[free] = np.asarray(spsolve(tangent.tocsc()[free][:, free], -residual[free]))
            for _ in range(30):
                try:
                    trial = float(np.abs(equations(u + step, centre, given)[0][free]).max())
                except FloatingPointError:
                    trial = np.inf
                if trial < 10 * wrong:
                    break
                step *= 0.5
            u = u + step
        raise RuntimeError(f"no solution with the ball's middle at {1e3 * centre:.2f} mm")

    u, out, given = np.zeros(basis.N), [], np.zeros(skin.weight.shape)
    surface = float(mesh.p[1].max())
    for depth in _between(depths, LONGEST * plate.thickness):
        centre = surface + radius - depth
        u, pressure = solved(u, centre, given)
        if depth in depths:
            for _ in range(UPDATES):
                given = pressure
                u, pressure = solved(u, centre, given)
            out.append(force_on(u, centre, pressure))
    return out


def _between(depths: Sequence[float], longest: float) -> list[float]:
    """The depths, and others between them, so that no step is longer than `longest` [m]."""
    out, before = [], 0.0
    for depth in depths:
        many = int(np.ceil((depth - before) / longest))
        out += [*(before + (depth - before) * k / many for k in range(1, many)), depth]
        before = depth
    return out


def _laws(plate: Plate) -> list[Energy]:
    """Law of each material, from the skin's, if it has elements, downwards."""
    tissue, skin = plate.tissue, plate.tissue.skin
    laws = [neo_hookean(tissue.youngs_modulus, tissue.poisson_ratio)]
    laws += [neo_hookean(ply.youngs_modulus, ply.poisson_ratio) for ply in tissue.deeper]
    if plate.solid_skin and skin:
        laws.insert(0, neo_hookean(skin.youngs_modulus, skin.poisson_ratio, skin.tension / skin.thickness))
    return laws


def _mesh(plate: Plate, radius: float, depth: float) -> tuple[skfem.MeshQuad, np.ndarray]:
    """Quadrilaterals, finest under the ball, and the material of each."""
    t, contact = plate.thickness, np.sqrt(2 * radius * depth)
    many = [int(round(plate.fine * n)) for n in (16, 14, 6)]
    near = np.linspace(0, 1.3 * contact, many[0] + 1)
    far = 1.3 * contact + (WIDE * t - 1.3 * contact) * np.linspace(0, 1, many[1] + 1)[1:] ** 1.8
    ends = [0.0, *(ply.depth for ply in plate.tissue.deeper if ply.depth < t), t]
    steps = np.linspace(0, 1, many[2] + 1)[1:]
    down = np.concatenate([[0.0], *(a + (b - a) * steps for a, b in pairwise(ends))])
    kind = np.repeat(np.arange(len(ends) - 1), many[2])
    if plate.solid_skin and plate.tissue.skin:
        layers = int(round(2 * plate.fine))
        skin = -plate.tissue.skin.thickness * np.linspace(1, 0, layers + 1)[:-1]
        down, kind = np.concatenate([skin, down]), np.concatenate([np.zeros(layers, int), kind + 1])
    mesh = skfem.MeshQuad.init_tensor(np.concatenate([near, far]), np.sort(-down))
    middle = -mesh.p[1][mesh.t].mean(axis=0)
    return mesh, kind[np.searchsorted(down, middle) - 1]


def ground_truth(plate: Plate, radius: float, depths: Sequence[float], edge: float, refine: int = 2, *,
                 friction: Friction = "none") -> list[float]:  # fmt: skip
    """Force on the same ball by IndenterFem [N], on a plate of edges `edge` [m], refined near the ball."""
    import trimesh

    from fem_tools import IndenterFem, PatchFem, Press
    from stmpl_core import SoftLayer, Tool
    from stmpl_core.sdf import SignedDistance
    from studies.critical_load import flat_skin

    layer = SoftLayer(*flat_skin((WIDE + 0.3) * plate.thickness, edge), plate.thickness, tissue=plate.tissue)
    ball, pose = trimesh.creation.icosphere(4, radius), np.eye(4)
    pose[2, 3] = radius + 1e-3
    field = SignedDistance.of(Tool("ball", np.asarray(ball.vertices), np.asarray(ball.faces)), margin=2 * radius)
    press = Press(field, pose, np.array([0.0, 0.0, -1.0]))
    patch = PatchFem(reach=WIDE, refine=refine, layers=1, check_stability=False)
    fem = IndenterFem(patch, friction=friction, step=0.1).prepare(layer)
    return [answer.force for answer in fem.path([press], depths)]


STACK = Tissue(3e3, 0.45, skin=Membrane(2e5, 1.5e-3, 20.0), deeper=(Ply(10e-3, 15e3, 0.45),))
PLATE = Plate(STACK, 20e-3)
RADIUS = 10e-3  # of the ball [m]
SHARES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)  # depths over the thickness


def main() -> None:
    """Prints forces, how far apart they are, and what solid skin changes."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--edge", type=float, default=5e-3, help="edges of the ground truth before refinement [m]")
    depths = [share * PLATE.thickness for share in SHARES]
    truth = ground_truth(PLATE, RADIUS, depths, options.parse_args().edge)
    others = forces(PLATE, RADIUS, depths)
    coarser = forces(replace(PLATE, fine=0.7), RADIUS, depths)
    solid = forces(replace(PLATE, solid_skin=True), RADIUS, depths)
    print("depth/t  IndenterFem  axisymmetric  coarser   apart   solid skin")
    for share, a, b, c, d in zip(SHARES, truth, others, coarser, solid, strict=False):
        print(f"{share:7.2f}  {a:9.4f} N  {b:10.4f} N  {100 * (c / b - 1):+8.2f} %  {100 * (a / b - 1):+5.2f} %  "
              f"{100 * (d / b - 1):+7.2f} %")  # fmt: skip


if __name__ == "__main__":
    main()
