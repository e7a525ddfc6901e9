"""Axisymmetric: a tool of revolution that sticks to a flat stack it is pressed into, by elements in the (r, z) plane.

Quadratic quadrilaterals of scikit-fem; a press takes seconds where solid elements take minutes, so that every stack and
every depth can be looked at. Energies as in Bonet & Wood, 2nd ed., eq. 6.28; the skin is a membrane in plane stress.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import skfem
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from stmpl_core.errors import InvalidInput
from stmpl_core.tissue import Membrane, Tissue

FARTHEST = 2.0  # angle from the contact to the rim of a stack around a ball, at most [rad]
WIDE = 4.0  # distance from the contact to the plate's rim, which is held [thicknesses]
PER_KAPPA = 0.2  # of that, more for each unit of E_s h / (E t): skin carries strain further
PENALTY = 300.0  # stiffness with which skin is held where it stuck [E over the thickness of the contact's elements]
TOLERANCE, NEARLY = 1e-5, 2e-2  # residual over the force of the tool; the same while what sticks is not yet known
LONGEST, FIRST = 0.05, 0.003  # longest step of the tool, and the first one [thicknesses]
GROWING = 0.2  # longest step, over the depth: where skin sticks depends on the way there
SHORTEST = 1 / 64  # of it: a press that needs shorter ones ends
MOST = 12  # Newton steps of one set of places that stick
SETS = 24  # such sets a step
WITHIN = 1e-3  # depth of skin in the tool that is none, over the finest element
STEP = 1e-6  # of central differences
Energy = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # F_rr, F_rz, F_zr, F_zz, F_tt to stresses and tangent


class Profile(NamedTuple):
    """A tool of revolution: all that is within `rounding` of a segment in the (r, z) half plane, and what is above it.

    Args:
        inner, outer: ends of the segment, its outer one not lower than the inner [m].
        rounding: distance [m].
    """

    inner: tuple[float, float]
    outer: tuple[float, float]
    rounding: float

    @property
    def lowest(self) -> float:
        """Height of its lowest point [m]."""
        return self.inner[1] - self.rounding

    @property
    def width(self) -> float:
        """Its radius [m]."""
        return self.outer[0] + self.rounding

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance of points (2, ...) [m] in its frame, and where on the surface is nearest, (2, ...)."""
        a, b = (np.array(end).reshape(2, *(1,) * (points.ndim - 1)) for end in (self.inner, self.outer))
        along, way = b - a, points - a
        square = float((along**2).sum())
        share = np.clip((along * way).sum(axis=0) / square, 0, 1) if square > 0 else np.zeros(points.shape[1:])
        off = way - share * along
        far = np.maximum(np.sqrt((off**2).sum(axis=0)), 1e-12)
        return far - self.rounding, points + off * (self.rounding / far - 1)

    def normal(self, surface: np.ndarray) -> np.ndarray:
        """Unit normals out of the tool at places on its surface (2, ...)."""
        _, outside = self._replace(rounding=0.0).nearest(surface)
        return (surface - outside) / max(self.rounding, 1e-12)

    def outline(self, height: float, points: int = 24) -> np.ndarray:
        """The closed curve that is turned about the axis, the tool `height` [m] high, (N, 2) [m]."""
        way = np.array(self.outer) - self.inner
        down = np.arctan2(way[1], way[0]) - np.pi / 2 if way.any() else -np.pi / 2
        ends = ((self.inner, -np.pi / 2 if self.inner[0] == 0 else -np.pi, down), (self.outer, down, 0.0))
        arcs = [np.array(middle) + self.rounding * np.column_stack([np.cos(a), np.sin(a)])
                for middle, start, end in ends for a in [np.linspace(start, end, points)]]  # fmt: skip
        top = self.lowest + height
        below = np.vstack([*arcs, [[self.width, top], [max(self.inner[0] - self.rounding, 0.0), top]]])
        below[below[:, 0] < 1e-9, 0] = 0.0  # on the axis, where the curve need not be closed
        below = below[np.concatenate([[True], np.hypot(*np.diff(below, axis=0).T) > 1e-9])]
        return np.vstack([below, below[:1]])


@dataclass(frozen=True)
class Round:
    """One converged depth of a press.

    Args:
        depth: of the tool's lowest point below the skin at rest [m].
        force: of the tool [N].
        radius: places on the skin at rest, increasing, (N,) [m].
        carried: force that the skin within each radius carries, (N,) [N].
        moved: motion of the skin there, away from the axis and upwards, (2, N) [m].
    """

    depth: float
    force: float
    radius: np.ndarray
    carried: np.ndarray
    moved: np.ndarray


