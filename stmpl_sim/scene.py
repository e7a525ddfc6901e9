"""Scene: a robot with a tool, and a limb in front of it, as one MuJoCo model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from stmpl_core.arrays import Transform, check_choice, check_kind, check_number, finite
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_sim.ability import AXES, LONGEST, length_of, start_notes
from stmpl_sim.engine import mujoco
from stmpl_sim.grip import END, FINGERS, add_gripper, place_of, thin_end
from stmpl_sim.mujoco_skin import exclude
from stmpl_sim.robot_file import robot_spec
from stmpl_sim.site import Site

ARM = Path(__file__).parent / "models" / "arm7.xml"
LIMB, HEAD, BALL, EYE = "limb", "head", "ball", "eye"  # names of bodies, geom and camera that a scene adds
HINGE, FLOOR = "limb_hinge", "stage_floor"  # of the joint of a rest, and of a geom: robots have elbows and floors
WRIST = "wrist"  # name of the site of the force and torque sensor between the robot and its head
SKIN_MESH, SKIN_GEOM, SKIN_MATERIAL = "skin", "skin", "skin"
DENSITY = 1050.0  # of a limb [kg/m3]
HEAD_LENGTH, HEAD_MASS = 0.09, 0.3  # of the massage head, flange to the ball's middle [m], [kg]
SPRING, TWIST = (1500.0, 20.0), (30.0, 0.4)  # of a limb on springs: N/m and N s/m; N m/rad and N m s/rad
FROM = np.array([0.44, -0.20, 0.24])  # place of the camera, from the site [m]
AIM = np.array([-0.03, 0.0, 0.045])  # point that it looks at, from the site [m]
COLOURS = 256  # texels of the skin's colour scale
ELBOW_DAMPING = 0.05  # of the hinge of a limb on a rest [N m s/rad]
ROOM = 0.08  # distance of a start's joints from their limits, over their ranges, beyond which no other start is tried
NEEDED = "mjDSBL_ACTUATION", "mjDSBL_LIMIT", "mjDSBL_PASSIVE", "mjDSBL_SPRING", "mjDSBL_DAMPER"  # by motors and limb
FINITE = ("qpos0", "body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos", "jnt_pos", "jnt_axis",
          "jnt_range", "jnt_stiffness", "dof_damping", "dof_armature", "dof_frictionloss", "geom_pos",
          "geom_size")  # fmt: skip
LONGEST_STEP = 0.02  # largest timestep [s]: ten times what the arm's control wants
STARTS, STEPS = 40, 200  # starts that are tried at most, and steps from each
POINTING = 150  # of these steps where the place goes before pointing: after them only the place is found
EXACT = 1e-6  # of the place [m] and the direction of a start
LEAN = np.deg2rad(45)  # most that a tool of few axes leans [rad]
ROUNDED = 1e-3  # most that one of more axes leans: that its file's angles are rounded [rad]
ALIKE = np.deg2rad(1)  # angle by which a tool may lean more, for room

Mount = Literal["fixed", "springs", "animated", "rest"]


@dataclass(frozen=True, eq=False)
class Scene:
    """A compiled scene.

    Args:
        model: MuJoCo model.
        layer: skin of the limb; its axes are those of the body LIMB.
        site: place on the skin where the robot is to work.
        joints: numbers of the robot's joints from its base to the tool.
        qpos: start, with the tool above the site, (nq,).
        radius: radius of the ball [m].
        tools: names of the geoms that touch: the ball, and the fingers of a gripper.
        notes: what will take the tool off its course or its direction, one sentence each.
    """

    model: Any
    layer: SoftLayer
    site: Site
    joints: tuple[int, ...]
    qpos: np.ndarray
    radius: float
    tools: tuple[str, ...] = (BALL,)
    notes: tuple[str, ...] = ()


def build(
    layer: SoftLayer,
    site: Site,
    *,
    robot: str | Path | None = None,
    end: str | None = None,
    at: tuple[float, float, float] = (0.5, 0.0, 0.25),
    mount: Mount = "fixed",
    radius: float = 0.02,
    timestep: float = 1e-3,
    above: float = 0.01,
    gripper: bool = False,
) -> Scene:
    """Puts a robot with a massage head before a limb, the head over the site.

    The robot's joints from base to tool are driven by torques: actuators of its own on these joints are replaced.

    Args:
        layer: skin of the limb.
        site: place on it that is turned up, and put at `at`.
        robot: MJCF or URDF file; the arm that ships unless given. Meshes that are not found are not drawn.
        end: name of the robot's body or site that carries the head, its z axis towards the skin; the last body of
            the longest chain unless given.
        at: place of the site in the robot's world [m].
        mount: mount of the limb: fixed, on six springs, animated (a mocap body), or on a rest: hinged at its thicker
            end, and lying there with its weight.
        radius: radius of the ball at the head [m].
        timestep: timestep [s].
        above: height of the ball over the skin at the start [m].
        gripper: choice to add a gripper of two fingers beside the site.

    Raises:
        InvalidInput: a place that is not finite, a ball without a radius, a timestep that is none, a file that MuJoCo
            does not read, an end that is not there, a site out of reach, or a limb that cannot be gripped.
    """
    check_choice("gripper", gripper)
    check_kind("robot", robot, (str, Path, type(None)))
    check_kind("end", end, (str, type(None)))
    where, spec = finite("at", at, (3,)), robot_spec(ARM if robot is None else Path(robot))
    check_number("the ball's radius", radius)
    if not radius > 0:
        raise InvalidInput(f"the ball's radius is {radius:g} m; it must be finite and above 0.")
    check_number("above", above)
    check_number("the timestep", timestep)
    if not 0 < timestep <= LONGEST_STEP:
        raise InvalidInput(f"the timestep is {timestep:g} s; it must be above 0 and at most {LONGEST_STEP:g}. Is it in "
                           "milliseconds?")  # fmt: skip
    holder, side, tools = _end(spec, end), -1.0, (BALL,)
    chain = _chain(holder if hasattr(holder, "add_body") else holder.parent)
    try:
        _add_head(spec, holder, radius)
        _drive(spec, chain)
        _add_limb(spec, layer, site, where, mount)
        if gripper:
            place = place_of(site, world_from_limb(site, where))
            add_gripper(spec, place)
            side, tools = place.side, (BALL, *FINGERS)
        _add_stage(spec, where, side)
    except ValueError as error:
        if "repeated name" not in str(error):
            raise
        raise InvalidInput(f"a name of the robot's file is one that the scene takes: {' '.join(str(error).split())}. "
                           "Rename it there.") from error  # fmt: skip
    exclude(spec, LIMB, tools)
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableactuator = 0
    for flag in NEEDED:
        spec.option.disableflags &= ~int(getattr(mujoco.mjtDisableBit, flag, 0))
    model = _compiled(spec, "the scene")
    for name in FINITE:
        if not np.isfinite(getattr(model, name)).all():
            raise InvalidInput(f"the robot's file has numbers that are not finite: MuJoCo's {name} of it.")
    joints = tuple(model.joint(joint.name).id for joint in chain)
    qpos = _reach(model, joints, where, radius + above)
    _still(model, joints, qpos)
    return Scene(model, layer, site, joints, qpos, radius, tools, start_notes(model, joints, qpos, BALL))


def check_robot(robot: Path | None, end: str | None) -> None:
    """Reads a robot's file and finds its end, where `build` comes later. Raises InvalidInput, as build does.

    Args:
        robot: see `build`.
        end: see `build`.
    """
    _end(robot_spec(ARM if robot is None else robot), end)


def world_from_limb(site: Site, at: np.ndarray) -> Transform:
    """Pose of a limb whose site lies at `at`, turned up, its length across the robot's view."""
    pose = np.eye(4)
    up, along = site.normal, site.along
    frame = np.stack([np.cross(along, up), along, up], axis=1)  # the site's axes in the layer: x, y, z of the world
    pose[:3, :3] = frame.T
    pose[:3, 3] = at - frame.T @ site.point
    return pose


