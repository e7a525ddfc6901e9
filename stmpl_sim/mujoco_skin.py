"""SoftBody: a soft skin on a body of a MuJoCo model, which the model's tools feel, and which feels them."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple, NoReturn
from uuid import uuid4
from weakref import ReferenceType, WeakKeyDictionary, WeakValueDictionary, ref

import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.arrays import Transform, Wrench, check_kind, cross, inverted
from stmpl_core.errors import InvalidInput
from stmpl_core.friction import Friction
from stmpl_core.layer import SoftLayer
from stmpl_core.local_contact import local_contacts
from stmpl_core.methods.base import Method
from stmpl_core.rig import Rig
from stmpl_core.simulator import Simulator
from stmpl_core.skin import Skin
from stmpl_core.tool import Tool
from stmpl_core.touch import Answer, Touch
from stmpl_sim.engine import mujoco
from stmpl_sim.jointed import Jointed
from stmpl_sim.protocol import Exerted, Memory, Poses, Reaction, Row, SoftContact, sound_pose

MOST_NAMES = 30  # names of a model that an error lists
KNOWN = 10_000  # rows of xfrc_applied that are known again
RECENT = 16  # steps of a skin whose memory is known again by these
SAME = 1e-9  # difference of sums of wrenches, over the largest number, that is rounding
NO_RK4 = ("the model's integrator is RK4, to which forces that are held over a step add energy. Choose implicitfast, "
          "implicit or Euler.")  # fmt: skip


class _Source(NamedTuple):
    """Where a tool comes from: body that it moves with, and geom whose frame it has (None: the body's)."""

    body: int
    geom: int | None


class _Kept(NamedTuple):
    """What a skin remembers of one MjData: memory after its last `apply` and the time of that [s], None: none yet;
    those that it came from, from which one more at that time goes; and the rows of xfrc_applied in which wrenches of
    the skin stood then, by body, as bytes."""

    memory: Memory
    time: float | None
    before: Memory
    since: float | None
    rows: Mapping[int, bytes] = MappingProxyType({})

    def stands_in(self, data: Any) -> bool:
        """Whether one of the rows stands in `data` as it was left: others may have set numbers in the rest."""
        return any(data.xfrc_applied[body].tobytes() == row for body, row in self.rows.items())


class SoftBody:
    """A soft skin on a body of a MuJoCo model.

        skin = SoftBody(model, layer, body="forearm", tools=["ball"])
        mujoco.mj_step1(model, data)
        touches = skin.apply(data)                    # wrenches on tools and limb
        data.ctrl[:] = controller(data, skin.reaction.tools["ball"])
        mujoco.mj_step2(model, data)
        skin.answer().displacement                    # the field, only when wanted

    The wrenches go into `data.xfrc_applied`, the limb's opposite to the tools', so whatever carries the limb is
    moved: a free joint, springs, joints; an animated (mocap) or fixed body takes them without moving. Each call takes
    the wrenches of the call before out again; numbers that others set there meanwhile, to zero or to a push, count as
    theirs and are added to. So set a push (`=`): adding to it (`+=`) would keep a skin's last wrench as well. Works
    with as many skins as there are limbs.

    Args:
        model: MuJoCo model.
        layer: soft layer at rest, or a Skin, or a Simulator that is ready.
        body: name of the body that carries the skin.
        tools: names of geoms or bodies that may touch: sphere, capsule, ellipsoid, cylinder, box or mesh. A geom's tool
            has the geom's frame; a body's has the body's, and the union of the colliding geoms (all, if none collides)
            of it and of bodies that are welded to it from below.
        method: method that finds the displacement; MomentNet() unless given.
        pose_body_from_layer: pose of the layer's axes in the body's frame, (4, 4); the same frame unless given.
        damping: see SoftContact [s/m].
        implicit: see SoftContact; MuJoCo gives the mobility.
        friction: see SoftContact.
        joints: hinge of the model by the joint of the layer's rig that it turns, as {"left_elbow": "elbow"}: the limb
            bends with it, and the hinge's body feels what presses on that side of it. `body` carries the rig's root.
        every: see SoftContact.

    Attributes:
        contact: the SoftContact.
        reaction: last reaction, with the wrenches in world axes; None before the first `apply`.
        memory: memory of the steps of the `data` that were applied to last; may be set, for the next ones. It goes with
            a state of `data`, also into another process: read it when the state is read, and set it when the state is
            put back, or a skin may take its wrench in that state for somebody's push.

    Raises:
        InvalidInput: names that the model does not have, kinds of geoms that cannot be tools, a tool that is part of
            the limb or of another tool, or one that also collides with the limb rigidly.
        MeshError: a surface that cannot be a tool.
    """

    def __init__(
        self,
        model: Any,
        layer: SoftLayer | Skin | Simulator,
        *,
        body: str,
        tools: Sequence[str],
        method: Method | None = None,
        pose_body_from_layer: ArrayLike | None = None,
        damping: float = 0.0,
        implicit: bool = False,
        friction: Friction | Mapping[str, Friction] = None,
        joints: Mapping[str, str] | None = None,
        every: int = 1,
    ) -> None:
        check_kind("model", model, mujoco.MjModel)
        self.model = model
        self.body = _body(model, body)
        if isinstance(tools, str):
            raise InvalidInput(f"tools is the text '{tools}'; give a list of names: ['{tools}'].")
        if not isinstance(tools, Iterable):
            raise InvalidInput(f"tools is {tools!r:.40}; give a list of names of geoms or bodies.")
        tools = list(tools)
        if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            raise InvalidInput(NO_RK4)
        self._sources = {name: _source(model, name) for name in tools}
        self._jointed = Jointed(model, _rig_of(layer), joints, self.body) if joints else None
        limbs = {self.body} if self._jointed is None else set(self._jointed.bodies)
        for name, source in self._sources.items():
            for limb in limbs:
                if model.body_weldid[source.body] == model.body_weldid[limb] and source.body != 0:
                    whose = model.body(limb).name
                    raise InvalidInput(f"'{name}' is part of '{whose}', or rigidly joined to it: it cannot touch its "
                                       "skin.")  # fmt: skip
                _check_no_rigid_contact(model, limb, _geoms_of(model, source, self._sources.values()))
        geoms = {name: _geoms_of(model, source, self._sources.values()) for name, source in self._sources.items()}
        for whole, source in self._sources.items():
            for name, part in self._sources.items():
                if source.geom is None and part.geom in geoms[whole]:
                    raise InvalidInput(f"tool '{name}' is a geom of tool '{whole}': it would press twice. Name one of "
                                       "them.")  # fmt: skip
        made = [_tool(model, name, self._sources[name], geoms[name]) for name in tools]
        self._geoms = {name: (np.array(some), _shape(model, self._sources[name], some)) for name, some in geoms.items()}
        self.contact = SoftContact(layer, made, method, pose_body_from_layer=pose_body_from_layer, damping=damping,
                                   implicit=implicit, friction=friction, every=every)  # fmt: skip
        if self._jointed is not None:
            self._jointed.compare(model, self.contact.pose_body_from_layer)
        self._key = uuid4().hex
        _LIVE[self._key] = self
        self._felt = {self.body, *limbs, *(source.body for source in self._sources.values())}
        self._kept: WeakKeyDictionary[Any, _Kept] = WeakKeyDictionary()  # by data
        self._recent: deque[_Kept] = deque(maxlen=RECENT)  # of all data, the newest last
        self._exerted_in: ReferenceType[Any] | None = None  # data of the last apply, unless a memory was put since
        self.memory = Memory()
        self.reaction: Reaction | None = None
        self._jacobians = np.zeros((2, 3, model.nv)) if implicit else None

    @property
    def memory(self) -> Memory:
        """Memory of the contact after the last `apply`, or as it was put: with a state of `data`, one from then."""
        if self._exerted_in is not None and (data := self._exerted_in()) is not None:  # others may have come since
            self._keep(data)
        return self._memory

    @memory.setter
    def memory(self, memory: Memory) -> None:
        check_kind("memory", memory, Memory)
        self._memory, self._time, self._exerted_in, self._put = memory, None, None, True
        if memory.exerted is not None:
            self._time = memory.exerted.time
            self._ledger.know(self._key, memory.exerted)

    def _keep(self, data: Any) -> None:
        """Keeps with the memory what stands in `data` of this skin."""
        assert self._time is not None
        rows = self._ledger.rows(data, self._key, self._felt)
        self._memory = replace(self._memory, exerted=Exerted(self._key, self._time, rows))

    @property
    def _ledger(self) -> _Ledger:
        return _LEDGERS.setdefault(self.model, _Ledger())

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise InvalidInput("a SoftBody is neither copied nor pickled, as wrenches of it stand in its data. Make "
                           "another one, SoftBody(model, skin.simulator, ...), and put state and memory into it: "
                           "mj_setState, then other.memory = skin.memory.")  # fmt: skip

    @property
    def simulator(self) -> Simulator:
        """Simulator of the skin."""
        return self.contact.simulator

    def apply(self, data: Any) -> Mapping[str, Touch]:
        """Finds what touches at the positions of `data`, and exerts the wrenches during the coming step.

        Between mj_step1 and mj_step2, or right before mj_step. Positions, and the inertia where `implicit` needs it,
        are made up to date with qpos first. Each MjData of the model has a memory of its own; a copy that our wrenches
        stand in goes on with the memory of what it was copied from. Called again at the same time it answers that
        instant anew, from the memory before it. A time that went back (mj_resetData) starts afresh.

        Returns:
            Touch of each tool, by name, in layer axes.

        Raises:
            InvalidInput: data of another model, positions that are not finite, RK4, chosen since, or geoms of a tool
                that were changed since.
        """
        self._check(data)
        if self.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            raise InvalidInput(NO_RK4)
        for name, (some, shape) in self._geoms.items():
            if _shape(self.model, self._sources[name], some) != shape:
                raise InvalidInput(f"geoms of the tool '{name}' are not as they were when this skin was made. Make "
                                   "another one, SoftBody(model, skin.simulator, ...).")  # fmt: skip
        mujoco.mj_kinematics(self.model, data)
        if self._jacobians is not None:  # what mj_jac and mj_solveM read
            for update in (mujoco.mj_comPos, mujoco.mj_tendon, mujoco.mj_makeM, mujoco.mj_factorM):
                update(self.model, data)
        self._memory, since = self._before(data)
        before, dt = self._memory, 0.0 if since is None else max(0.0, data.time - since)
        asked = self._memory.asked  # not kept where joints take the skin along
        mobility = None if self._jacobians is None else lambda name, at, along: self._mobility(
            data, name, at, along, None if asked is None else asked.touches.get(name))  # fmt: skip
        poses = self.poses(data)
        if self._jointed is None:
            reaction = self.contact.step(poses, self._memory, dt, mobility)
        else:
            reaction = self._step_bent(self._jointed, data, poses, dt, mobility)
        self._memory, self._time, self._put = reaction.memory, float(data.time), False
        self._push(data, reaction)
        self._exerted_in = ref(data)
        self._keep(data)
        exerted = self._memory.exerted.rows if self._memory.exerted is not None else {}
        rows = {body: data.xfrc_applied[body].tobytes() for body in exerted}
        self._kept[data] = kept = _Kept(self._memory, self._time, before, since, rows)
        if rows:
            self._recent.append(kept)
        self.reaction = replace(reaction, memory=self._memory)
        return reaction.touches

    def _before(self, data: Any) -> tuple[Memory, float | None]:
        """Memory from which a step goes, and its time [s]."""
        if self._put:
            return self._memory, self._time
        kept, now = self._kept.get(data), data.time
        if kept is None or (kept.time is not None and now < kept.time) or not kept.stands_in(data):
            kept = next((one for one in reversed(self._recent) if one.time <= now and one.stands_in(data)), kept)
        if kept is None or (kept.time is not None and now < kept.time):
            return Memory(), None
        return (kept.before, kept.since) if data.time == kept.time else (kept.memory, kept.time)

    def _check(self, data: Any) -> None:
        """Raises InvalidInput: no MjData, or that of another model, whose wrenches are not this skin's."""
        check_kind("data", data, mujoco.MjData)
        if data.model is not self.model:
            raise InvalidInput("these are data of another model than the skin's. Make them of its model, "
                               "mujoco.MjData(model), or a SoftBody of theirs.")  # fmt: skip

    def _step_bent(self, jointed: Jointed, data: Any, poses: Poses, dt: float, mobility: Any) -> Reaction:
        """A step of a limb whose joints move."""
        now, skin = jointed.angles(data), self._stood().skin
        if (angles := jointed.following(skin.angles, now)) is not None:
            self._memory = self.contact.pose(dict(zip(jointed.rig.names, angles, strict=True)), self._memory)
            skin = self.simulator.skin
        world = sound_pose("the body", poses.body) @ self.contact.pose_body_from_layer
        to_layer, backs = inverted(world), {}
        for name, pose in poses.tools.items():
            place = self.contact.place(name, to_layer @ sound_pose(name, pose), self._memory)
            backs[name] = world @ jointed.back(skin, place, now) @ to_layer
        there = Poses(poses.body, {name: backs[name] @ pose for name, pose in poses.tools.items()})
        made = self.contact.step(there, self._memory, dt, mobility)
        tools, on_body = {}, np.zeros(6)
        for name, wrench in made.tools.items():
            turn = backs[name][:3, :3].T
            tools[name] = np.concatenate([turn @ wrench[:3], turn @ wrench[3:]])
            lever = poses.tools[name][:3, 3] - poses.body[:3, 3]
            on_body -= tools[name] + np.concatenate([np.zeros(3), np.cross(lever, tools[name][:3])])
        touches = made.touches
        if beyond := jointed.beyond(data):
            touches = {name: touch.with_(trust=touch.trust.also(beyond, in_range=False))
                       for name, touch in touches.items()}  # fmt: skip
        return Reaction(tools, on_body, touches, made.memory)

    def _stood(self) -> Simulator:
        """The simulator, at the angles of this skin's memory: others may use it too."""
        simulator, joints = self.contact.simulator, self._memory.tissue.joints
        if self._jointed is not None and joints is not None and joints != simulator.skin.angles:
            simulator.move_to(simulator.skin.at_angles(joints))
        return simulator

    def poses(self, data: Any) -> Poses:
        """Places of body and tools in `data`. Raises InvalidInput: data of another model."""
        body = self.pose(data)
        tools = {name: _pose(data.xpos[s.body], data.xmat[s.body]) if s.geom is None
                 else _pose(data.geom_xpos[s.geom], data.geom_xmat[s.geom])
                 for name, s in self._sources.items()}  # fmt: skip
        return Poses(body, tools)

    def pose(self, data: Any) -> Transform:
        """pose_world_from_body in `data`, (4, 4). Raises InvalidInput: data of another model."""
        self._check(data)
        return _pose(data.xpos[self.body], data.xmat[self.body])

    def answer(self) -> Answer:
        """The displacement of the skin at the last `apply`, layer axes. Raises InvalidInput before the first one."""
        if self.reaction is None:
            raise InvalidInput("there is no answer before the first apply(data).")
        self._stood()
        return self.contact.answer(self.reaction)

    def stiffness(self, data: Any, name: str) -> np.ndarray:
        """Stiffness of a tool's contact at the last `apply`, friction left out, world axes, (3, 3) [N/m].

        Found from the touch (stmpl_core.local_contact) in half a millisecond; zeros where nothing presses.
        Raises InvalidInput: no such tool, or data of another model.
        """
        self._check(data)
        check_kind("name", name, str)
        if name not in self.contact.tools:
            raise InvalidInput(f"there is no tool {name!r:.40}. Available: {', '.join(self.contact.tools)}.")
        if self.reaction is None:
            return np.zeros((3, 3))
        touch, memory = self.reaction.touches[name], self.reaction.memory
        model = None if memory.asked is None else memory.asked.models.get(name)
        if model is None:
            (model,) = local_contacts(self._stood().history, [touch], memory.tissue)
        turn = (self.pose(data) @ self.contact.pose_body_from_layer)[:3, :3]
        return turn @ model.push_stiffness[:3, :3] @ turn.T

    def skin_points(self, data: Any, answer: Answer | None = None) -> np.ndarray:
        """Vertices of the skin in the world, (V, 3) [m], deformed by an answer if one is given."""
        check_kind("answer", answer, (Answer, type(None)))
        pose = self.pose(data) @ self.contact.pose_body_from_layer
        rest = self._stood().layer.vertices
        return (rest if answer is None else rest + answer.displacement) @ pose[:3, :3].T + pose[:3, 3]

    def reset(self, data: Any) -> None:
        """Takes the wrenches out of `data`, and forgets. Raises InvalidInput: data of another model."""
        self._check(data)
        self._exert(data, {})
        self.memory, self.reaction = Memory(), None
        self._put, self._kept[data] = False, _Kept(Memory(), None, Memory(), None)

    def _push(self, data: Any, reaction: Reaction) -> None:
        rows: dict[int, Wrench] = {}
        for name, source in self._sources.items():
            at = data.xpos[source.body] if source.geom is None else data.geom_xpos[source.geom]
            _add(rows, source.body, reaction.tools[name], at - data.xipos[source.body])
            if self._jointed is not None and reaction.tools[name].any():
                for limb, share in zip(self._jointed.bodies, self._jointed.on(reaction.touches[name]), strict=True):
                    if share > 0:
                        _add(rows, limb, -share * reaction.tools[name], at - data.xipos[limb])
        if self._jointed is None:
            _add(rows, self.body, reaction.body, data.xpos[self.body] - data.xipos[self.body])
        self._exert(data, rows)

    def _exert(self, data: Any, rows: Mapping[int, Wrench]) -> None:
        """Puts wrenches, by body, in place of the last ones; zero where there is none."""
        every = {body: rows.get(body, np.zeros(6)) for body in self._felt}
        self._ledger.replace(data, self._key, every)

    def _limb_under(self, touch: Touch | None) -> int:
        """Number of the body that carried most of a tool's last touch; without one or without joints, the skin's."""
        if self._jointed is None or touch is None or touch.pressure is None or not touch.pressure.any():
            return self.body
        return self._jointed.bodies[int(self._jointed.on(touch).argmax())]

    def _mobility(self, data: Any, name: str, at: np.ndarray, along: np.ndarray,
                  last: Touch | None) -> float:  # fmt: skip
        """Acceleration of the tool against the body along `along` for 1 N between them there [1/kg].

        last: touch of the step before, if there is one.
        """
        assert self._jacobians is not None
        tool, body = self._jacobians
        mujoco.mj_jac(self.model, data, tool, None, at, self._sources[name].body)
        mujoco.mj_jac(self.model, data, body, None, at, self._limb_under(last))
        row = (along @ (tool - body))[None]
        out = np.zeros_like(row)
        mujoco.mj_solveM(self.model, data, out, row)
        return float(out[0] @ row[0])


def _shape(model: Any, source: _Source, geoms: Sequence[int] | np.ndarray) -> bytes:
    """What a tool's surface is made from, but for the vertices of meshes, as bytes."""
    some = [model.geom_size[geoms], model.geom_type[geoms], model.geom_dataid[geoms]]
    if source.geom is None:
        bodies: set[int] = set()
        for body in model.geom_bodyid[geoms].tolist():
            while body != source.body:
                bodies.add(body)
                body = int(model.body_parentid[body])
        below = sorted(bodies)
        some += [model.geom_pos[geoms], model.geom_quat[geoms], model.body_pos[below], model.body_quat[below]]
    return b"".join(one.tobytes() for one in some)


def _rig_of(layer: SoftLayer | Skin | Simulator) -> Rig | None:
    """The rig of a layer at rest, if it has one."""
    if isinstance(layer, Simulator):
        layer = layer.skin
    return (layer.rest or layer).layer.rig if isinstance(layer, Skin) else layer.rig


class _Shares(NamedTuple):
    """What a row of xfrc_applied is made of: what others want, (6,), and what skins exert, (6,) each, by their keys."""

    others: Wrench
    skins: dict[str, Wrench]


class _Ledger:
    """What skins put into xfrc_applied of a model's data, so that each takes out what it put in, and no more.

    A number that is no longer what skins left there is what others want. Rows are known again where a state is
    restored or copied: the last KNOWN of them, and those that came with a memory.
    """

    def __init__(self) -> None:
        self._known: OrderedDict[tuple[int, bytes], _Shares] = OrderedDict()
        self._left: WeakKeyDictionary[Any, dict[int, tuple[Wrench, _Shares]]] = WeakKeyDictionary()
        self._put: dict[tuple[str, int], tuple[Wrench, _Shares]] = {}  # rows of each skin's last memory that was put

    def know(self, owner: str, exerted: Exerted) -> None:
        """Knows the rows of a memory, in which what was its skin's is now this skin's."""
        for body, (numbers, others, ours) in exerted.rows.items():
            known, left = self._known.get((body, numbers.tobytes())), numbers - others - ours
            skins = {} if known is None else {key: each for key, each in known.skins.items()
                                              if key not in (owner, exerted.owner)}  # fmt: skip
            for key in [key for key, each in skins.items() if (each == ours).all()]:
                if np.abs(sum(skins.values(), np.zeros(6)) - left).max() > SAME * np.abs(numbers).max():
                    del skins[key]  # another that was given this memory
            self._put[owner, body] = numbers, _Shares(others, skins | {owner: ours})
            self._remember(body, *self._put[owner, body])

    def rows(self, data: Any, owner: str, bodies: Iterable[int]) -> dict[int, Row]:
        """The rows in which a skin's wrench stands, as skins left them."""
        left = self._left.get(data, {})
        return {body: Row(numbers, shares.others, shares.skins[owner]) for body in bodies if body in left
                for numbers, shares in [left[body]] if owner in shares.skins}  # fmt: skip

    def _remember(self, body: int, numbers: Wrench, shares: _Shares) -> None:
        self._known[body, numbers.tobytes()] = shares
        self._known.move_to_end((body, numbers.tobytes()))
        if len(self._known) > KNOWN:
            self._known.popitem(last=False)

    def replace(self, data: Any, owner: str, rows: Mapping[int, Wrench]) -> None:
        """Puts these wrenches, by body, in place of a skin's last ones."""
        left = self._left.setdefault(data, {})
        for body, wrench in rows.items():
            others, skins = self._read(data.xfrc_applied[body], body, left, owner)
            skins = {key: each for key, each in skins.items() if key != owner and key in _LIVE}
            if wrench.any():
                skins[owner] = wrench
            shares = _Shares(others, skins)
            numbers = data.xfrc_applied[body] = others + sum(skins.values(), np.zeros(6))
            left[body] = numbers, shares
            if skins:
                self._remember(body, numbers, shares)

    def _read(self, numbers: Wrench, body: int, left: Mapping[int, tuple[Wrench, _Shares]], owner: str) -> _Shares:
        if not numbers.any():
            return _Shares(np.zeros(6), {})
        guesses = [guess for guess in (left.get(body), self._put.get((owner, body))) if guess is not None]
        for last, shares in guesses:
            if (numbers == last).all():
                return shares
        if known := self._known.get((body, numbers.tobytes())):
            return known
        if not guesses:
            return _Shares(numbers.copy(), {})
        last, shares = max(guesses, key=lambda guess: (numbers == guess[0]).sum())
        same = numbers == last
        return _Shares(np.where(same, shares.others, numbers), {key: each * same for key, each in shares.skins.items()})


_LEDGERS: WeakKeyDictionary[Any, _Ledger] = WeakKeyDictionary()  # by model
_LIVE: WeakValueDictionary[str, SoftBody] = WeakValueDictionary()


def exclude(spec: Any, body: str, tools: Sequence[str]) -> None:
    """Adds to a MjSpec that these geoms' or bodies' bodies do not collide rigidly with `body`: their skin does that.

    Raises:
        InvalidInput: names that the spec does not have.
    """
    known = {b.name for b in spec.bodies}
    for name in (body, *tools):
        geom = spec.geom(name)
        owner = geom.parent.name if geom is not None else name
        if owner not in known:
            raise InvalidInput(f"there is no geom or body '{name}'. Bodies: {_some(known)}.")
        if name != body:
            for each in (owner,) if geom is not None else _welded(spec.body(owner)):
                spec.add_exclude(bodyname1=body, bodyname2=each)


def _welded(body: Any) -> list[str]:
    """Names of a body of a MjSpec and of those below it that no joint moves."""
    return [body.name, *(name for one in body.bodies if one.name and not one.joints for name in _welded(one))]


def _add(rows: dict[int, Wrench], body: int, wrench: Wrench, lever: np.ndarray) -> None:
    """Adds a wrench about a point that is `lever` from the body's centre of mass, where MuJoCo applies it."""
    about = wrench.copy()
    about[3:] += cross(lever, wrench[:3])
    rows[body] = rows.get(body, 0.0) + about


def _pose(position: np.ndarray, turn: np.ndarray) -> Transform:
    pose = np.zeros((4, 4))
    pose[:3, :3], pose[:3, 3], pose[3, 3] = turn.reshape(3, 3), position, 1.0
    return pose


def _some(names: Any) -> str:
    listed = sorted(name for name in names if name)
    more = len(listed) - MOST_NAMES
    return ", ".join(listed[:MOST_NAMES]) + (f" and {more} more" if more > 0 else "") or "none with a name"


def _names(model: Any, kind: str) -> list[str]:
    count = {"body": model.nbody, "geom": model.ngeom}[kind]
    return [getattr(model, kind)(k).name for k in range(count)]


def _body(model: Any, name: str) -> int:
    names = _names(model, "body")
    if name not in names:
        raise InvalidInput(f"the model has no body '{name}'. Bodies: {_some(names)}.")
    return names.index(name)


def _source(model: Any, name: str) -> _Source:
    geoms, bodies = _names(model, "geom"), _names(model, "body")
    if name in geoms:
        geom = geoms.index(name)
        return _Source(int(model.geom_bodyid[geom]), geom)
    if name in bodies:
        return _Source(bodies.index(name), None)
    raise InvalidInput(f"the model has no geom or body '{name}' to be a tool. Geoms: {_some(geoms)}. "
                       f"Bodies: {_some(bodies)}.")  # fmt: skip


def _geoms_of(model: Any, source: _Source, every: Iterable[_Source]) -> list[int]:
    """Geoms of a tool: of a body those that collide, or all, and the same of each body that is welded to it from below
    and is not named as a tool itself, nor any of whose geoms is."""
    if source.geom is not None:
        return [source.geom]
    named, found = {one.body for one in every} - {source.body}, []
    for body in range(source.body, model.nbody if source.body else 1):
        if _hangs_on(model, body, source.body, named):
            own = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == body]
            found += [geom for geom in own if model.geom_contype[geom] or model.geom_conaffinity[geom]] or own
    return found


