"""Making: a skin from the settings."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, cast, get_args

from stmpl_core.errors import InvalidInput
from stmpl_core.friction import Friction, friction_from
from stmpl_core.layer import SoftLayer
from stmpl_core.living import held_skin, laid, living, part_around, read_model, read_tissue
from stmpl_core.regions import Tone, region
from stmpl_core.rig import Rig, joints_of
from stmpl_core.simulator import Simulator
from stmpl_core.skin import Skin, published
from stmpl_core.tissue import Tissue
from stmpl_core.warming import warm_up
from stmpl_ros.parameters import ONE_LAYER, PAPER, NodeConfig

if TYPE_CHECKING:
    from stmpl_core.body import Body

Build = Callable[[NodeConfig], SoftLayer]
STIFFNESS = {"youngs_modulus", "density"}  # settings that change neither geometry nor what is felt around a vertex
ON_STACKS = ("moment_net", "limb_linear", "ladder")  # methods that know skin, fat and muscle
MOVED = ("moment_net", "linear", "limb_linear", "winkler", "naive", "zero")  # methods that go along with joints
AT_ONCE = {"friction"}  # settings that the skin does not know of
QUICK = {"moment_net", "winkler", "naive"}  # methods that such a change costs no preparation


def layer_of(config: NodeConfig) -> SoftLayer:
    """The soft layer that the settings ask for. Raises InvalidInput."""
    from stmpl_core.body import Body

    body = Body.anny(pose=None, **config.phenotype_values)
    layer = _at_rest(config, body)
    return layer.with_(rig=Rig.of(body, config.limb, layer)) if config.joint_states else layer


def _at_rest(config: NodeConfig, body: Body) -> SoftLayer:
    if config.tissue in get_args(Tone):
        return living(body, config.limb, cast(Tone, config.tissue), edge_length=config.edge_length)
    if config.tissue != PAPER:
        return laid(body, config.limb, *read_tissue(config.tissue), edge_length=config.edge_length)
    tissue = Tissue(config.youngs_modulus, config.poisson_ratio, config.density)
    return body.part(config.limb, edge_length=config.edge_length, thickness=config.thickness, tissue=tissue)


def friction_of(config: NodeConfig) -> Friction | dict[str, Friction]:
    """Friction that the settings ask for: theirs, or what the file that `tissue` names says. Raises InvalidInput."""
    if config.friction or config.tissue in (*get_args(Tone), PAPER):
        return friction_from(config.friction)
    return friction_from(read_model(config.tissue).friction or "")


def check_part(config: NodeConfig, build: Build) -> None:
    """Raises InvalidInput for a part that `layer_of` does not know; other builds are not asked."""
    if build is layer_of:
        from stmpl_core.body import Body

        Body.anny().level(config.limb)


def check(config: NodeConfig, build: Build, changed: set[str] | None = None) -> None:
    """Raises InvalidInput, at once, for what `layer_of` does not know; other builds are not asked.

    Args:
        config: settings.
        build: function that makes the layer.
        changed: names of the settings that were asked for; None: all that are not as by default.
    """
    if config.joint_states and config.method not in MOVED:
        raise InvalidInput(f"{config.method} knows a limb at rest only; one that moves is known to {', '.join(MOVED)}. "
                           "Take one of these, or leave joint_states empty.")  # fmt: skip
    if build is layer_of:
        from stmpl_core.body import AROUND, Body

        default = NodeConfig()
        asked = {name for name in ONE_LAYER if getattr(config, name) != getattr(default, name)}
        if idle := sorted((asked if changed is None else changed & set(ONE_LAYER)) if config.tissue != PAPER else ()):
            raise InvalidInput(f"{', '.join(idle)} would change nothing: '{config.tissue}' has its own. Leave it out, "
                               f"or set tissue to '{PAPER}', which is one layer of your numbers.")  # fmt: skip

        check_part(config, build)
        stacked = config.tissue != PAPER
        if config.tissue in get_args(Tone):
            region(part_around(Body.anny(), config.limb) if config.limb.startswith(AROUND) else config.limb)
        elif stacked:
            stacked = not read_tissue(config.tissue)[0].single
        if stacked and config.method not in ON_STACKS:
            raise InvalidInput(f"{config.method} knows one soft material only; of skin, fat and muscle know "
                               f"{', '.join(ON_STACKS)}. Take one of these, or set tissue to '{PAPER}'.")  # fmt: skip
        if config.joint_states:
            known = joints_of(config.limb)
            if unknown := sorted(set(config.joint_names) - set(known)):
                raise InvalidInput(f"joints names {', '.join(unknown)}, which {config.limb} has not; it has "
                                   f"{', '.join(known)}. Its own name comes first, as in left_elbow=elbow_2.")


def at_once(config: NodeConfig, build: Build) -> bool:
    """Whether the skin is made here, since Ctrl-C is heard meanwhile: its mesh ships, or somebody else makes it."""
    from stmpl_core import limbs
    from stmpl_core.body import AVERAGE

    average = all(value == AVERAGE for value in config.phenotype_values.values())
    return build is not layer_of or (average and limbs.ships(config.limb, config.edge_length))


def skin_of(config: NodeConfig, build: Build = layer_of) -> Skin:
    """Skin that the settings ask for. Raises InvalidInput or MeshError."""
    return Skin.of(published(faded(build(config), config)), config.new_method())


def faded(layer: SoftLayer, config: NodeConfig) -> SoftLayer:
    """The layer, which relaxes if the settings ask for it: as held skin, or by a series of its own."""
    return held_skin(layer) if config.relaxing and not layer.tissue.relaxes else layer


def compiled(skin: Skin | None, config: NodeConfig, build: Build) -> Skin | None:
    """A skin that the settings ask for, unless one is given; for a process beside the node.

    It answers first there, which may take half a minute: what is compiled is kept on disk, so the node need not.
    """
    made = skin_of(config, build) if skin is None else skin
    warm_up(Simulator(made, friction=friction_of(config)))
    return made if skin is None else None


def restiffened(skin: Skin, config: NodeConfig, changed: set[str]) -> Skin | None:
    """The same skin, or one of another stiffness, where nothing else changes and that is quick; else None."""
    if changed and changed <= AT_ONCE:
        return skin
    if not changed or not changed <= STIFFNESS | AT_ONCE or config.method not in QUICK or skin.layer.stacked:
        return None
    return skin.stiffened(config.new_method(), youngs_modulus=config.youngs_modulus, density=config.density)