def _end(spec: Any, name: str | None) -> Any:
    """The body or site that carries the head."""
    if name is not None:
        found = spec.body(name) or spec.site(name)
        if found is None:
            bodies, sites = (", ".join(one.name for one in many if one.name) for many in (spec.bodies, spec.sites))
            raise InvalidInput(f"the robot has no body or site '{name}'. Bodies: {bodies}. Sites: {sites or 'none'}.")
        return found
    if len(spec.bodies) < 2:
        raise InvalidInput("the robot's file has no body. Is it a xacro that was not expanded, or an empty scene?")
    return max(spec.bodies[1:], key=lambda body: (len(_chain(body)), _depth(body)))


def _depth(body: Any) -> int:
    depth = 0
    while body.parent is not None:
        body, depth = body.parent, depth + 1
    return depth


def _chain(body: Any) -> list[Any]:
    """Joints from the base to a body: hinges and slides."""
    joints: list[Any] = []
    while body is not None and body.name != "world":
        joints = [*body.joints, *joints]
        body = body.parent
    return joints


def _drive(spec: Any, chain: list[Any]) -> None:
    """A torque motor on each joint of the chain, in place of the robot's own actuators there, servos with damping."""
    if not chain:
        raise InvalidInput("no joint moves the robot's end. Give the body behind the last joint with --end.")
    for k, joint in enumerate(chain):
        joint.name = joint.name or f"joint_{k + 1}"
        if joint.type not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            raise InvalidInput(f"joint '{joint.name}' is no hinge and no slide; the controller drives only these.")
    names, servos = {joint.name for joint in chain}, set()
    for actuator in list(spec.actuators):
        if actuator.target in names:
            if actuator.biastype != mujoco.mjtBias.mjBIAS_NONE:
                servos.add(actuator.target)
            spec.delete(actuator)
    for joint in chain:
        if joint.name in servos:  # its damping is the servo's
            joint.damping = np.zeros(3)
        motor = spec.add_actuator(name=f"torque_{joint.name}", target=joint.name)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        motor.set_to_motor()  # the robot's defaults are its servos'
        motor.gear = [1, 0, 0, 0, 0, 0]
        motor.ctrllimited = motor.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE


