"""Wrist: the force and torque sensor between a robot and its massage head."""

from __future__ import annotations

from typing import Any

import numpy as np

from stmpl_core.arrays import Wrench, cross
from stmpl_sim.engine import mujoco
from stmpl_sim.scene import BALL, HEAD, WRIST, Scene


class Wrist:
    """What a six-axis sensor at the wrist measures, as drivers state it: the weight of the head is taken off.

    What the head's own acceleration adds (m a, some 0.1 N of 5 N on a circle at 50 mm/s) stays in, as with real
    sensors.

    Args:
        scene: scene.
    """

    def __init__(self, scene: Scene) -> None:
        model = scene.model
        self._model, self._site = model, model.site(WRIST).id
        self._head, self._ball = model.body(HEAD).id, model.geom(BALL).id
        first = {
            int(model.sensor_type[k]): int(model.sensor_adr[k])
            for k in range(model.nsensor)
            if model.sensor_objtype[k] == mujoco.mjtObj.mjOBJ_SITE and model.sensor_objid[k] == self._site
        }
        self._force = first[int(mujoco.mjtSensor.mjSENS_FORCE)]
        self._torque = first[int(mujoco.mjtSensor.mjSENS_TORQUE)]  # fmt: skip

    def wrench(self, data: Any) -> Wrench:
        """Wrench that the tool exerts on what it touches, about the tool's origin, world axes, (6,) [N, N m].

        Args:
            data: MuJoCo data after mj_step2: of the instant of the last mj_step1.
        """
        turn, at = data.site_xmat[self._site].reshape(3, 3), data.site_xpos[self._site]
        force = turn @ data.sensordata[self._force : self._force + 3]  # what the robot exerts on its head
        torque = turn @ data.sensordata[self._torque : self._torque + 3]
        weight = self._model.body_mass[self._head] * self._model.opt.gravity
        force, torque = force + weight, torque + cross(data.xipos[self._head] - at, weight)
        return np.concatenate([force, torque + cross(at - data.geom_xpos[self._ball], force)])
