"""Makes the files of stmpl_core/limbs anew: Anny's average body at rest, and its parts at 3 mm edges.

    .venv/bin/python -m studies.limbs          # a minute; needs the extra bodies

MMG's meshes may differ in the last bits from processor to processor; answers on the shipped limbs do not.
"""

from __future__ import annotations

import sys
from pathlib import Path

from stmpl_core import limbs
from stmpl_core.anny_model import build
from stmpl_core.body import PARTS, Body


def make(folder: Path) -> None:
    """Writes the body and each of its parts into `folder`, and prints what they take."""
    vertices, faces, uv, weights, bones = build({}, {})
    _told(limbs.write_body(folder, (vertices, faces, uv), weights, bones), len(vertices))
    body = Body("anny", vertices, faces, uv, weights, bones)
    for part in PARTS:
        patch = body.patch(part, limbs.EDGE_LENGTH)
        skin = patch.mesh.transfer @ body.vertices[patch.source]
        assert patch.mesh.uv is not None  # Anny has UVs
        _told(limbs.write_part(folder, part, (skin, patch.mesh.faces, patch.mesh.uv)), len(skin))


def _told(path: Path, vertices: int) -> None:
    sys.stdout.write(f"{path.name}: {vertices} vertices, {path.stat().st_size} bytes\n")


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else limbs.FOLDER)