def _still(model: Any, joints: tuple[int, ...], qpos: np.ndarray) -> None:
    """Switches off what else of the robot's file drives these joints: by a tendon, a site, a body."""
    ours = {model.actuator(f"torque_{model.joint(joint).name}").id for joint in joints}
    data, dofs = mujoco.MjData(model), model.jnt_dofadr[list(joints)]
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    moment = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    for k in range(model.nu):
        if k not in ours and moment[k, dofs].any():
            model.actuator_gaintype[k], model.actuator_gainprm[k] = mujoco.mjtGain.mjGAIN_FIXED, 0.0
            model.actuator_biastype[k] = mujoco.mjtBias.mjBIAS_NONE


def _compiled(spec: Any, what: str) -> Any:
    """The model of a spec. Raises InvalidInput: MuJoCo cannot compile it."""
    try:
        return spec.compile()
    except ValueError as error:
        light = "mjMINVAL" in str(error)
        more = " Give each link that a joint moves its <inertial>, with a mass above 0." if light else ""
        raise InvalidInput(f"MuJoCo cannot compile {what}: {' '.join(str(error).split())}.{more}") from error


def _add_head(spec: Any, holder: Any, radius: float) -> None:
    place = {}
    if not hasattr(holder, "add_body"):  # a site: only MuJoCo knows what its euler, zaxis, fromto or frame come to
        alone = _compiled(spec.copy(), "the robot").site(holder.name)
        place, holder = {"pos": alone.pos, "quat": alone.quat}, holder.parent
    head = holder.add_body(name=HEAD, **place)
    head.add_geom(name="stem", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0.005, 0, 0, HEAD_LENGTH],
                  size=[0.35 * radius, 0, 0], contype=0, conaffinity=0, mass=0.4 * HEAD_MASS,
                  rgba=[0.35, 0.38, 0.42, 1])  # fmt: skip
    head.add_geom(name=BALL, type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=[0, 0, HEAD_LENGTH], size=[radius, 0, 0],
                  contype=0, conaffinity=0, mass=0.6 * HEAD_MASS, rgba=[0.16, 0.38, 0.54, 1])  # fmt: skip
    head.add_site(name=WRIST)
    for kind in (mujoco.mjtSensor.mjSENS_FORCE, mujoco.mjtSensor.mjSENS_TORQUE):
        spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=WRIST)


