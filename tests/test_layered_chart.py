"""Laws of the chart of layered limbs: what is made of its answers, and where the peer has its materials."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.layered_chart import ONE_LAYER, OURS, Row, best, draw, points, pressing, shared, simpler, table
from benchmarks.limbs import FILE
from fem_tools.released import Released
from stmpl_core import SoftLayer
from stmpl_core.tissue import Membrane, Ply, Tissue
from studies.peers import installed
from studies.pressed import STRAIGHT, pressed, slant_of
from tests.scenes import plate

RADIUS, DEPTH = 12e-3, 2e-3  # m, of a ball


def rows(curve: str, forces: list[float]) -> list[Row]:
    return [Row(curve, "", f"scene {k}", force, 0.05, 2e-3) for k, force in enumerate(forces)]


def test_the_best_modulus_leaves_no_more_than_any_other() -> None:
    shares = np.array([0.2, 0.25, 0.21, 0.5])
    least = np.abs(best(shares) * shares - 1).mean()
    assert all(least <= np.abs(factor * shares - 1).mean() + 1e-12 for factor in np.linspace(0.5, 8, 300))


def test_one_layer_alone_is_given_its_modulus_and_all_are_shown(tmp_path: Path) -> None:
    one, ours = points([*rows(ONE_LAYER, [0.2, 0.2, 0.2]), *rows(OURS, [1.1, 0.9, 1.0])])
    assert one.force == pytest.approx(0, abs=1e-9) and ours.force == pytest.approx(20 / 3)
    assert ours.motion == pytest.approx(5) and ours.took == pytest.approx(2) and ours.scenes == 3
    assert list(table([one, ours]))[-1].startswith(f"| {OURS} |  | 3 | 6.7 % | 10 % | 5 % | 2 ms |")
    draw([ours], tmp_path / "chart.png")
    assert (tmp_path / "chart.png").stat().st_size > 1000


def test_what_is_shared_is_what_all_answer() -> None:
    every = [*rows(OURS, [1.0, 1.0, 1.0]), *rows(ONE_LAYER, [0.2])]
    assert [row.scene for row in shared(every)] == ["scene 0", "scene 0"]


def test_a_force_is_what_presses_without_drag() -> None:
    layer = plate(0.03, 6e-3)
    tractions = np.cross(layer.normals, [1.0, 0.0, 0.0]) * 50.0 - 100.0 * layer.normals
    expected = -(np.full(len(layer.vertices), 100.0) @ layer.vertex_area_vectors)
    np.testing.assert_allclose(pressing(layer, tractions), expected, rtol=1e-9, atol=1e-12)


def test_the_simpler_laws_answer_a_scene_that_is_released() -> None:
    released = Released(FILE)
    sample = next(one for one in released.samples("held_out") if slant_of(one) <= STRAIGHT and one.info["ratio"] > 0.2)
    every = list(pressed([sample]))
    linear, columns = (next(simpler(every[0].sample.layer, alone)(every)) for alone in (False, True))
    assert linear is not None and columns is not None
    true = float(np.linalg.norm(every[0].force))
    assert 0.6 * true < np.linalg.norm(linear[0]) < 1.6 * true
    assert 0 < np.linalg.norm(columns[0]) < true  # no column holds its neighbours
    assert all(np.isfinite(motion).all() and motion.any() and took > 0 for _, motion, took in (linear, columns))


@pytest.mark.skipif("mujoco_flex" not in installed(), reason="needs mujoco")
def test_a_stack_as_flex_is_as_hard_as_its_materials() -> None:
    from studies.peers.layered_flex import LayeredFlex

    def force(tissue: Tissue) -> float:
        layer: SoftLayer = plate(0.06, 6e-3, 0.012).with_(tissue=tissue)
        loaded = np.flatnonzero(np.linalg.norm(layer.vertices[:, :2], axis=1) < 7e-3)
        peer = LayeredFlex(layer, loaded, RADIUS, refine=0, reach=2.0, timestep=0.02)
        heights = RADIUS - DEPTH * np.linspace(0, 1, 11)[1:]
        held = peer.press(np.stack([0 * heights, 0 * heights, heights], axis=1))
        assert held.rests and held.min_j > 0.3
        return float(-(layer.vertex_areas @ held.traction)[2])

    stack = Tissue(3e3, 0.45, deeper=(Ply(4e-3, 18e3, 0.45),))
    same = Tissue(3e3, 0.45, deeper=(Ply(4e-3, 3e3, 0.45),))
    soft, firm, both = force(same), force(Tissue(18e3, 0.45, deeper=(Ply(4e-3, 18e3, 0.45),))), force(stack)
    assert firm == pytest.approx(6 * soft, rel=0.05) and 1.1 * soft < both < 0.8 * firm
    skinned = Tissue(3e3, 0.45, skin=Membrane(6e4, 1.5e-3, 0.0, 0.45), deeper=stack.deeper)
    assert force(skinned) > 1.1 * both