def neo_hookean(modulus: float, nu: float) -> Energy:
    """First Piola-Kirchhoff stress of mu/2 (I_C - 3) - mu ln J + lambda/2 (ln J)^2, and its derivative."""
    mu, lam = modulus / (2 * (1 + nu)), modulus * nu / ((1 + nu) * (1 - 2 * nu))

    def law(f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rr, rz, zr, zz, tt = f
        plane = rr * zz - rz * zr
        log = np.log(plane * tt)
        inverse = np.array([zz / plane, -zr / plane, -rz / plane, rr / plane, 1 / tt])  # of F transposed
        tangent = lam * inverse[:, None] * inverse[None]
        rest = mu - lam * log
        for i in range(5):
            tangent[i, i] += mu
        for i, (a, b) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):  # d inverse_ab / d F_cd = -inverse_ad inverse_cb
            for j, (c, d) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
                tangent[i, j] += rest * inverse[2 * a + d] * inverse[2 * c + b]
        tangent[4, 4] += rest * inverse[4] ** 2
        return mu * (f - inverse) + lam * log * inverse, tangent

    return law


def membrane(skin: Membrane) -> Callable[[np.ndarray], np.ndarray]:
    """Forces a length of a sheet whose thickness follows from no stress across it, and of its tension [N/m]."""
    mu = skin.youngs_modulus / (2 * (1 + skin.poisson_ratio))
    lam = 2 * mu * skin.poisson_ratio / (1 - 2 * skin.poisson_ratio)

    def stress(f: np.ndarray) -> np.ndarray:
        rr, _, zr, _, tt = f
        along = np.sqrt(rr * rr + zr * zr)
        across = np.ones_like(along)
        for _ in range(60):  # mu (l - 1 / l) + lam ln(J) / l = 0, by Newton on l
            wrong = mu * (across**2 - 1) + lam * np.log(along * tt * across)
            across = np.maximum(across - wrong / (2 * mu * across + lam / across), 0.2 * across)
            if np.abs(wrong).max() < 1e-13 * mu:
                break
        log = np.log(along * tt * across)
        pull = skin.thickness * (mu * (along - 1 / along) + lam * log / along) + skin.tension * tt
        hoop = skin.thickness * (mu * (tt - 1 / tt) + lam * log / tt) + skin.tension * along
        zero = np.zeros_like(hoop)
        return np.array([pull * rr / along, zero, pull * zr / along, zero, hoop])

    return stress


def tangent_of(stress: Callable[[np.ndarray], np.ndarray], f: np.ndarray) -> np.ndarray:
    """Derivative of stresses (5, ...), by central differences, (5, 5, ...)."""
    out = np.empty((5, *f.shape))
    for j in range(5):
        ahead, behind = f.copy(), f.copy()
        ahead[j] += STEP
        behind[j] -= STEP
        out[:, j] = (stress(ahead) - stress(behind)) / (2 * STEP)
    return out


class Points:
    """Quadrature points of a basis: what a motion does there, and forces and stiffness from there.

    Args:
        basis: vector basis in the (r, z) plane, of elements or of faces.
    """

    def __init__(self, basis: Any) -> None:
        self.basis, self.place = basis, basis.global_coordinates()
        fields, r = [each[0] for each in basis.basis], self.place[0]
        self.value = np.array([np.asarray(one) for one in fields]).transpose(1, 0, 2, 3)  # (2, n, elements, points)
        self.strain = np.array([[*one.grad[0], *one.grad[1], np.asarray(one)[0] / r] for one in fields]
                               ).transpose(1, 0, 2, 3)  # rr, rz, zr, zz, tt  # fmt: skip
        self.weight, self.dofs = 2 * np.pi * r * basis.dx, basis.element_dofs

    def at(self, u: np.ndarray, shapes: np.ndarray) -> np.ndarray:
        """Values of a motion, by shapes (c, n, elements, points), at the points, (c, elements, points)."""
        return np.einsum("cnep,ne->cep", shapes, u[self.dofs])

    def assembled(self, shapes: np.ndarray, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, Any]:
        """Forces and stiffness, from derivatives of an energy by shapes, (c, ...) and (c, c, ...)."""
        count = len(self.dofs)
        by = shapes.transpose(2, 1, 0, 3).reshape(shapes.shape[2], count, -1)  # elements, shapes, components and points
        own = (first * self.weight).transpose(1, 0, 2).reshape(len(by), -1, 1)
        half = np.einsum("cdep,dmep->ecpm", second * self.weight, shapes, optimize=True).reshape(len(by), -1, count)
        out = np.bincount(self.dofs.T.ravel(), (by @ own).ravel(), self.basis.N)
        rows, columns = np.repeat(self.dofs.T, count, axis=1), np.tile(self.dofs.T, count)
        blocks = (rows.ravel(), columns.ravel())
        return out, coo_matrix(((by @ half).ravel(), blocks), shape=(self.basis.N,) * 2).tocsr()