def _add_limb(spec: Any, layer: SoftLayer, site: Site, at: np.ndarray, mount: str) -> None:
    from scipy.spatial.transform import Rotation

    pose = world_from_limb(site, at)
    limb = spec.worldbody.add_body(name=LIMB, pos=pose[:3, 3],
                                   quat=Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True))  # fmt: skip
    v, axes = layer.vertices, pose[:3, :3].T  # across the limb, along it, and up, in its own axes
    middle, extent = v.mean(axis=0), np.ptp(v @ axes, axis=0)
    radius = 0.25 * (extent[0] + extent[2])
    mass = DENSITY * np.pi * radius**2 * extent[1]
    limb.explicitinertial, limb.mass, limb.ipos = True, mass, middle
    limb.iquat = Rotation.from_matrix(axes).as_quat(scalar_first=True)
    limb.inertia = mass * (np.dot(extent, extent) - extent**2) / 12
    if mount == "animated":
        limb.mocap = True
    elif mount == "springs":
        for kind, name, (stiffness, damping) in ((mujoco.mjtJoint.mjJNT_SLIDE, "slide", SPRING),
                                                 (mujoco.mjtJoint.mjJNT_HINGE, "turn", TWIST)):  # fmt: skip
            for axis, letter in zip(np.eye(3), "xyz", strict=True):
                joint = limb.add_joint(name=f"limb_{name}_{letter}", type=kind, axis=axis, pos=middle)
                joint.stiffness, joint.damping = np.resize(stiffness, 3), np.resize(damping, 3)
                joint.springref = joint.armature = joint.frictionloss = 0.0  # the robot's defaults are not the limb's
                joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    elif mount == "rest":
        _add_rest(limb, layer, site, pose, bool(spec.compiler.degree))
    elif mount != "fixed":
        raise InvalidInput(f"a limb cannot be mounted '{mount}'. Allowed: {', '.join(get_args(Mount))}.")
    limb.gravcomp = float(mount != "rest")  # it rests on something that is not drawn
    mesh = spec.add_mesh(name=SKIN_MESH)
    mesh.uservert, mesh.userface = v.astype(np.float32).ravel(), layer.faces.astype(np.int32).ravel()
    mesh.usertexcoord = np.tile([0.5 / COLOURS, 0.5], len(v)).astype(np.float32)
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    _add_colours(spec)
    limb.add_geom(name=SKIN_GEOM, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=SKIN_MESH, material=SKIN_MATERIAL,
                  contype=0, conaffinity=0, mass=0.0)  # fmt: skip


def _add_rest(limb: Any, layer: SoftLayer, site: Site, pose: Transform, degrees: bool) -> None:
    """A hinge across the limb at its thicker end, which a rest that is not drawn keeps from turning down.

    Args:
        limb, layer, site, pose: the limb's body, its skin, the place on it, and its pose in the world, (4, 4).
        degrees: whether the robot's file counts angles so, and with it all of its model.
    """
    across = pose[:3, :3].T @ [1.0, 0.0, 0.0]
    along = (layer.vertices - site.point) @ site.along
    sign = -thin_end(site)
    end = layer.vertices[sign * along > (sign * along).max() - END]
    joint = limb.add_joint(name=HINGE, type=mujoco.mjtJoint.mjJNT_HINGE, pos=end.mean(axis=0), axis=-sign * across)
    joint.stiffness, joint.damping = np.zeros(3), np.resize(ELBOW_DAMPING, 3)
    joint.springref = joint.armature = joint.frictionloss = 0.0
    joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, [0.0, np.rad2deg(1.0) if degrees else 1.0]
    joint.solref_limit, joint.solimp_limit = [0.004, 1.0], [0.95, 0.99, 0.001, 0.5, 2.0]


def _add_colours(spec: Any) -> None:
    """A texture whose columns are the colours of no to most displacement."""
    from stmpl_sim.film import colours

    texture = spec.add_texture(name=SKIN_MATERIAL, type=mujoco.mjtTexture.mjTEXTURE_2D, width=COLOURS, height=2,
                               nchannel=3)  # fmt: skip
    row = (255 * colours(np.linspace(0, 1, COLOURS))).astype(np.uint8)
    texture.data = np.concatenate([row, row]).tobytes()
    material = spec.add_material(name=SKIN_MATERIAL, specular=0.1, shininess=0.2, reflectance=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = SKIN_MATERIAL


def _add_stage(spec: Any, at: np.ndarray, side: float) -> None:
    """Light, floor, and a camera on that side of the limb along y."""
    mirror = np.array([1.0, -side, 1.0])
    look, light = FROM * mirror, np.array([0.5, -1.3, 0.9]) * mirror
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.45, 0.45, 0.45]
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
                     width=8, height=48, rgb1=[0.97, 0.97, 0.98], rgb2=[0.97, 0.97, 0.98])  # fmt: skip
    world = spec.worldbody
    world.add_light(pos=at + light, dir=-light, diffuse=[0.45, 0.45, 0.45], castshadow=False)  # shades look like motion
    world.add_geom(name=FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.05], contype=0, conaffinity=0,
                   rgba=[0.93, 0.93, 0.92, 1])  # fmt: skip
    world.add_camera(name=EYE, pos=at + look, xyaxes=[*_looking(AIM - look)], fovy=33)


def _looking(way: np.ndarray) -> np.ndarray:
    """The camera's right and up axes, (6,), when it looks along a way (3,)."""
    back = -way / np.linalg.norm(way)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    return np.concatenate([right, np.cross(back, right)])


class _Start(NamedTuple):
    """A configuration with the ball in its place.

    Args:
        room: distance of the joints from their limits, over their ranges.
        lean: angle of the tool from straight down [rad].
        qpos: configuration, (nq,).
    """

    room: float
    lean: float
    qpos: np.ndarray


