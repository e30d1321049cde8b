"""Meshes of any kind, given by hand: the right prior, or one line that says what is wrong."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import synthetic
import trimesh
from refusals import refused

from mgs.cli.app import main
from mgs.data.dataset import Dataset
from mgs.data.meshes import Mesh
from mgs.prior.build import load_prior, prior_from_mesh
from mgs.prior.settings import PriorSettings
from mgs.prior.surface import sample_surface


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return synthetic.write_dataset(tmp_path / "data")


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face {faces}
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
{last}
"""
BAD_MESHES: dict[str, tuple[str, str | None, str]] = {
    "missing": ("a.ply", None, "no such mesh"),
    "empty file, PLY": ("a.ply", "", "not a readable mesh"),
    "empty file, OBJ": ("a.obj", "", "no faces"),
    "empty file, GLB": ("a.glb", "", "not a readable mesh"),
    "damaged": ("a.ply", "ply\nformat nonsense", "not a readable mesh"),
    "point cloud, PLY": ("a.ply", PLY.format(faces=0, last="0 0 1"), "has no faces"),
    "point cloud, XYZ": ("a.xyz", "0 0 0\n1 1 1\n2 0 1\n", "has no faces"),
    "lines": ("a.obj", f"{TRIANGLE}l 1 2 3\n", "has no faces"),
    "NaN vertex": ("a.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "vertex 0 is NaN"),
    "infinite vertex": (
        "a.obj",
        "v 0 0 0\nv inf 0 0\nv 0 1 0\nf 1 2 3\n",
        "vertex 1 is NaN or infinite",
    ),
    "NaN vertex of no face": (
        "a.ply",
        PLY.format(faces=1, last="nan 0 0\n3 0 1 2"),
        "vertex 3 is NaN",
    ),
    "vertex out of numbers": (
        "a.obj",
        "v 0 0 0\nv 1e200 0 0\nv 0 1e200 0\nf 1 2 3\n",
        "further than",
    ),
    "vertex that is not there": (
        "a.ply",
        PLY.format(faces=1, last="0 0 1\n3 0 1 9"),
        "names vertex 9 of 4",
    ),
    "vertex of negative number": (
        "a.ply",
        PLY.format(faces=1, last="0 0 1\n3 0 1 -1"),
        "names vertex -1 of 4",
    ),
    "no area": ("a.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "none of its faces has an area"),
    "all one point": (
        "a.obj",
        "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n",
        "none of its faces has an area",
    ),
    "small and far away": (
        "a.obj",
        "v 1e6 0 0\nv 1000001 0 0\nv 1e6 1 0\nf 1 2 3\n",
        "float32 does not resolve",
    ),
}


@pytest.mark.parametrize("case", BAD_MESHES)
def test_bad_mesh_is_one_line(
    dataset: Dataset, tmp_path: Path, case: str, capsys: pytest.CaptureFixture[str]
) -> None:
    name, content, message = BAD_MESHES[case]
    if content is not None:
        (tmp_path / name).write_text(content)
    line = refused(
        capsys, ["prior", dataset.root, "--mesh", tmp_path / name, "--gaussians", 100], dataset.root
    )
    assert message in line
    if case != "small and far away":  # of which a mask can well be made
        out = tmp_path / "out"
        assert message in refused(
            capsys, ["import", dataset.root, "--out", out, "--mesh", tmp_path / name], out
        )


@pytest.mark.parametrize(
    "options", [["--spacing", "1e-6"], ["--spacing", "1e-300"], ["--gaussians", "1" + 30 * "0"]]
)
def test_more_samples_than_memory_holds_is_one_line(
    dataset: Dataset, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    line = refused(
        capsys, ["prior", dataset.root, "--mesh", dataset.root / "rock.glb", *options], dataset.root
    )
    assert re.search(
        r"N = [\d.e+Infinity]+ samples take about [\d.e+Infinity]+ GB of memory, and this machine has [\d.]+ GB",
        line,
    )


@pytest.mark.parametrize(
    "options", [["--prior-noise", "0.01"], ["--holes", "0.2"], ["--poisson-depth", "0"]]
)
def test_what_a_given_mesh_has_no_use_for_is_refused(
    dataset: Dataset, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        "prior",
        dataset.root,
        "--mesh",
        dataset.root / "rock.glb",
        "--gaussians",
        100,
        *options,
    ]
    line = refused(capsys, arguments, dataset.root)
    assert options[0] in line
    assert "--mesh" in line


def test_the_record_of_a_given_mesh_says_what_was_done(
    dataset: Dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(
            [
                "prior",
                str(dataset.root),
                "--mesh",
                str(dataset.root / "rock.glb"),
                "--gaussians",
                "100",
                "--seed",
                "3",
            ]
        )
    assert exit_.value.code == 0
    assert load_prior(dataset.root / "prior").numbers["settings"] == {
        "gaussians": 100,
        "spacing": None,
        "seed": 3,
        "backing": 0.5,
    }
    assert "some frame saw" not in capsys.readouterr().out


def _spoilt(how: str) -> trimesh.Trimesh:
    """The rock as a mesh with a defect that can be mended."""
    mesh = synthetic.rock_mesh()
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    some = np.random.default_rng(0).random(len(faces)) < 0.3
    if how == "faces twice":
        faces = np.concatenate([faces, faces[some]])
    elif how == "faces twice, the second time inside out":
        faces = np.concatenate([faces, faces[:, ::-1]])
    elif how == "all of it twice, with vertices of its own":
        vertices, faces = (
            np.concatenate([vertices, vertices]),
            np.concatenate([faces, faces[:, ::-1] + len(vertices)]),
        )
    elif how == "faces of one point, faces without area":
        line = [[0, 1, len(vertices)]]
        vertices = np.concatenate([vertices, (vertices[:1] + vertices[1:2]) / 2])
        faces = np.concatenate([[[0, 0, 0], [3, 3, 5]], line, faces])
    elif how == "vertices of no face":
        vertices, faces = np.concatenate([[[900.0, 0, 0]], vertices]), faces + 1
    elif how == "inside out":
        faces = faces[:, ::-1]
    elif how == "some faces inside out":
        faces = np.where(some[:, None], faces[:, ::-1], faces)
    elif how == "some faces inside out, no vertex shared":
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
        faces = np.where(some[:, None], faces[:, ::-1], faces)
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.mark.parametrize(
    "how",
    [
        "faces twice",
        "faces twice, the second time inside out",
        "all of it twice, with vertices of its own",
        "faces of one point, faces without area",
        "vertices of no face",
        "inside out",
        "some faces inside out",
        "some faces inside out, no vertex shared",
    ],
)
def test_a_mesh_that_can_be_mended_gives_the_same_prior(tmp_path: Path, how: str) -> None:
    synthetic.rock_mesh().export(tmp_path / "rock.ply")
    _spoilt(how).export(tmp_path / "spoilt.ply")
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


def test_a_single_triangle_and_a_fold_are_sampled(dataset: Dataset, tmp_path: Path) -> None:
    (tmp_path / "one.obj").write_text(f"{TRIANGLE}f 1 3 2\n")
    with pytest.raises(SystemExit) as exit_:
        main(
            [
                "prior",
                str(dataset.root),
                "--mesh",
                str(tmp_path / "one.obj"),
                "--gaussians",
                "40",
                "--out",
                str(tmp_path / "p"),
            ]
        )
    assert exit_.value.code == 0
    assert np.allclose(
        load_prior(tmp_path / "p").normals, [0, 0, -1]
    )  # as it is wound, and drawn though none faces the viewer
    # Two triangles folded flat onto each other: the normals of their vertices cancel.
    fold = Mesh(
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]),
        np.array([[0, 1, 2], [0, 2, 1]]),
        np.ones(2, bool),
    )
    normals = sample_surface(fold, 0, count=40)[1]
    assert np.allclose(np.abs(normals), [0, 0, 1])


def test_a_mesh_with_holes_is_sampled(tmp_path: Path, dataset: Dataset) -> None:
    mesh = synthetic.rock_mesh()
    mesh.update_faces(np.random.default_rng(0).random(len(mesh.faces)) > 0.2)
    mesh.export(tmp_path / "holes.ply")
    prior = prior_from_mesh(tmp_path / "holes.ply", PriorSettings(gaussians=200, backing=0))
    assert len(prior.points) == 200
