"""Networks: the layout of what they read and say, for numba and torch alike; their weights; those that ship.

An input is added in three places: its line in INPUTS, its formula in stmpl_core.methods.moment_net.invariants (numba)
and its formula in studies.train_moments.Model (torch). A test holds the two formulas against each other.
"""

from __future__ import annotations

import json
from collections import namedtuple
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from stmpl_core.errors import InvalidInput
from stmpl_core.obstacle import RINGS
from stmpl_core.response import SCALARS, VECTORS, WIDTH

MIXED_VECTORS, MIXED_TENSORS = 6, 4  # combinations of a vertex's vectors and tensors whose products are inputs
DIRECTIONS = 2 * VECTORS + 2  # vectors that an answer is made of: moments of both fields, and both linear responses


class Layout:
    """The parts of a row of numbers, by name, in their order.

    Args:
        sizes: number of columns of each part.

    Attributes:
        at: first column of each part, a named tuple that numba reads as constants.
        size: number of columns in all.
    """

    def __init__(self, **sizes: int) -> None:
        self.sizes = sizes
        *first, self.size = accumulate(sizes.values(), initial=0)
        self.at: Any = namedtuple("At", sizes)(*first)

    def in_order(self, **parts: Any) -> list[Any]:
        """Parts (N, size of the part) in the order of the layout, ready to be put side by side.

        Raises:
            InvalidInput: a part is missing, unknown, or has another size.
        """
        found = {name: part.shape[1] for name, part in parts.items()}
        if found != self.sizes:
            raise InvalidInput(f"the parts of a row are {found}; its layout has {self.sizes}.")
        return [parts[name] for name in self.sizes]

    def split(self, rows: Any) -> dict[str, Any]:
        """The parts of rows (N, size), by name, as views."""
        starts = self.at._asdict()
        return {name: rows[:, starts[name] : starts[name] + count] for name, count in self.sizes.items()}


# What is known of a vertex before any formula.
POINT = Layout(
    figures=2 * WIDTH,  # what it feels of both source fields, see stmpl_core.moments.Felt
    curvature=3,  # xx, xy, yy of the skin's, in its own frame, times the thickness
    slope=2,  # of the thickness
    here=2,  # both source fields at the vertex itself
    constants=2,  # Poisson's ratio; 1 for nodal forces, else 0
)

# What the first layer reads; g is the sum of the moments' sizes, v and t are the mixed vectors and tensors over g.
INPUTS = Layout(
    scalars=2 * SCALARS,  # moments of order 0 of both fields, over g
    linear_normal=2,  # linear response along the normal, of both, over g
    here=2,  # both fields at the vertex, over g
    log_here=2,
    log_g=1,
    g=1,
    root_g=1,
    field_difference=SCALARS,  # moments of order 0 of the first field, less those of the second
    vector_products=MIXED_VECTORS * (MIXED_VECTORS + 1) // 2,  # v . v
    tensor_products=MIXED_TENSORS * (MIXED_TENSORS + 1) // 2,  # t : t
    tensor_along_vector=MIXED_TENSORS,  # v . t v
    tensor_along_curvature=MIXED_TENSORS,  # t : curvature
    curvature_along_vector=MIXED_VECTORS,  # v . curvature v, without its trace
    slope_along_vector=MIXED_VECTORS,
    mean_curvature=1,
    squared_bend=1,  # square of the curvature without its trace
    constants=2,
    volumetric=1,  # 1 / (1.02 - 2 nu)
    squared_slope=1,
)

# What the last layer of a MomentNet says, and that of a ContactNet. Both end with the error that they expect.
MOTION = Layout(
    normal=1,
    directions=DIRECTIONS,  # a coefficient for each vector around the vertex
    turned=MIXED_TENSORS,  # ... for each t v
    curved=MIXED_VECTORS,  # ... for each curvature v
    slope=1,
    log_error=1,
)
PRESSURE = Layout(log_ratio=1, log_error=1)  # output: log of pressure over that of the linear layer

# What the first layer of a ContactNet reads of a contact node; written by stmpl_core.contact_net alone.
NODE = Layout(
    log_pressure=1,  # of the linear layer, over E
    pressure=1,
    log_strain=1,
    strain=1,
    log_moments=2 * RINGS,  # of pressure and strain on rings around the node
    vector_sizes=2,  # lengths of their first moments, over the second ring's
    vectors_together=1,  # product of these vectors
    mean_curvature=1,
    squared_bend=1,
    curvature_along_vector=1,
    slope_along_vector=1,
    squared_slope=1,
    poisson_ratio=1,
    volumetric=1,  # 1 / (1.02 - 2 nu)
)

# What it reads on a stack, less than of one material: t is that of the effective layer, strain the sinking over it.
SEEN_ALIKE = ("log_pressure", "pressure", "log_strain", "strain", "log_moments", "vector_sizes", "vectors_together")
STACK_NODE = Layout(
    **{name: NODE.sizes[name] for name in SEEN_ALIKE},  # as in NODE, and first in both
    log_thickness=1,  # of the tissue at the node, over that of the effective layer
    column_strain=1,  # depth over the tissue's thickness at the node
    hardening=1,  # of the confined column there, see stmpl_core.stack.hardening
    log_kappa=1,  # of the effective layer
    log_pull=1,
    curvature=1,  # mean curvature of the skin, times the thickness: what is convex is pressed flat before it stretches
    curvature_over_strain=1,
    given_way=1,  # share of the linear work that goes into the limb as a whole, its coarse part
    turned=1,  # log of how far normals turn from each other where it presses around the node
    uneven=1,  # how uneven the tissue's thickness is there
    stiffening=2,  # of the column there, see stmpl_core.stack.stiffening
)