def _reach(model: Any, joints: tuple[int, ...], at: np.ndarray, height: float) -> np.ndarray:
    """Configuration with the ball `height` over a place, head down: the first whose joints have room, or most of it.

    An arm of few axes points as well as its place leaves it. At its limits an arm cannot keep a force.
    """
    target, most = at + [0, 0, height], LEAN if len(joints) < AXES else ROUNDED
    if found := _starts(model, joints, target):
        return found[-1].qpos if found[-1].room >= ROOM else max(found, key=lambda one: one.room).qpos
    placed = _starts(model, joints, target, place_first=True)
    least = min((one.lean for one in placed), default=np.inf)
    if least <= most:
        return max((one for one in placed if one.lean <= least + ALIKE), key=lambda one: one.room).qpos
    long = length_of(model, BALL)
    what = ("Is its file in millimetres? MuJoCo takes metres." if long > LONGEST else
            "Put the limb elsewhere (--at X Y Z), or name another end (--end).")  # fmt: skip
    best = f" (at best {np.rad2deg(least):.3g} degrees off)" if placed else ""
    raise InvalidInput(f"the robot's head does not reach the limb at {np.round(at, 3).tolist()} m, "
                       f"pointing down{best}; its links are {long:.3g} m long in all. {what}")  # fmt: skip


def _starts(model: Any, joints: tuple[int, ...], target: np.ndarray, *, place_first: bool = False) -> list[_Start]:
    """Configurations with the ball at a point, by damped least squares from several starts; the last one has room, or
    none has.

    Args:
        model, joints, target: model, the arm's joints, and the point, (3,).
        place_first: choice to point down only as well as the place leaves it.
    """
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    dofs, places = model.jnt_dofadr[list(joints)], model.jnt_qposadr[list(joints)]
    low, high = model.jnt_range[list(joints)].T
    free = ~model.jnt_limited[list(joints)].astype(bool)
    low, high = np.where(free, -np.pi, low), np.where(free, np.pi, high)
    first = model.key_qpos[0][: model.nq] if model.nkey else None
    ball, jacobian = model.geom(BALL).id, np.zeros((6, model.nv))
    found: list[_Start] = []
    for trial in range(STARTS // 4 if place_first else STARTS):
        mujoco.mj_resetData(model, data)
        if trial == 0 and first is not None:
            data.qpos[places] = first[places]
        else:
            data.qpos[places] = 0.5 * (low + high) + (0 if trial < 2 else 0.3 * (high - low)) * random.uniform(
                -1, 1, len(places))  # fmt: skip
        for k in range(STEPS):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            axis = data.geom_xmat[ball].reshape(3, 3)[:, 2]
            error = np.concatenate([target - data.geom_xpos[ball], np.cross(axis, [0, 0, -1.0])])
            if axis[2] > 0:
                error[3:] += axis[[1, 2, 0]]  # upside down: turn somewhere
            pointed = k >= POINTING if place_first else np.abs(error[3:]).max() < EXACT
            if pointed and np.abs(error[:3]).max() < EXACT:
                rooms = np.minimum(data.qpos[places] - low, high - data.qpos[places]) / (high - low)
                room = float(np.where(free, 0.5, rooms).min())
                if room >= 0:
                    found.append(_Start(room, float(np.arccos(np.clip(-axis[2], -1, 1))), data.qpos.copy()))
                break
            mujoco.mj_jacGeom(model, data, jacobian[:3], jacobian[3:], ball)
            part = jacobian[:, dofs]
            aims = [slice(0, 6)] if not place_first else [slice(0, 3), slice(3, 6)] if k < POINTING else [slice(0, 3)]
            step, left = np.zeros(len(dofs)), np.eye(len(dofs))
            for aim in aims:  # each in what those before leave free
                rows = part[aim] @ left
                inverse = np.linalg.solve(rows @ rows.T + 1e-4 * np.eye(len(rows)), rows).T
                step += inverse @ (error[aim] - part[aim] @ step)
                left = left - (np.linalg.pinv(rows, rcond=1e-3) if place_first else inverse) @ rows
            if trial and k < STEPS // 2:  # what the aim leaves free goes to the middle of the ranges
                step += left @ (0.1 * np.where(free, 0.0, 0.5 * (low + high) - data.qpos[places]))
            data.qpos[places] = np.clip(data.qpos[places] + np.clip(step, -0.2, 0.2), low, high)
        if not place_first and found and found[-1].room >= ROOM:
            break
    return found