@dataclass(frozen=True)
class Flat:
    """A flat stack on a rigid base; or one around a rigid ball.

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness [m].
        fine: factor on the number of elements each way.
        radius: of the ball that its outer surface is a part of [m]; infinite: flat.

    Raises:
        InvalidInput: the radius is not above the thickness, or the stack around a ball has a skin: a membrane is known
            flat.
    """

    tissue: Tissue
    thickness: float
    fine: float = 1.0
    radius: float = np.inf

    def __post_init__(self) -> None:
        if not self.radius > self.thickness:
            raise InvalidInput(f"radius is {self.radius:g} m; it must be above the thickness, {self.thickness:g} m.")
        if self.radius < np.inf and self.tissue.skin:
            raise InvalidInput("A skin is known on a flat stack only, not around a ball.")

    def press(self, tool: Profile, depths: Sequence[float]) -> list[Round]:
        """Presses a tool in that sticks wherever it touches, to depths [m] that increase; ends where Newton does."""
        solver, out, at, share = _Solver(self, tool, max(depths)), [], 0.0, 1.0
        for depth in depths:
            while at < depth:
                step = share * self.thickness * min(max(FIRST, GROWING * at / self.thickness), LONGEST)
                to = depth if at + 1.001 * step >= depth else at + step
                if solver.go(to):
                    at, share = to, min(2 * share, 1.0)
                elif share < SHORTEST:
                    return out
                else:
                    share *= 0.5
            out.append(solver.seen(depth))
        return out


class _Solver:
    """One press, from depth to depth."""

    def __init__(self, flat: Flat, tool: Profile, deepest: float) -> None:
        tissue, t, self.tool = flat.tissue, flat.thickness, tool
        mesh, kinds, finest = _mesh(flat, tool, deepest)
        element = skfem.ElementVector(skfem.ElementQuad2())
        top = mesh.facets_satisfying(lambda x: np.isclose(x[1], 0.0))
        flat_basis, far = skfem.Basis(mesh, element, intorder=4), mesh.p[0].max()
        held = flat_basis.get_dofs(lambda x: np.isclose(x[1], -t) | np.isclose(x[0], far)).all()
        axis = flat_basis.get_dofs(lambda x: np.isclose(x[0], 0.0)).all("u^1")
        mesh = _around(mesh, flat.radius)
        self.basis = basis = skfem.Basis(mesh, element, intorder=4)
        self.inside, self.skin = Points(basis), Points(skfem.FacetBasis(mesh, element, facets=top, intorder=5))
        self.free = np.setdiff1d(np.arange(basis.N), np.union1d(held, axis))
        self.pull = membrane(tissue.skin) if tissue.skin else None
        laws = [neo_hookean(tissue.youngs_modulus, tissue.poisson_ratio)]
        laws += [neo_hookean(ply.youngs_modulus, ply.poisson_ratio) for ply in tissue.deeper]
        self.laws = [(law, np.flatnonzero(kinds == k)) for k, law in enumerate(laws)]
        self.penalty, self.least = PENALTY * tissue.youngs_modulus / finest, 1e-3 * tissue.youngs_modulus * finest**2
        self.within = WITHIN * finest
        shape = self.skin.weight.shape
        self.u, self.stuck, self.anchor = np.zeros(basis.N), np.zeros(shape, bool), np.zeros((2, *shape))

    def go(self, depth: float) -> bool:
        """Goes on to a depth [m]; whether it came there: where it did not, nothing has changed."""
        move = np.array([0.0, -depth - self.tool.lowest])[:, None, None]
        u, stuck, anchor = self.u, self.stuck.copy(), self.anchor.copy()
        near = True
        for _ in range(SETS):
            found = self._solved(u, stuck, anchor + move, NEARLY if near else TOLERANCE)
            if found is None:
                return False
            u = found
            place = self.skin.place + self.skin.at(u, self.skin.value)
            traction = self.penalty * (anchor + move - place)
            distance, surface = self.tool.nearest(place - move)
            gone = stuck & ((traction * self.tool.normal(anchor)).sum(axis=0) < 0)
            free_skin = np.where(stuck, 0.0, distance)
            new = free_skin < min(0.5 * float(free_skin.min()), -self.within)
            if not gone.any() and not new.any():
                if near:
                    near = False
                    continue
                self.u, self.stuck, self.anchor = u, stuck, anchor
                return True
            anchor = np.where(new, surface, anchor)
            stuck = (stuck & ~gone) | new
        return False

    def _solved(self, u: np.ndarray, stuck: np.ndarray, to: np.ndarray, within: float) -> np.ndarray | None:
        """Motion in equilibrium with the skin held at `to` (2, ...) [m] where it stuck; None where there is none."""
        rest = np.array([1.0, 0, 0, 1, 1])[:, None, None]
        stiff, scale = np.zeros((2, 2, *stuck.shape)), 0.0
        stiff[0, 0] = stiff[1, 1] = self.penalty * stuck
        wrong = last = np.inf
        step = np.zeros_like(u)
        for _ in range(MOST):
            f = rest + self.inside.at(u + step, self.inside.strain)
            if ((f[0] * f[3] - f[1] * f[2]) * f[4]).min() <= 0.01 or f[4].min() <= 0:
                if not step.any() or np.abs(step).max() < 1e-9:
                    return None
                step *= 0.5
                continue
            u = u + step
            stress, tangent = np.empty_like(f), np.empty((5, *f.shape))
            for law, own in self.laws:
                stress[:, own], tangent[:, :, own] = law(f[:, own])
            residual, stiffness = self.inside.assembled(self.inside.strain, stress, tangent)
            if self.pull:
                g = rest + self.skin.at(u, self.skin.strain)
                more = self.skin.assembled(self.skin.strain, self.pull(g), tangent_of(self.pull, g))
                residual, stiffness = residual + more[0], stiffness + more[1]
            push = self.penalty * stuck * (self.skin.place + self.skin.at(u, self.skin.value) - to)
            more = self.skin.assembled(self.skin.value, push, stiff)
            residual, stiffness = residual + more[0], stiffness + more[1]
            wrong = float(np.abs(residual[self.free]).max())
            scale = max(abs(float((push[1] * self.skin.weight).sum())), self.least)
            if wrong < within * scale or (wrong < 1e-4 * scale and wrong > 0.5 * last):
                return u
            last = wrong
            step = np.zeros_like(u)
            step[self.free] = splu(stiffness.tocsc()[self.free][:, self.free]).solve(-residual[self.free])
        return None

    def seen(self, depth: float) -> Round:
        """What the skin does and carries now."""
        place = self.skin.place
        to = self.anchor + np.array([0.0, -depth - self.tool.lowest])[:, None, None]
        moved = self.skin.at(self.u, self.skin.value)
        down = self.penalty * self.stuck * (place + moved - to)[1] * self.skin.weight
        order = np.argsort(place[0].ravel())
        carried = np.cumsum(down.ravel()[order])
        return Round(depth, float(carried[-1]), place[0].ravel()[order], carried,
                     moved.reshape(2, -1)[:, order])  # fmt: skip


