"""Laws of what is kept in the user's cache folder: exact or not at all, never needed, and never more than allowed."""

import os

import numpy as np
import pytest

from fem_tools import limb as finite_elements
from stmpl_core import Membrane, Ply, SoftLayer, Tissue, cache
from stmpl_core.bones import Bone, to_bone
from stmpl_core.coarse_response import CoarseResponse, digest
from tests.scenes import limb

STACK = Tissue(3e3, 0.45, skin=Membrane(1.3e5, 1.2e-3, 11.0), deeper=(Ply(6e-3, 15e3, 0.45),))
MADE = CoarseResponse(np.zeros((4, 3), int), np.ones((4, 3)) / 3, np.ones(2), np.full((2, 3, 2), 0.1, np.float32), 7e-3)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("STMPL_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("STMPL_CACHE_MB", raising=False)
    return tmp_path / "cache"


@pytest.fixture
def asked(monkeypatch) -> list[SoftLayer]:
    """The layers whose response is made, instead of being read."""
    layers: list[SoftLayer] = []
    monkeypatch.setattr(finite_elements, "coarse_response", lambda layer: layers.append(layer) or MADE)
    return layers


def layer() -> SoftLayer:
    skin = limb(12e-3, 10e-3, 0.035, 0.16).with_(tissue=STACK)
    return to_bone(skin, [Bone(np.array([0.0, 0, -1]), np.array([0.0, 0, 1]), 0.012)])


def test_what_is_read_is_what_was_made_to_the_last_bit(folder):
    made, read = CoarseResponse.of(layer()), CoarseResponse.of(layer())
    assert len(list(folder.iterdir())) == 1 and read is not made
    for one, other in zip(made, read, strict=True):
        assert type(one) is type(other) and np.array_equal(one, other)
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype and other.flags.c_contiguous, "else kernels are compiled once more"


def test_another_layer_is_another_response(asked):
    soft = layer()
    for one in (soft, soft, soft.with_(tissue=Tissue(3e3, 0.45)), soft.with_(core=soft.inner_vertices * (1 + 1e-15))):
        CoarseResponse.of(one)
    assert len(asked) == 3 and len({digest(one) for one in asked}) == 3


def test_other_code_is_another_response(asked, monkeypatch):
    CoarseResponse.of(layer())
    monkeypatch.setattr("stmpl_core.coarse_response._code", lambda: "another")
    CoarseResponse.of(layer())
    assert len(asked) == 2


@pytest.mark.parametrize("content", [b"", b"broken", None])
def test_a_broken_file_is_made_anew(folder, asked, content):
    CoarseResponse.of(layer())
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + b"?" + whole[middle + 1 :] if content is None else content)
    CoarseResponse.of(layer())
    assert len(asked) == 2 and path.read_bytes() == whole


def test_a_folder_that_cannot_be_is_no_error(folder, asked):
    folder.write_text("a file stands in its place")
    for _ in range(2):
        assert CoarseResponse.of(layer()) is MADE
    assert len(asked) == 2


def test_it_can_be_switched_off(folder, asked, monkeypatch):
    CoarseResponse.of(layer())
    monkeypatch.setenv("STMPL_CACHE_MB", "0")
    CoarseResponse.of(layer())
    assert len(asked) == 2 and len(list(folder.iterdir())) == 1


def test_what_was_used_longest_ago_goes_first(folder):
    for k, name in enumerate(("response-a", "response-b", "response-c", "anny-d")):
        cache.write(name, {"x": np.zeros(1000)})
        os.utime(folder / f"{name}.npz", (k, k))
    assert cache.read("response-a") is not None  # used just now
    cache.trim("response-", 2.5 * (folder / "response-a.npz").stat().st_size)
    assert sorted(path.stem for path in folder.iterdir()) == ["anny-d", "response-a", "response-c"]


def test_a_write_that_fails_leaves_nothing_behind(folder):
    class Full:
        def __array__(self, *arguments, **options):
            raise OSError("no space left on device")

    cache.write("response-a", {"x": Full()})
    assert not list(folder.iterdir()) and cache.read("response-a") is None