ON_STACK = {
    "log_thickness": 1,  # of the tissue at the vertex, over the flat stack's
    "log_effective": 1,  # thickness of the effective layer over the flat stack's
    "log_kappa": 1,
    "log_pull": 1,
    "log_softness": 1,
    "log_sunk": 1,  # largest linear motion, over the flat stack's thickness
    "stiffening": 2,  # of the column at the vertex, see stmpl_core.stack.stiffening
}
STACK_POINT, STACK_INPUTS = Layout(**POINT.sizes, **ON_STACK), Layout(**INPUTS.sizes, **ON_STACK)

# What a network says: a MomentNet, a ContactNet, both on stacks, a UNet.
Kind = Literal["motion", "pressure", "stack_motion", "stack_pressure", "image"]
READS: dict[Kind, Layout] = {"motion": INPUTS, "pressure": NODE, "stack_motion": STACK_INPUTS,
                             "stack_pressure": STACK_NODE}  # fmt: skip
# Rows that grew at their end, and how long they once were: networks that were trained then read no more than that.
SINCE: dict[Kind, int] = {"stack_pressure": STACK_NODE.at.curvature}
SAYS: dict[Kind, Layout] = {"motion": MOTION, "pressure": PRESSURE, "stack_motion": MOTION, "stack_pressure": PRESSURE}
_LAYERS = ("low", "high", "mean", "scale", "w1", "b1", "w2", "b2", "w3", "b3", "w4", "b4")
_MOTION = ("mix_vectors", "mix_tensors", "least", "most", *_LAYERS)  # least, most: what is known
ARRAYS: dict[Kind, tuple[str, ...]] = {
    "motion": _MOTION, "pressure": _LAYERS, "stack_motion": _MOTION, "stack_pressure": _LAYERS,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Weights:
    """A trained network of three hidden layers.

    Args:
        arrays: arrays by the names in ARRAYS of its kind, float32; w of shape (inputs, outputs).
        card: record of what made it and what it is good for (see studies.train_moments).
    """

    arrays: Mapping[str, np.ndarray]
    card: Mapping[str, Any]

    @classmethod
    def load(cls, path: str | Path, kind: Kind = "motion") -> Self:
        """Reads a .safetensors file and the .json card beside it; no code in them is run.

        Raises:
            InvalidInput: a file is missing, or holds another network.
        """
        from safetensors import SafetensorError
        from safetensors.numpy import load_file

        path = Path(path)
        card = path.with_suffix(".json")
        for one in (path, card):
            if not one.is_file():
                raise InvalidInput(f"there is no {one}. Train a network with stmpl train, or give no path.")
        try:
            arrays = load_file(path)
        except SafetensorError as error:
            raise InvalidInput(f"{path} holds no weights: {error}.") from error
        shapes = {name: a.shape for name, a in arrays.items()}
        most = READS[kind].size
        least = SINCE.get(kind, most)
        if set(shapes) != set(ARRAYS[kind]) or shapes["w4"][1] != SAYS[kind].size \
                or not least <= shapes["w1"][0] <= most:  # fmt: skip
            raise InvalidInput(f"{path} holds no network of this kind and version.")
        return cls({name: np.ascontiguousarray(a, dtype=np.float32) for name, a in arrays.items()},
                   json.loads(card.read_text()))  # fmt: skip

    def save(self, path: str | Path) -> None:
        """Writes both files."""
        from safetensors.numpy import save_file

        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_file({name: np.ascontiguousarray(self.arrays[name]) for name in sorted(self.arrays)}, path)
        path.with_suffix(".json").write_text(json.dumps(self.card, indent=1) + "\n")


@dataclass(frozen=True)
class Network:
    """A network that ships: its kind, and its weights file, which has its card beside it."""

    kind: Kind
    path: Path


_FOLDER = Path(__file__).parent / "weights"
NETWORKS = {
    "moment_net": Network("motion", _FOLDER / "moment_net.safetensors"),  # pressures and nodal forces
    "moment_net_contact": Network("motion", _FOLDER / "moment_net_contact.safetensors"),  # what rigid tools press with
    "moment_net_stick": Network("motion", _FOLDER / "moment_net_stick.safetensors"),  # ... if linear motion is known
    "contact_net": Network("pressure", _FOLDER / "contact_net.safetensors"),
    "stack_contact_net": Network("stack_pressure", _FOLDER / "stack_contact_net.safetensors"),
    "stack_moment_net": Network("stack_motion", _FOLDER / "stack_moment_net.safetensors"),
    "unet": Network("image", _FOLDER / "unet.safetensors"),
}


@cache
def shipped(name: str) -> Weights:
    """A network that comes with the package; an image network is loaded by stmpl_core.methods.unet instead."""
    return Weights.load(NETWORKS[name].path, NETWORKS[name].kind)
