"""Body: the skin of a parametric human, Anny or the SMPL family, and its parts as soft layers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from stmpl_core import limbs
from stmpl_core.arrays import Faces, Points, check_kind, check_number, finite, is_number
from stmpl_core.chart import UvChart
from stmpl_core.errors import InvalidInput
from stmpl_core.extras import needed
from stmpl_core.extrusion import foldfree_thickness
from stmpl_core.layer import SoftLayer, check_faces
from stmpl_core.tissue import Tissue
from stmpl_core.trunk import STEEP, TRUNK, trunk_level

if TYPE_CHECKING:
    from stmpl_core.remesh import Remeshed

PARTS = {  # bones of a part: Anny's names, then the SMPL family's
    "left_arm": r"(upper|lower)arm\d*\.L|left_(shoulder|elbow)",
    "left_upper_arm": r"upperarm\d*\.L|left_shoulder",
    "left_forearm": r"lowerarm\d*\.L|left_elbow",
    "left_leg": r"(upper|lower)leg\d*\.L|left_(hip|knee)",
    "left_thigh": r"upperleg\d*\.L|left_hip",
    "left_calf": r"lowerleg\d*\.L|left_knee",
    "right_arm": r"(upper|lower)arm\d*\.R|right_(shoulder|elbow)",
    "right_upper_arm": r"upperarm\d*\.R|right_shoulder",
    "right_forearm": r"lowerarm\d*\.R|right_elbow",
    "right_leg": r"(upper|lower)leg\d*\.R|right_(hip|knee)",
    "right_thigh": r"upperleg\d*\.R|right_hip",
    "right_calf": r"lowerleg\d*\.R|right_knee",
    "torso": r"root|spine\d+|pelvis\.[LR]|clavicle\.[LR]|breast\.[LR]|pelvis|spine\d|(left|right)_collar",
}
RINGS = 3  # rings of faces kept around a part while it is subdivided, so that its border is none of the surface
SMPL_TO_BODY = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # rotation; SMPL looks along +z with its left towards +x
SEXES = {"male": 0.0, "female": 1.0}  # share of a gender that is female [-]
WATER = 1e3  # density of a body [kg/m3]
PHENOTYPE = ("gender", "age", "muscle", "weight", "height", "proportions")
AROUND = "around:"  # beginning of the name of a picked part
MOST_AROUND = 1.0  # largest radius of skin around a place [m]
LEAST_BORNE = 0.8  # share of the asked thickness, below which skin is said not to bear it
MAX_THIN_SHARE = 0.5  # share of the skin that may not bear it
NEAR_SKIN = 0.03  # distance from the skin up to which a picked place is taken to be on it [m]
BIG = 1e3  # way to skin that is not reached [m]
AVERAGE = 0.5  # value of every phenotype unless given


@dataclass(frozen=True)
class Physique:
    """How heavy a person is, beside the average of the model, and of which sex.

    Args:
        mass_index: body mass index at rest, of a body as dense as water [kg/m2].
        average: that of the model's average body [kg/m2].
        female: share from 0, male, to 1, female [-].
        height: how tall the person stands [m]; None: not known.
    """

    mass_index: float
    average: float
    female: float
    height: float | None = None

    @property
    def heavier(self) -> float:
        """Body mass index above the average's [kg/m2]."""
        return self.mass_index - self.average


def mass_index(vertices: Points, faces: Faces, up: int = 2) -> float:
    """Body mass index of a closed skin that stands upright along the axis `up`, as dense as water [kg/m2]."""
    corners = vertices[faces]
    volume = float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6
    return WATER * volume / float(np.ptp(vertices[:, up])) ** 2


