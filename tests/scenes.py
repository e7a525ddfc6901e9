"""Skins, tools, contacts and loads that the tests share; what product type they are made of is known here alone."""

import numpy as np
import trimesh

from stmpl_core import Answer, Contact, Load, Membrane, Ply, SoftLayer, Tissue, Tool, Touch

RADIUS, LENGTH = 0.04, 0.16  # m, of the limb
THICKNESS = 7.5e-3  # m
STACK = Tissue(3e3, 0.4, skin=Membrane(2e5, 1.5e-3, 15.0), deeper=(Ply(8e-3, 15e3, 0.4),))


# Skins


def limb(edge: float = 3e-3, thickness: float = THICKNESS, radius: float = RADIUS, length: float = LENGTH,
         **tissue: float) -> SoftLayer:  # fmt: skip
    """An open cylinder along +z of nearly equilateral triangles, facing outwards."""
    around, rings = round(2 * np.pi * radius / edge), round(length / (edge * 3**0.5 / 2))
    column, row = np.meshgrid(np.arange(around), np.arange(rings + 1))
    angle = 2 * np.pi * (column + 0.5 * (row % 2)) / around
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), row * length / rings], axis=-1).reshape(-1, 3)
    a, below = np.arange(around), np.arange(rings)[:, None] * around
    p, q = below + a, below + (a + 1) % around
    u, w = p + around, q + around
    even = np.stack([p, q, u, q, w, u], axis=-1).reshape(rings, -1, 3)
    odd = np.stack([p, q, w, p, w, u], axis=-1).reshape(rings, -1, 3)
    faces = np.where((np.arange(rings) % 2 == 0)[:, None, None], even, odd).reshape(-1, 3)
    return SoftLayer(vertices, faces, thickness, tissue=Tissue(**tissue))


def plate(size: float = 0.12, edge: float = 3e-3, thickness: float = THICKNESS, *, crossed: bool = False,
          **tissue: float) -> SoftLayer:  # fmt: skip
    """A flat square in the plane z = 0, centred at the origin, facing +z; `crossed`: with diagonals turned about."""
    n = round(size / edge)
    x, y = np.meshgrid(np.linspace(-size / 2, size / 2, n + 1), np.linspace(-size / 2, size / 2, n + 1))
    vertices = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    row, column = np.divmod(np.arange(n * n), n)
    p = row * (n + 1) + column
    a, b, c, d = p, p + 1, p + n + 2, p + n + 1
    other = (crossed & ((row + column) % 2 == 1))[:, None]
    first = np.where(other, np.stack([a, b, d], axis=1), np.stack([a, b, c], axis=1))
    second = np.where(other, np.stack([b, c, d], axis=1), np.stack([a, c, d], axis=1))
    return SoftLayer(vertices, np.concatenate([first, second]), thickness, tissue=Tissue(**tissue))


def wavy_layer(n: int = 6, h: float = 3e-3) -> SoftLayer:
    """A bumpy patch of n x n vertices, h apart [m]."""
    flat = plate((n - 1) * h, h, crossed=True)
    x, y, _ = flat.vertices.T
    return flat.with_(vertices=np.column_stack([x, y, 1e-3 * np.sin(100 * x) * np.cos(80 * y)]))


