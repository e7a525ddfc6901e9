"""Laws of trust along an approach: it comes at most once and goes at most once."""

import numpy as np
import pytest

from benchmarks.tools import ball, block_letter, fingertip, flat
from stmpl_core import Contact, Simulator, Tissue, Tool
from stmpl_core.conform import kept_out
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import MomentNet, Winkler
from stmpl_core.trust import Trust
from studies.stability.meshes import inserted
from studies.stability.meshes import limb as round_limb
from tests.scenes import STACK, limb, plate, turn

TOOLS = {"ball": ball(12), "fingertip": fingertip(8, 14), "punch": flat(9, 1.5), "letter": block_letter("H", 26)}
SIDEWAYS = turn((0, 1, 0), np.pi / 2)  # z of a tool to x of the limb
DEPTHS = np.concatenate([np.arange(0.005, 0.1, 0.01), np.arange(0.1, 0.905, 0.02)])  # over the thickness
LAYERS = {"paper": limb(4e-3), "layered": limb(6e-3, 0.02, 0.05, 0.2).with_(tissue=STACK),
          "thin": limb(6e-3, 4.5e-3, 0.05, 0.2).with_(tissue=STACK)}  # fmt: skip


@pytest.fixture(scope="module", params=LAYERS)
def simulator(request: pytest.FixtureRequest) -> Simulator:
    return Simulator(LAYERS[request.param], MomentNet())


def down(simulator: Simulator, tool: Tool, depth: float) -> Contact:
    """A tool so deep over the thickness, from +x, over a vertex in the middle of the limb."""
    vertices = simulator.layer.vertices
    middle = vertices[np.argmin(np.linalg.norm(vertices - [vertices[:, 0].max(), 0, vertices[:, 2].mean()], axis=1))]
    pose = SIDEWAYS.copy()
    pose[:3, 3] = middle - [depth * simulator.layer.thickness.max(), 0, 0]
    return Contact(tool, pose)


@pytest.mark.parametrize("name", TOOLS)
def test_trust_comes_at_most_once_and_goes_at_most_once(simulator: Simulator, name: str) -> None:
    answers = [simulator.step([down(simulator, TOOLS[name], depth)]) for depth in DEPTHS]
    trusted = np.array([answer.trust.in_range for answer in answers])
    changes = np.flatnonzero(np.diff(trusted))
    assert len(changes) <= 2 - trusted[0], [(DEPTHS[k + 1], answers[k].trust.why, answers[k + 1].trust.why)
                                            for k in changes]  # fmt: skip


def test_a_node_just_beyond_what_was_learnt_counts_for_little() -> None:
    """Of tissue that is more and more compressible all nodes are, from a Poisson's ratio of 0.3 on."""
    seen = []
    for nu in (0.3, 0.295, 0.29, 0.28):
        simulator = Simulator(LAYERS["paper"].with_(tissue=Tissue(1e3, nu)), Winkler())
        (touch,) = simulator.touch([down(simulator, TOOLS["ball"], 0.3)])
        assert touch.pressed is not None
        seen.append(simulator.toucher.net.hold(touch.pressed.squeeze.nodes).outside)
    assert not seen[0].any() and (seen[-1] == 1).all()
    assert 0 < seen[1].min() <= seen[1].max() < seen[2].min() <= seen[2].max() < 1


@pytest.mark.parametrize("depth", [0.3, 0.5, 0.8])
def test_skin_between_the_walls_of_a_letter_is_moved_out_of_it(depth: float) -> None:
    layer = plate(0.1, 2e-3)
    simulator, pose = Simulator(layer, Winkler()), np.eye(4)
    pose[2, 3] = -depth * layer.thickness.max()
    touches = simulator.touch([Contact(TOOLS["letter"], pose)])
    assert kept_out(layer, np.zeros_like(layer.vertices), touches).entered < 0.005 * layer.thickness.max()


@pytest.mark.parametrize("depth", [0.1, 0.3, 0.6])
def test_bounds_know_that_the_facets_of_a_coarse_mesh_lie_below_round_skin(depth: float) -> None:
    fine, coarse = (Simulator(limb(edge, 0.02, 0.05, 0.2).with_(tissue=STACK), MomentNet()) for edge in (4e-3, 0.011))
    contact = down(fine, ball(40), depth)
    (expected,), answer = fine.touch([contact]), coarse.step([contact])
    (touch,) = answer.touches.values()
    assert answer.trust.in_range
    assert touch.force < 0.985 * expected.force
    assert expected.force - touch.force < touch.force_bound < 0.35 * touch.force


def test_a_long_triangle_among_even_ones_is_not_flagged_and_many_are() -> None:
    mesh = round_limb(4e-3, 0.04, 0.12, 7.5e-3)
    contact = down(Simulator(mesh.layer, Winkler()), ball(40), 0.3)
    place = contact.pose_body_from_tool[:3, 3]  # its tip
    near = np.linalg.norm(mesh.vertices[mesh.faces].mean(axis=1) - place, axis=1).argsort()
    answers = [Simulator(inserted(mesh, some, (1 / 3, 1 / 3, 1 / 3)).layer, MomentNet()).step([contact])
               for some in (near[:1], near[:90:2])]  # fmt: skip
    assert [answer.trust.in_range for answer in answers] == [True, False]
    assert "longer than 2.2 times" in answers[1].trust.why


def test_skin_as_thin_as_paper_far_from_a_press_is_held_back_without_a_flag() -> None:
    """As in the folds of an armpit."""
    layer = LAYERS["layered"]
    simulator = Simulator(layer, MomentNet())
    contact = down(simulator, ball(40), 0.5)
    moved = np.linalg.norm(simulator.step([contact]).displacement, axis=1)
    far = int(np.abs(np.linalg.norm(layer.vertices - contact.pose_body_from_tool[:3, 3], axis=1) - 0.06).argmin())
    thin = np.where(np.arange(len(moved)) == far, 0.2 * moved[far], layer.thickness)
    answer = Simulator(layer.with_(thickness=thin), MomentNet()).step([contact])
    assert answer.trust.in_range, answer.trust.why
    assert 0.95 * thin[far] < np.linalg.norm(answer.displacement[far]) <= thin[far]


@pytest.mark.parametrize("depth", [0.15, 0.3])
def test_bounds_know_the_noise_of_a_scan(depth: float) -> None:
    layer, covered = LAYERS["paper"], []
    contact = down(Simulator(layer, Winkler()), TOOLS["ball"], depth)
    (smooth,) = Simulator(layer, Winkler()).touch([contact])
    for seed in range(8):
        noise = np.random.default_rng(seed).normal(0, 1e-4, layer.vertices.shape)
        (touch,) = Simulator(layer.with_(vertices=layer.vertices + noise), Winkler()).touch([contact])
        covered.append(abs(touch.force - smooth.force) < touch.force_bound)
        assert touch.force_bound / touch.force > smooth.force_bound / smooth.force + 0.05
    assert sum(covered) >= 7


@pytest.mark.parametrize("flags", [{"in_range": ""}, {"converged": 1.0}, {"in_range": None}])
def test_a_flag_that_is_no_truth_is_refused(flags: dict) -> None:
    """A method of one's own that puts its reason where the flag belongs was counted as flagged."""
    with pytest.raises(InvalidInput, match="True or False is needed"):
        Trust(**flags)