def _around(mesh: skfem.MeshQuad, radius: float) -> skfem.MeshQuad:
    """A flat mesh bent around a ball of a radius [m]: heights stay, and lengths along the outer surface."""
    if radius == np.inf:
        return mesh
    along, height = mesh.p
    out, up = radius + height, along / radius
    return skfem.MeshQuad(np.vstack([out * np.sin(up), out * np.cos(up) - radius]), mesh.t)


def _mesh(flat: Flat, tool: Profile, deepest: float) -> tuple[skfem.MeshQuad, np.ndarray, float]:
    """Quadrilaterals, finest under the tool, the material of each, and the length of the finest [m]."""
    tissue, t = flat.tissue, flat.thickness
    kappa = tissue.skin.stiffness / (tissue.youngs_modulus * t) if tissue.skin else 0.0
    sunk = min(deepest, tool.rounding)
    contact = tool.outer[0] + np.sqrt(2 * tool.rounding * sunk - sunk**2)
    near = 1.15 * contact + 0.02 * t
    many = int(round(flat.fine * 20))
    size = near / many
    r = [near * k / many for k in range(many + 1)]
    if near + t > FARTHEST * flat.radius:
        raise InvalidInput(f"the tool covers {near / flat.radius:.1f} rad of it; at most {FARTHEST:g} are meshed.")
    end, growing = min(near + (WIDE + PER_KAPPA * kappa) * t, FARTHEST * flat.radius), size
    while r[-1] < end:
        growing = min(1.3 * growing, 0.35 * t / flat.fine)
        r.append(r[-1] + growing)
    ends = [0.0, *(ply.depth for ply in tissue.deeper if ply.depth < t), t]
    down, kind, growing = [0.0], [], min(size, 0.12 * t)
    for k, (a, b) in enumerate(pairwise(ends)):
        at = a
        while at < b - 1e-12:
            growing = min(1.3 * growing, 0.16 * t / flat.fine)
            at = b if at + 1.5 * growing > b else at + growing
            down.append(at)
            kind.append(k)
    mesh = skfem.MeshQuad.init_tensor(np.array(r), np.sort(-np.array(down)))
    middle = -mesh.p[1][mesh.t].mean(axis=0)
    return mesh, np.array(kind)[np.searchsorted(np.array(down), middle) - 1], size