@dataclass(frozen=True, eq=False)
class Body:
    """The skin of a whole body at rest in one pose.

    Frame (REP-103): x forward out of the chest, y to the body's left, z up; origin at the model's own, near the
    pelvis. Metres.

    Args:
        name: name of the model.
        vertices: positions, (V, 3) [m].
        faces: vertex numbers, (F, 3), counter-clockwise seen from outside.
        uv: texture coordinates of each corner, (F, 3, 2) in [0, 1], v up; None if the model has none.
        weights: weights of the bones at each vertex, (V, B) [-], rows sum to 1.
        bones: names of the bones, B of them.
        physique: how heavy the person is and of which sex; None: not known, taken as average.
    """

    name: str
    vertices: Points
    faces: Faces
    uv: np.ndarray | None
    weights: np.ndarray
    bones: tuple[str, ...]
    physique: Physique | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", finite("vertices", self.vertices, (None, 3)))
        object.__setattr__(self, "faces", check_faces(self.faces, len(self.vertices)))
        if self.uv is not None:
            object.__setattr__(self, "uv", finite("uv", self.uv, (len(self.faces), 3, 2)))
        shape = (len(self.vertices), len(self.bones))
        object.__setattr__(self, "weights", finite("weights", self.weights, shape))

    @classmethod
    def anny(cls, *, pose: Mapping[str, ArrayLike] | None = None, **phenotype: float) -> Body:
        """Anny (NAVER, Apache-2.0), whose data come with its package.

        The average body at rest ships with stmpl and takes a tenth of a second. Others need the extra bodies: the first
        takes some 40 s on two cores, as Anny reads its shapes from 1,136 text files, and keeps them in its own cache
        (0.8 GB; ANNY_CACHE_DIR moves it). Each is then kept as one file of 1 MB in the cache folder of stmpl
        (STMPL_CACHE_DIR moves it), and costs milliseconds from then on.

        Args:
            pose: rotation vector [rad] for each bone that turns, (3,), from the rest pose, in the body's axes.
            phenotype: gender (1: female), age, muscle, weight, height, proportions, each in [0, 1]; 0.5 unless given.

        Raises:
            InvalidInput: an unknown bone or phenotype (the error lists them), a value that is out of range, or another
                body than the average at rest where Anny is not installed.
        """
        turns = {bone: finite(f"pose of {bone}", turn, (3,)) for bone, turn in (pose or {}).items()}
        _known("bone", turns, _average().bones)
        _known("phenotype", phenotype, PHENOTYPE)
        for name, value in phenotype.items():
            if not (is_number(value) and 0 <= value <= 1):
                raise InvalidInput(f"{name} is {value!r:.40}; allowed is a number from 0 to 1 (0.5 is the average).")
        if not turns and all(value == AVERAGE for value in phenotype.values()):
            return _average()
        from stmpl_core.anny_model import posed

        vertices, faces, *_ = at_rest = posed({}, phenotype)
        average, height = mass_index(_average().vertices, _average().faces), float(np.ptp(vertices[:, 2]))
        physique = Physique(mass_index(vertices, faces), average, float(phenotype.get("gender", AVERAGE)), height)
        return cls("anny", *(posed(turns, phenotype) if turns else at_rest), physique)

    @classmethod
    def smpl(
        cls,
        path: str | Path,
        *,
        model_type: str = "smpl",
        gender: str = "neutral",
        betas: ArrayLike | None = None,
        pose: ArrayLike | None = None,
        uv: str | Path | None = None,
    ) -> Body:
        """A body of the SMPL family from the user's own model file: its licence lets nobody ship it.

        Load no file that you do not trust: a .pkl can run code.

        Args:
            path: model file, or the folder that holds `model_type`/ as smplx wants it.
            model_type: "smpl", "smplh" or "smplx".
            gender: "neutral", "female" or "male".
            betas: shape coefficients, up to as many as the file has.
            pose: body pose, rotation vectors [rad] in SMPL's own axes and order, (joints, 3) or flat.
            uv: path of an .obj file of the same topology with texture coordinates (SMPL's come separately).

        Raises:
            InvalidInput: a file that is missing or that smplx cannot read; shapes that do not fit.
        """
        needed("a body of the SMPL family", "smpl", "smplx", "torch")
        import smplx
        import torch
        from smplx.joint_names import JOINT_NAMES, SMPLH_JOINT_NAMES

        if not Path(path).exists():
            raise InvalidInput(f"there is no SMPL model at {path}. Get it from smpl.is.tue.mpg.de or "
                               "smpl-x.is.tue.mpg.de, and give the path of the file.")
        classes = {"smpl": smplx.SMPL, "smplh": smplx.SMPLH, "smplx": smplx.SMPLX}
        if model_type not in classes:
            raise InvalidInput(f"model_type is {model_type!r}; available: {', '.join(classes)}.")
        where = Path(path) / model_type if (Path(path) / model_type).is_dir() else Path(path)
        shape = {} if betas is None else {"betas": torch.tensor(np.atleast_2d(betas), dtype=torch.float32),
                                          "num_betas": np.size(betas)}
        turned = {} if pose is None else {"body_pose": torch.tensor(np.reshape(pose, (1, -1)), dtype=torch.float32)}
        try:
            model = classes[model_type](str(where), gender=gender, ext=where.suffix.lstrip(".") or "npz",
                                        use_pca=False, **shape)
            with torch.no_grad():
                posed, own, mean = (model(**given).vertices[0].numpy().astype(float) @ SMPL_TO_BODY.T for given in
                                    (turned, {}, {"betas": torch.zeros_like(model.betas)}))  # fmt: skip
        except Exception as error:  # smplx checks little, and what it meets comes as any kind of error
            raise InvalidInput(f"smplx cannot make a {model_type} body of {where}: {type(error).__name__}: {error}. "
                               "Check model_type, and how many betas and pose angles the model has.") from error
        faces = np.asarray(model.faces, dtype=np.int64)
        weights = model.lbs_weights.detach().numpy()
        bones = JOINT_NAMES if model_type == "smplx" else SMPLH_JOINT_NAMES
        if model_type == "smpl":
            bones = [*bones[:22], "left_hand", "right_hand"]
        physique = Physique(mass_index(own, faces), mass_index(mean, faces), SEXES.get(gender, AVERAGE),
                            float(np.ptp(own[:, 2])))  # fmt: skip
        bones = tuple(bones[: weights.shape[1]])
        return cls(model_type, posed, faces, _smpl_uv(uv, faces), weights, bones, physique)

    def part(
        self, name: str, *, edge_length: float = 3e-3, thickness: ArrayLike = 7.5e-3, tissue: Tissue | None = None
    ) -> SoftLayer:
        """A part of the body as a soft layer, evenly remeshed, with the body's UV chart attached.

        Args:
            name: name of a part (`Body.parts`), or of one bone; or `around:x,y,z,radius` [m], see `around`.
            edge_length: length of the mesh's edges [m].
            thickness: thickness of the layer [m], one number or one a vertex of the new mesh; thinned, with a warning,
                where the skin curves more tightly than that.
            tissue: material; Tissue() unless given.

        Raises:
            InvalidInput: unknown part; the error lists what exists. Or a thickness that most of the skin is too tightly
                curved for; the error says what would do.
            MeshError: a surface that `stmpl_core.remesh` refuses.
        """
        check_kind("the part's name", name, str)
        check_number("edge_length", edge_length)
        shipped = limbs.part(name, edge_length) if self is _average() else None
        if shipped is not None:
            return _layer(*shipped, thickness, tissue)
        return self.patch(name, edge_length).layer(self, thickness=thickness, tissue=tissue)

    def around(
        self, place: ArrayLike, radius: float = 0.08, *, edge_length: float = 3e-3, thickness: ArrayLike = 7.5e-3,
        tissue: Tissue | None = None,
    ) -> SoftLayer:  # fmt: skip
        """The skin around a picked place as a soft layer, whatever part of the body that is, in a second or two.

        Args:
            place: place on the skin or near it, (3,) [m].
            radius: distance along the skin to which it reaches [m]. Tools want to stay twice the thickness and their
                own size away from its border.
            edge_length, thickness, tissue: see `part`.

        Raises:
            InvalidInput: a place that is not near the skin, or a radius of less than two edges or of more than a metre.
            MeshError: a surface that `stmpl_core.remesh` refuses.
        """
        check_number("radius", radius)
        check_number("edge_length", edge_length)
        if not 2 * edge_length <= radius <= MOST_AROUND:
            raise InvalidInput(f"the radius is {radius:g} m; at least two edges, {2 * edge_length:g} m, and at most "
                               f"{MOST_AROUND:g} m are accepted. Is it in millimetres? Scale it by 1e-3.")
        return self.part(around_name(finite("place", place, (3,)), radius), edge_length=edge_length,
                         thickness=thickness, tissue=tissue)  # fmt: skip

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts that this body has the bones for."""
        limbs_and_torso = (p for p, pattern in PARTS.items() if any(re.fullmatch(pattern, b) for b in self.bones))
        return (*limbs_and_torso, *(TRUNK if self._as_anny else ()))

    @property
    def _as_anny(self) -> bool:
        """Whether its vertices are Anny's, so that what is known of the average body's is known of them."""
        return self.name == "anny" and len(self.vertices) == len(_average().vertices)

    def level(self, part: str) -> np.ndarray:
        """The bone weight of a part, less one half: positive at the vertices that belong to it, (V,) [-].

        Of parts of the trunk (stmpl_core.trunk) it is a distance instead; only Anny's bodies have them.
        """
        check_kind("part", part, str)
        if part in TRUNK and self._as_anny:
            return trunk_level(_average().vertices, _average().level("torso"), part)
        if part.startswith(AROUND):
            return self._level_around(part)
        pattern = PARTS.get(part, re.escape(part))
        columns = [k for k, bone in enumerate(self.bones) if re.fullmatch(pattern, bone)]
        if not columns:
            raise InvalidInput(f"unknown part {part!r}. Available: {', '.join(self.parts or self.bones)}; "
                               f"or, of one material (--tissue single), a bone by its name, of {len(self.bones)} in "
                               "Body.bones.")  # fmt: skip
        return self.weights[:, columns].sum(axis=1) - 0.5

    def _level_around(self, part: str) -> np.ndarray:
        """How far each vertex lies inside a picked part, (V,) [-], by the way along the skin.

        Ways go along edges and straight over pairs of triangles, so they are some percent too long.
        """
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import dijkstra

        try:
            *place, radius = (float(number) for number in part.removeprefix(AROUND).split(","))
            place = finite("place", place, (3,))
        except ValueError as error:
            raise InvalidInput(f"{part!r} is no picked part, as in 'around:0.12,0.03,0.17,0.08' [m].") from error
        from stmpl_core.methods.coarse import nearest_corners

        corners, shares = nearest_corners(self, place[None])
        foot = shares[0] @ self.vertices[corners[0]]
        away = float(np.linalg.norm(foot - place))
        if not (away <= NEAR_SKIN and np.isfinite(radius) and radius > 0):
            raise InvalidInput(f"{part!r} is {1e3 * away:.0f} mm from the skin; allowed are {1e3 * NEAR_SKIN:.0f} mm "
                               "and a radius above 0. Is it in millimetres?")  # fmt: skip
        edges = np.sort(np.concatenate([self.faces[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
        beyond, order = np.concatenate([self.faces[:, (k + 2) % 3] for k in range(3)]), np.lexsort(edges.T)
        alike = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
        over = np.stack([beyond[order[1:]][alike], beyond[order[:-1]][alike]], axis=1)
        ends = np.unique(np.sort(np.concatenate([edges, over]), axis=1), axis=0)
        lengths = np.linalg.norm(self.vertices[ends[:, 0]] - self.vertices[ends[:, 1]], axis=1)
        ways = csr_matrix((lengths, ends.T), shape=(len(self.vertices),) * 2)
        along = dijkstra(ways, directed=False, indices=corners[0], limit=radius + STEEP)
        along += np.linalg.norm(self.vertices[corners[0]] - foot, axis=1)[:, None]
        level = np.clip((radius - np.minimum(along.min(axis=0), BIG)) / STEEP, -1, 1)
        if not (level > 0).any():
            raise InvalidInput(f"no vertex of the body is within the radius of {part!r}. Try a larger one, as 0.08.")
        return level

    def patch(self, part: str, edge_length: float = 3e-3) -> Patch:
        """The mesh of a part, cut where its bones weigh one half, which other poses of the same model can take."""
        from stmpl_core.remesh import remesh

        level = self.level(part)
        if not (level > 0).any():
            raise InvalidInput(f"no vertex of the body belongs to {part!r} by more than half. "
                               f"Available: {', '.join(self.parts)}.")
        near = level > 0
        keep = near[self.faces].any(axis=1)
        for _ in range(RINGS):
            near[self.faces[keep]] = True
            keep = near[self.faces].any(axis=1)
        source = np.unique(self.faces[keep])
        renumber = np.empty(len(self.vertices), int)
        renumber[source] = np.arange(len(source))
        mesh = remesh(self.vertices[source], renumber[self.faces[keep]], edge_length,
                      uv=None if self.uv is None else self.uv[keep], inside=level[source])
        return Patch(part, mesh, source)


@dataclass(frozen=True, eq=False)
class Patch:
    """An even mesh of a body part, drawn from the vertices `source` of the whole body."""

    part: str
    mesh: Remeshed
    source: np.ndarray

    def layer(self, body: Body, *, thickness: ArrayLike = 7.5e-3, tissue: Tissue | None = None) -> SoftLayer:
        """The part as a soft layer, on `body` in its pose: the mesh's connectivity and UVs stay what they are.

        Where the skin curves more tightly than `thickness`, the layer is thinned, and the log says where. Raises
        InvalidInput where most of the skin does.
        """
        if self.source.max() >= len(body.vertices):
            raise InvalidInput(f"this patch was drawn from a body with at least {self.source.max() + 1} vertices; "
                               f"{body.name} has {len(body.vertices)}.")
        vertices = self.mesh.transfer @ body.vertices[self.source]
        return _layer(vertices, self.mesh.faces, self.mesh.uv, thickness, tissue)


def around_name(place: np.ndarray, radius: float) -> str:
    """Name of the part around a place (3,) [m]; see Body.around."""
    return AROUND + ",".join(f"{number:.9g}" for number in (*place, radius))


def phenotype_from(text: str) -> dict[str, float]:
    """A phenotype as people write it, 'weight=0.7 muscle=0.3', by name. Raises InvalidInput."""
    values = {}
    for pair in text.split():
        name, _, value = pair.partition("=")
        try:
            values[name] = float(value)
        except ValueError:
            raise InvalidInput(f"'{pair}' is no name=number, as in 'weight=0.7 muscle=0.3'") from None
        if name not in PHENOTYPE:
            raise InvalidInput(f"'{name}' is no phenotype; known are {', '.join(PHENOTYPE)}")
        if not 0 <= values[name] <= 1:
            raise InvalidInput(f"{pair} is not from 0 to 1 (0.5 is the average)")
    return values


@cache
def _average() -> Body:
    return Body("anny", *limbs.body())


def _layer(
    vertices: Points, faces: Faces, uv: np.ndarray | None, thickness: ArrayLike, tissue: Tissue | None
) -> SoftLayer:
    """The layer under a mesh of the skin, thinned where the skin curves more tightly.

    Raises:
        InvalidInput: most of it does, by much.
    """
    chart = None if uv is None else UvChart(vertices, faces, uv)
    layer = SoftLayer(vertices, faces, thickness, tissue=tissue, chart=chart)
    borne, area = foldfree_thickness(layer), layer.vertex_areas
    thin = borne < LEAST_BORNE * layer.thickness
    share = area[thin].sum() / area.sum()
    if share > MAX_THIN_SHARE:
        raise InvalidInput(f"a layer {layer.thickness.max() * 1e3:.1f} mm thick would fold: {share:.0%} of this skin "
                           f"curves so tightly that it bears less than {LEAST_BORNE:.0%} of that. "
                           f"Try {np.median(borne) * 1e3:.1f} mm.")  # fmt: skip
    return layer.with_(thickness=borne)


def _known(kind: str, given: Iterable[str], available: tuple[str, ...]) -> None:
    unknown = sorted(set(given) - set(available))
    if unknown:
        raise InvalidInput(f"unknown {kind}: {', '.join(unknown)}. Available: {', '.join(available)}.")


def _smpl_uv(uv: str | Path | None, faces: Faces) -> np.ndarray | None:
    """UVs per corner, from an .obj file."""
    if uv is None:
        return None
    import igl

    _, texture, _, obj_faces, texture_faces, _ = (np.asarray(table) for table in igl.readOBJ(str(uv)))
    if obj_faces.shape != faces.shape or not len(texture_faces):
        raise InvalidInput(f"{uv} has {len(obj_faces)} faces and {len(texture_faces)} with UVs; "
                           f"the body has {len(faces)}.")
    return texture[texture_faces][..., :2]
