"""Export of a scene that PolyFEM reads: tetrahedra as Gmsh's .msh, tagged faces as .txt, and the problem as .json.

Written after PolyFEM's own specification (json-specs/input-spec.json of github.com/polyfem/polyfem) and its sources:
"NeoHookean" has the energy of our Tissue; a positive "pressure_boundary" presses in and follows the skin (its energy is
p times volume); a "neumann_boundary" is a dead traction; a selection file has one row "id a b c" a face. Forces on
single nodes cannot be asked of it, so dead nodal forces become dead tractions of the same sum, constant on each face.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from stmpl_core.arrays import Points
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from studies.tets import TetFem, TetMesh

MESH, FACES, SCENE = "layer.msh", "faces.txt", "scene.json"
HELD = 100  # tag of the held faces; the loaded ones follow. PolyFEM's own tags of a box's sides are 1 to 7
TETRAHEDRON = 4  # Gmsh's number of the element type


def export(folder: str | Path, layer: SoftLayer, load: Load, fem: TetFem | None = None) -> Path:
    """Writes the patch around a load, as `fem` (TetFem()) would solve it, for `PolyFEM_bin --json scene.json`.

    PolyFEM writes solution.txt beside it: the displacement of every node of the mesh, the patch's skin first.

    Returns:
        The path of the .json.

    Raises:
        InvalidInput: there is no load, or it does not fit the layer.
    """
    fem = (fem or TetFem()).prepare(layer)
    if not len(load.check(layer).loaded):
        raise InvalidInput("there is no load: PolyFEM would have nothing to do.")
    patch = fem.patch_around(load.loaded)
    mesh = fem.tets(patch)
    held = fem.held(patch, mesh) | mesh.core
    where = Path(folder)
    where.mkdir(parents=True, exist_ok=True)
    write_msh(where / MESH, mesh.points, mesh.tets)
    corner = patch.interpolate(load.pressure_on(layer))[mesh.triangles]
    loaded = np.flatnonzero(corner.any(axis=1))
    tags = [(HELD, face) for face in held_faces(mesh, held)]
    tags += [(HELD + 1 + k, mesh.triangles[face]) for k, face in enumerate(loaded)]
    (where / FACES).write_text("".join(f"{tag} {a} {b} {c}\n" for tag, (a, b, c) in tags))
    kind = "nodal" if load.kind == "nodal" else "pressure"
    if kind == "pressure":
        values = [float(p) for p in corner[loaded].mean(axis=1)]
    else:
        traction = patch.interpolate(load.forces_on(layer) / layer.vertex_areas[:, None])
        values = traction[mesh.triangles[loaded]].mean(axis=1).tolist()
    scene = where / SCENE
    scene.write_text(json.dumps(problem(layer, kind, values), indent=2) + "\n")
    return scene


def problem(layer: SoftLayer, kind: str, values: list[Any]) -> dict[str, Any]:
    """The problem in PolyFEM's words; `values` of the loaded faces: pressures [Pa], or tractions (3,) [Pa]."""
    tissue = layer.tissue
    condition = "pressure_boundary" if kind == "pressure" else "neumann_boundary"
    loads = [{"id": HELD + 1 + k, "value": value} for k, value in enumerate(values)]
    return {
        "geometry": [{"mesh": MESH, "surface_selection": FACES}],
        "materials": {
            "type": "NeoHookean",
            "E": tissue.youngs_modulus,
            "nu": tissue.poisson_ratio,
            "rho": tissue.density,
        },
        "space": {"discr_order": 1},
        "boundary_conditions": {"dirichlet_boundary": [{"id": HELD, "value": [0, 0, 0]}], condition: loads},
        "output": {
            "paraview": {"file_name": "result.vtu"},
            "data": {"solution": "solution.txt", "advanced": {"reorder_nodes": True}},
        },
    }


def held_faces(mesh: TetMesh, held: np.ndarray) -> np.ndarray:
    """Faces of the mesh's boundary with all three nodes held, but for those of the skin, (N, 3)."""
    faces = mesh.boundary_faces()
    skin = {tuple(face) for face in np.sort(mesh.triangles, axis=1)}
    return np.array([face for face in faces[held[faces].all(axis=1)] if tuple(face) not in skin])


def write_msh(path: Path, points: Points, tets: np.ndarray) -> None:
    """Gmsh's text format 2.2: nodes [m] and tetrahedra, numbered from 1."""
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$Nodes", str(len(points))]
    lines += [f"{n} {x:.17g} {y:.17g} {z:.17g}" for n, (x, y, z) in enumerate(points, 1)]
    lines += ["$EndNodes", "$Elements", str(len(tets))]
    lines += [f"{n} {TETRAHEDRON} 2 1 1 {' '.join(map(str, tet))}" for n, tet in enumerate(tets + 1, 1)]
    path.write_text("\n".join([*lines, "$EndElements", ""]))
