"""11 Many at once: a small policy learns to press a living forearm with 5 N, wherever it begins.

Purpose: learning and search ask about thousands of scenes that know nothing of each other.
Shows: `Batch`: poses in, wrenches out, on all cores; each scene goes on from a state of its own.

    .venv/bin/python examples/11_many_at_once.py
"""

import numpy as np
import trimesh

from stmpl_core import State, Tool
from stmpl_core.batch import Batch
from stmpl_core.body import Body
from stmpl_core.living import living
from stmpl_core.methods import MomentNet
from stmpl_core.regions import HELD_SKIN
from stmpl_core.skin import Skin

RADIUS, FORCE, DT, STEPS = 20e-3, 5.0, 0.02, 30  # m, N, s
SCENES, TRIED, ROUNDS, BEST = 5, 8, 4, 3  # places on the limb, policies at a time, how often, how many are kept


def main() -> float:
    """Mean distance from the wanted force over the last third, under the policy that was learnt [N]."""
    layer = living(Body.anny(), "left_forearm", edge_length=6e-3)
    ball = trimesh.creation.icosphere(3, RADIUS)
    skin = Skin.of(layer.with_(tissue=layer.tissue.relaxing(HELD_SKIN)), MomentNet())
    batch = Batch(skin, [Tool("ball", ball.vertices, ball.faces)], SCENES * TRIED)
    rng, from_middle = np.random.default_rng(0), np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1)
    places = np.tile(rng.choice(from_middle.argsort()[:150], SCENES), TRIED)
    poses = np.tile(np.eye(4), (SCENES * TRIED, 1, 1, 1))

    def played(gains: np.ndarray) -> np.ndarray:
        """Mean error [N] of policies with gains (TRIED, 2): how fast it goes deeper [m/N/s] by error and by rate."""
        each, states = np.repeat(gains, SCENES, axis=0), [State()] * len(batch)
        depth, before, errors = np.zeros(len(batch)), np.zeros(len(batch)), []
        for _ in range(STEPS):
            poses[:, 0, :3, 3] = layer.vertices[places] + (RADIUS - depth)[:, None] * layer.normals[places]
            touched = batch.touch(poses, states, DT)
            force, states = np.linalg.norm(touched.wrenches[:, 0, :3], axis=1), touched.states
            depth += DT * each[:, 0] * (FORCE - force) - each[:, 1] * (force - before)
            depth, before = np.clip(depth, 0.0, 0.6 * layer.thickness[places]), force
            errors.append(np.abs(force - FORCE))
        return np.mean(errors[2 * STEPS // 3 :], axis=0).reshape(TRIED, SCENES).mean(axis=1)

    middle, spread = np.log([2e-3, 2e-5]), np.ones(2)  # of the gains' logarithms
    for turn in range(ROUNDS):
        errors = played(np.exp(tried := middle + spread * rng.normal(size=(TRIED, 2))))
        best = tried[errors.argsort()[:BEST]]
        middle, spread = best.mean(axis=0), best.std(axis=0) + 0.1
        print(f"round {turn + 1}: best {errors.min():.2f} N off, median {np.median(errors):.2f} N")
    found = float(played(np.tile(np.exp(middle), (TRIED, 1)))[0])
    print(f"learnt: {1e3 * np.exp(middle[0]):.2g} mm/s deeper for each N missing: {found:.2f} N off")
    return found


if __name__ == "__main__":
    main()
