"""Surfaces as strangers bring them: what is mended, what is said, and that the field is that of the clean surface."""

import igl
import numpy as np
import pytest
import trimesh

from stmpl_core import Tool
from stmpl_core.decimation import field_spacing
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.fields import fields_of
from stmpl_core.mending import Mended, closed, mended
from stmpl_core.sdf import SignedDistance

RNG = np.random.default_rng(7)


def shapes() -> dict[str, trimesh.Trimesh]:
    made = {
        "capsule": trimesh.creation.capsule(30.0, 8.0, count=[16, 16]),
        "torus": trimesh.creation.torus(12, 4, 24, 12),
        "box": trimesh.creation.box([30.0, 20, 12]).subdivide().subdivide(),
    }
    for mesh in made.values():
        mesh.apply_scale(1e-3)  # made in millimetres: trimesh drops small triangles
    return made


SHAPES = shapes()


def same_surface(mesh: Mended, clean: trimesh.Trimesh) -> bool:
    """Whether both have the same triangles, wound the same way."""
    def rows(vertices: np.ndarray, faces: np.ndarray) -> set[tuple[float, ...]]:
        corners = np.round(vertices[faces], 8)
        first = np.lexsort(corners.transpose(2, 0, 1)[::-1], axis=1)[:, 0]
        turned = np.take_along_axis(corners, ((first[:, None] + np.arange(3)) % 3)[:, :, None], axis=1)
        return set(map(tuple, turned.reshape(len(faces), 9) + 0.0))
    return len(mesh.faces) == len(clean.faces) and rows(mesh.vertices, mesh.faces) == rows(clean.vertices, clean.faces)


