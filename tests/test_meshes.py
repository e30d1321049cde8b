"""Given meshes of any kind: the right prior, or one line that says what is wrong."""

import numpy as np
import pytest
import synthetic
import trimesh
from program import command, said

from mgs.data import meshes
from mgs.data.dataset import Dataset
from mgs.data.meshes import Mesh, read_mesh
from mgs.errors import InputError
from mgs.prior.build import load_prior, prior_from_mesh
from mgs.prior.settings import PriorSettings
from mgs.prior.surface import sample_surface


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return synthetic.write_dataset(tmp_path_factory.mktemp("meshes") / "data")


def test_a_plain_ply_is_read_as_trimesh_reads_it(tmp_path, monkeypatch):
    path, ball = tmp_path / "a.ply", trimesh.creation.icosphere(subdivisions=2)
    vertices, faces = ball.vertices + 0.1, np.vstack([ball.faces, ball.faces[:3, ::-1]])

    def write(vertices, faces):
        trimesh.Trimesh(vertices, faces, process=False).export(path)

    write(vertices, faces)
    assert meshes._plain_ply(path)
    fast = read_mesh(path)
    with monkeypatch.context() as patch:
        patch.setattr(meshes, "_plain_ply", lambda path: None)
        slow = read_mesh(path)
    for name in ("vertices", "faces", "seen"):
        assert np.array_equal(getattr(fast, name), getattr(slow, name))
    write(vertices, faces + 1)
    with pytest.raises(InputError, match="names vertex"):
        read_mesh(path)
    write(np.where(vertices > 1, np.nan, vertices), faces)
    with pytest.raises(InputError, match="is NaN"):
        read_mesh(path)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match="not a readable mesh"):
        read_mesh(path)


def test_the_prior_of_a_glb_stands_upright(dataset, tmp_path, capsys):
    options = ["--mesh", dataset.root / "rock.glb", "--gaussians", 100, "--out", tmp_path / "p"]
    command("prior", dataset.root, *options)
    assert "turned from +Y up" in said(capsys)[0]
    assert np.abs(synthetic.level(load_prior(tmp_path / "p").points)).max() < 0.01


def _spoilt() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Vertices and faces of the rock with defects that can be mended."""
    mesh = synthetic.rock_mesh()
    v, f = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    some = np.random.default_rng(0).random(len(f))[:, None] < 0.3
    turned, n = f[:, ::-1], len(v)
    own = np.arange(f.size).reshape(-1, 3)
    no_area = [[0, 0, 0], [3, 3, 5], [0, 1, n]]
    both = np.concatenate
    return {
        "faces twice, the second time inside out": (v, both([f, turned])),
        "all of it twice, with vertices of its own": (both([v, v]), both([f, turned + n])),
        "faces without area": (both([v, (v[:1] + v[1:2]) / 2]), both([no_area, f])),
        "vertices of no face": (both([[[900.0, 0, 0]], v]), f + 1),
        "inside out": (v, turned),
        "some faces inside out": (v, np.where(some, turned, f)),
        "some faces inside out, no vertex shared": (
            v[f].reshape(-1, 3),
            np.where(some, own[:, ::-1], own),
        ),
    }


SPOILT = _spoilt()


@pytest.mark.parametrize("how", SPOILT)
def test_a_mesh_that_can_be_mended_gives_the_same_prior(tmp_path, how):
    synthetic.rock_mesh().export(tmp_path / "rock.ply")
    trimesh.Trimesh(*SPOILT[how], process=False).export(tmp_path / "spoilt.ply")
    right, found = (
        prior_from_mesh(tmp_path / f"{name}.ply", PriorSettings(gaussians=200, backing=0))
        for name in ("rock", "spoilt")
    )
    assert len(found.mesh.vertices) == len(right.mesh.vertices) or how.endswith("shared")
    assert len(found.mesh.faces) == len(right.mesh.faces)
    assert found.spacing == pytest.approx(right.spacing)
    outward = (found.points - synthetic.CENTRE) / synthetic.AXES**2
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert (np.einsum("nk,nk->n", outward, found.normals) > 0.99).all()
    # How evenly they lie tells whether a part has more than its share.
    octant = np.unique((found.points > synthetic.CENTRE) @ [1, 2, 4], return_counts=True)[1]
    assert octant.min() > 15


def test_a_single_triangle_and_a_fold_are_sampled(dataset, tmp_path):
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 3 2\n")
    options = ["--mesh", tmp_path / "one.obj", "--gaussians", 40, "--out", tmp_path / "p"]
    command("prior", dataset.root, *options)
    # As it is wound, and drawn though no face is towards the viewer.
    assert np.allclose(load_prior(tmp_path / "p").normals, [0, 0, -1])
    # Two triangles folded flat onto each other: the normals of their vertices cancel.
    corners, faces = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 1]])
    normals = sample_surface(Mesh(corners, faces, np.ones(2, bool)), 0, count=40)[1]
    assert np.allclose(np.abs(normals), [0, 0, 1])