def dented() -> SoftLayer:
    """A limb with a dent at half its height that is tighter than the layer is thick, and so folds there."""
    layer = limb(4e-3, length=0.24)
    away = np.linalg.norm(layer.vertices - layer.vertices[len(layer.vertices) // 2], axis=1)
    return layer.with_(vertices=layer.vertices * np.where(away < 3e-3, 0.8, 1.0)[:, None] ** [1, 1, 0])


def placed(layer: SoftLayer, motion: np.ndarray) -> SoftLayer:
    """The layer where a rigid motion (4, 4) takes it."""
    return layer.with_(vertices=layer.vertices @ motion[:3, :3].T + motion[:3, 3])


def enlarged(layer: SoftLayer, by: float) -> SoftLayer:
    return layer.with_(vertices=by * layer.vertices, thickness=by * layer.thickness)


# Tools


def tool(mesh: trimesh.Trimesh, unit: float = 1.0, name: str = "probe") -> Tool:
    """A tool of a mesh whose coordinates are in `unit` [m]."""
    return Tool(name, unit * np.asarray(mesh.vertices), mesh.faces)


def ball(radius: float = 0.012, subdivisions: int = 3) -> Tool:
    return tool(trimesh.creation.icosphere(subdivisions, radius))


def box(x: float, y: float, z: float) -> Tool:
    """With these sides [m], centred at its own origin."""
    return tool(trimesh.creation.box((x, y, z)))


def punch(radius: float = 0.01, height: float = 0.03) -> Tool:
    """A flat, sharp-edged cylinder along z, centred at its own origin."""
    return tool(trimesh.creation.cylinder(radius, height, sections=48))


def band() -> Tool:
    """A ring along z around the limb, 2 mm deep in it."""
    return tool(trimesh.creation.annulus(RADIUS - 0.002, RADIUS + 0.01, 0.02, sections=96))


def capsule(height: float, radius: float, count: int = 32) -> Tool:
    """Along z, centred. Made in millimetres: trimesh drops triangles under 1e-8 of whatever unit."""
    return tool(trimesh.creation.capsule(1e3 * height, 1e3 * radius, count=[count, count]), 1e-3)


def wire(radius: float, thickness: float) -> Tool:
    """A ring about z, of round wire of a thickness [m], bent to a radius [m]."""
    return tool(trimesh.creation.torus(1e3 * radius, 500 * thickness, major_sections=120, minor_sections=24), 1e-3)


def brush(count: int = 7) -> Tool:
    """Pins of 2.2 mm radius along z, one in the middle and up to six 8 mm around it."""
    pin, angle = capsule(0.01, 2.2e-3, 16), np.arange(count - 1) * np.pi / 3
    places = np.vstack([np.zeros(3), 8e-3 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])])
    faces = [pin.faces + k * len(pin.vertices) for k in range(count)]
    return Tool("brush", np.concatenate([pin.vertices + place for place in places]), np.concatenate(faces))


def v_block(opening: float) -> Tool:
    """Two walls that open along -x by so many degrees."""
    walls, half = [], np.radians(opening / 2)
    for side in (1, -1):
        wall, frame = trimesh.creation.box((0.12, 0.01, 0.05)), np.eye(4)
        along, out = np.array([-np.cos(half), side * np.sin(half), 0]), np.array([np.sin(half), side * np.cos(half), 0])
        frame[:3, :3], frame[:3, 3] = np.column_stack([along, out, np.cross(along, out)]), 0.06 * along + 0.005 * out
        walls.append(wall.apply_transform(frame))
    return tool(trimesh.util.concatenate(walls))


def scaled(tool: Tool, by: float) -> Tool:
    return Tool(tool.name, by * tool.vertices, tool.faces)


# Poses and contacts


def turn(axis: tuple[float, float, float], angle: float, move: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """A rigid transform, (4, 4)."""
    pose = trimesh.transformations.rotation_matrix(angle, axis)
    pose[:3, 3] = move
    return pose


def at(x: float, y: float, z: float) -> np.ndarray:
    return turn((0, 0, 1), 0.0, (x, y, z))


def contact_of(tool: Tool, pose: np.ndarray, wrench: np.ndarray | None = None, name: str = "probe") -> Contact:
    """A tool at a pose (4, 4), with a wrench (6,) on the body or none."""
    return Contact(tool if tool.name == name else tool.named(name), pose, wrench)


def press(tool: Tool, pose: np.ndarray, force: tuple[float, float, float] | None, name: str = "probe") -> Contact:
    """A tool that pushes with a force through its own origin, or none."""
    return contact_of(tool, pose, None if force is None else np.array([*force, 0.0, 0.0, 0.0]), name)


# Answers


def touch_of(answer: Answer, name: str = "probe") -> Touch:
    """What `answer` says of the tool `name`."""
    return answer.touches[name]


# Loads


def smooth_disc(vertices: np.ndarray, centre: np.ndarray, radius: float, edge: float) -> np.ndarray:
    """1 within `radius` of `centre`, falling to 0 over `edge` by a smoothstep centred on the rim, (V,)."""
    x = np.clip((radius - np.linalg.norm(vertices - centre, axis=1)) / edge + 0.5, 0, 1)
    return x * x * (3 - 2 * x)


def disc(layer: SoftLayer, ratio: float, centre: tuple | np.ndarray, radius: float, edge: float = 6e-3) -> Load:
    """A pressure of `ratio` E on a disc around `centre`."""
    return Load.pressure(ratio * layer.tissue.youngs_modulus * smooth_disc(layer.vertices, centre, radius, edge))


def bump(points: np.ndarray, peak: float, radius: float) -> np.ndarray:
    """A pressure that falls from `peak` on the z axis to 0 at `radius` as cos^2, (n,) [Pa]."""
    r = np.minimum(np.linalg.norm(points[:, :2], axis=1) / radius, 1)
    return peak * np.cos(0.5 * np.pi * r) ** 2