def distances(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distance to the triangles themselves, (N,) [m]."""
    unsigned = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_UNSIGNED
    return np.asarray(igl.signed_distance(points, np.array(vertices), np.array(faces, np.int64), unsigned)[0])


@pytest.mark.parametrize("name", SHAPES)
def test_a_sound_surface_comes_back_as_it_was(name: str) -> None:
    vertices, faces = np.array(SHAPES[name].vertices), np.array(SHAPES[name].faces, np.int32)
    mesh = mended(vertices, faces)
    assert mesh.vertices is vertices and np.array_equal(mesh.faces, faces) and mesh.said == ()


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("soup", [False, True])
def test_any_winding_becomes_outwards(name: str, soup: bool) -> None:
    clean = SHAPES[name]
    for share in (0.01, 0.3, 0.5, 0.9):
        turned = RNG.random(len(clean.faces)) < share
        faces = np.where(turned[:, None], clean.faces[:, ::-1], clean.faces)
        vertices = np.array(clean.vertices)
        if soup:
            vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
        mesh = mended(vertices, faces)
        assert same_surface(mesh, clean)
        assert mesh.said == (f"{turned.sum()} of {len(faces)} faces {'was' if turned.sum() == 1 else 'were'} turned, "
                             "to be wound like the others and outwards.",)


def test_useless_faces_and_vertices_are_dropped_with_a_word() -> None:
    clean = SHAPES["box"]
    faces = np.vstack([clean.faces, [[0, 0, 5], [1, 2, 2]], clean.faces[:3], clean.faces[4:5, ::-1]])
    mesh = mended(np.vstack([clean.vertices, [[0, 0, 1.0]]]), faces)
    assert same_surface(mesh, clean)
    assert mesh.said == ("2 faces without area were dropped.", "4 repeated faces were dropped.",
                         "1 vertex that no face uses was dropped.")


def test_faces_of_three_places_in_a_row_stay_because_they_close_seams() -> None:
    tetrahedron = np.array([[0, 0, 0], [0.02, 0, 0], [0, 0.02, 0], [0, 0, 0.02], [0.01, 0, 0]])
    faces = np.array([[0, 2, 1], [0, 4, 3], [4, 1, 3], [1, 2, 3], [0, 3, 2], [0, 1, 4]])  # the last has no area
    mesh = mended(tetrahedron, faces)
    assert mesh.said == () and SignedDistance.of(Tool("probe", mesh.vertices, mesh.faces), spacing=1e-3).watertight


def test_a_wall_between_two_boxes_is_no_surface() -> None:
    one = trimesh.creation.box([0.02, 0.02, 0.02])
    other = one.copy()
    other.vertices[:, 0] *= -1
    other.invert()
    other.vertices[:, 0] += 0.02
    faces = np.vstack([one.faces, other.faces + 8])
    mesh = mended(np.vstack([one.vertices, other.vertices]), faces)
    assert len(mesh.faces) == 20 and closed(mesh.vertices, mesh.faces) and mesh.said[0].startswith("4 repeated")


def test_parts_are_turned_one_by_one_and_a_cavity_stays_one() -> None:
    ball = trimesh.creation.icosphere(2, 0.01)
    hollow = np.vstack([ball.vertices, 0.5 * ball.vertices]), np.vstack([ball.faces, ball.faces[:, ::-1] + 162])
    assert mended(*hollow).said == ()
    assert mended(hollow[0], hollow[1][:, ::-1]).said == ()  # inside out as a whole: the field turns it and says so
    beside = mended(np.vstack([ball.vertices, ball.vertices + 0.03]), hollow[1])
    assert same_surface(beside, trimesh.util.concatenate([ball, ball.copy().apply_translation([0.03] * 3)]))


def test_what_cannot_be_mended_is_refused_in_a_sentence() -> None:
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    half, way = angle / 2, np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    rim = [(0.02 + w * np.cos(half))[:, None] * way + np.outer(w * np.sin(half), [0, 0, 1]) for w in (-0.004, 0.004)]
    a = np.arange(40)
    b, turn = (a + 1) % 40, 40 * (a == 39)
    strip = np.vstack([np.column_stack([a, b + turn, a + 40]),
                       np.column_stack([b + turn, (b + 40 + turn) % 80, a + 40])])  # fmt: skip
    with pytest.raises(MeshError, match="one side only"):
        mended(np.vstack(rim), strip)
    with pytest.raises(MeshError, match="nothing to touch"):
        mended(np.eye(3), [[0, 0, 1], [1, 2, 2]])
    with pytest.raises(MeshError, match=r"name vertices 0\.\.9"):
        mended(np.eye(3), [[0, 1, 9]])
    with pytest.raises(InvalidInput, match="not finite"):
        mended(np.full((3, 3), np.nan), [[0, 1, 2]])


@pytest.mark.parametrize("name", SHAPES)
def test_a_fine_surface_is_reduced_to_what_its_field_resolves(name: str) -> None:
    fine = SHAPES[name].copy()
    while len(fine.faces) < 100_000:
        fine = fine.subdivide()
    mesh = mended(fine.vertices, fine.faces)
    assert len(mesh.faces) < 50_000 and closed(mesh.vertices, mesh.faces)
    assert f"{len(fine.faces):,} triangles were reduced to {len(mesh.faces):,}: the field resolves" in mesh.said[-1]
    spacing = field_spacing(fine.area, fine.extents)
    points = fine.triangles_center[::29]
    points = points + spacing * RNG.normal(size=points.shape)
    full = distances(points, fine.vertices, fine.faces)
    assert np.abs(distances(points, mesh.vertices, mesh.faces) - full).max() < 0.1 * spacing


def test_a_thin_plate_and_a_needle_survive_the_reduction() -> None:
    plate, needle = trimesh.creation.box([80, 80, 0.3]), trimesh.creation.cylinder(0.1, 100, sections=12)
    needle.apply_translation([0, 0, 51])
    while len(plate.faces) < 150_000:
        plate = plate.subdivide()
    both = trimesh.util.concatenate([plate, needle.subdivide().subdivide()]).apply_scale(1e-3)
    mesh = mended(both.vertices, both.faces)
    along = np.linspace(0, 1, 50)
    probes = np.vstack([np.outer(along, [0, 0, 0.1]), np.outer(along - 0.5, [0.08, 0, 0]) + [0, 0.03, 0]])
    assert len(mesh.faces) < 50_000 and distances(probes, mesh.vertices, mesh.faces).max() < 5e-4


def corrupted(mesh: trimesh.Trimesh, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, bool]:
    """A copy that was damaged in a few ways, and whether its sign must still be that of the clean one."""
    vertices, faces, same = np.array(mesh.vertices), np.array(mesh.faces), True
    for kind in rng.choice(["flip", "repeat", "point", "line", "soup", "drop", "merge", "stray", "nan"],
                           size=rng.integers(1, 5), p=[0.35, 0.1, 0.1, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05]):  # fmt: skip
        some = rng.integers(len(faces), size=rng.integers(1, 9))
        if kind == "flip":
            turned = rng.random(len(faces)) < rng.random()
            faces = np.where(turned[:, None], faces[:, ::-1], faces)
        elif kind == "repeat":
            faces = np.vstack([faces, np.roll(faces[some], 1, axis=1)])
        elif kind in ("point", "line"):
            faces = np.vstack([faces, faces[some][:, [0, 0, 0] if kind == "point" else [0, 1, 1]]])
        elif kind == "soup":
            vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
        elif kind == "drop":
            faces, same = np.delete(faces, some[:1], axis=0), False
        elif kind == "merge":
            faces, same = np.where(faces == faces[some[0], 0], faces[some[-1], 1], faces), False
        elif kind == "stray":
            faces, same = np.vstack([faces, rng.integers(len(vertices), size=(len(some), 3))]), False
        else:
            vertices[rng.integers(len(vertices))], same = np.nan, False
        faces = faces[rng.permutation(len(faces))]
    return vertices, faces, same


@pytest.mark.parametrize("name", SHAPES)
def test_random_damage_is_mended_or_refused(name: str) -> None:
    clean, rng = SHAPES[name], np.random.default_rng(3)
    for _ in range(100):
        vertices, faces, same = corrupted(clean, rng)
        try:
            mesh = mended(vertices, faces)
        except InvalidInput as error:
            assert not same and "\n" not in str(error)
            continue
        if same:
            assert same_surface(mesh, clean) or same_surface(Mended(mesh.vertices, mesh.faces[:, ::-1]), clean)
            assert closed(mesh.vertices, mesh.faces)


def test_fields_of_many_tools_come_in_order_and_alike_ones_once() -> None:
    meshes = [Tool("probe", SHAPES[name].vertices, SHAPES[name].faces) for name in SHAPES]
    bad = Tool("probe", 1e3 * meshes[0].vertices, meshes[0].faces)
    again = Tool("probe", meshes[0].vertices.copy(), meshes[0].faces)
    first, *others, refused, last = fields_of([*meshes, bad, again], spacing=2e-3)
    assert first is last and isinstance(refused, MeshError)
    for field, mesh in zip([first, *others], meshes, strict=True):
        assert isinstance(field, SignedDistance)
        assert np.array_equal(field.coefficients, SignedDistance.of(mesh, spacing=2e-3).coefficients)
    assert fields_of([]) == []


def test_fields_built_in_processes_are_those_built_here(caplog: pytest.LogCaptureFixture) -> None:
    clean = SHAPES["torus"]
    meshes = [Tool("probe", (1 + 0.1 * k) * clean.vertices, clean.faces) for k in range(7)]
    meshes.append(Tool("probe", clean.vertices, clean.faces[3:]))
    fields = fields_of(meshes, spacing=2e-3, workers=2)
    for field, mesh in zip(fields, meshes, strict=True):
        assert isinstance(field, SignedDistance)
        assert np.array_equal(field.coefficients, SignedDistance.of(mesh, spacing=2e-3).coefficients)
    assert sum("has holes" in text for text in caplog.messages) == 2