def _hangs_on(model: Any, body: int, other: int, but: set[int]) -> bool:
    """Whether a body is another, or welded to it from below by none of some."""
    while body not in (other, 0) and body not in but and not (model.body_jntnum[body] or model.body_mocapid[body] >= 0):
        body = int(model.body_parentid[body])
    return body == other


def _tool(model: Any, name: str, source: _Source, geoms: list[int]) -> Tool:
    from stmpl_sim.shapes import body_surface, geom_surface

    if not geoms:
        raise InvalidInput(f"body '{name}' has no geom that could touch.")
    return Tool(name, *(geom_surface(model, source.geom) if source.geom is not None
                        else body_surface(model, geoms, source.body)))  # fmt: skip


def _is_welded(model: Any, body: int, limb: int) -> bool:
    """Whether a body is the limb's or moves with it; the world and what else stands still in it does not count."""
    if body == limb or model.body_weldid[limb] != 0:
        return bool(body == limb or model.body_weldid[body] == model.body_weldid[limb])
    while body not in (limb, 0) and model.body_weldid[body] == 0:
        body = int(model.body_parentid[body])
    return body == limb != 0


def _filtered(model: Any, one: int, other: int) -> bool:
    """Whether MuJoCo takes two bodies not to collide, as one hangs on the other."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        return False
    a, b = (int(model.body_weldid[body]) for body in (one, other))
    above = [int(model.body_weldid[model.body_parentid[body]]) for body in (a, b)]
    return bool(a and b and (a == above[1] or b == above[0]))


def _check_no_rigid_contact(model: Any, body: int, geoms: Iterable[int]) -> None:
    """Raises InvalidInput where MuJoCo would make rigid contacts between the tool's geoms and the limb's.

    The limb has those of its body and of what is welded to it; where it is fixed to the world, of what hangs on it.
    """
    signatures = {int(s) for s in model.exclude_signature}
    for tool in geoms:
        for limb in range(model.ngeom):
            owner, whose = int(model.geom_bodyid[limb]), int(model.geom_bodyid[tool])
            if not _is_welded(model, owner, body):
                continue
            first, second = sorted((whose, owner))
            meet = not _filtered(model, whose, owner) and (
                model.geom_contype[tool] & model.geom_conaffinity[limb]
                or model.geom_contype[limb] & model.geom_conaffinity[tool])  # fmt: skip
            paired = any({int(model.pair_geom1[p]), int(model.pair_geom2[p])} == {tool, limb}
                         for p in range(model.npair))  # fmt: skip
            if paired or (meet and (first << 16) + second not in signatures):
                a, b = model.body(owner).name, model.body(whose).name
                raise InvalidInput(
                    f"geom '{model.geom(tool).name or tool}' of '{b}' also collides rigidly with geom "
                    f"'{model.geom(limb).name or limb}' of '{a}'. Let only the skin touch: add <exclude body1=\"{a}\" "
                    f'body2="{b}"/> to <contact>, or call stmpl_sim.exclude(spec, "{a}", ["{b}"]) before compiling.')
