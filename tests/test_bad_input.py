"""Bad input through the real command line: one line that says what is wrong, exit code 2, nothing
left over. Each check is tried by one command."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic
import tiny
from PIL import Image
from refusals import refused
from test_recordings import halved

from mgs.camera import look_at
from mgs.data.clouds import SparseCloud, write_cloud
from mgs.data.dataset import load_dataset, write_transforms
from mgs.images import write_exr, write_png

Change = Callable[[Path], object]


def edit(change: Callable[[dict], object], *name: str) -> Change:
    return lambda root: synthetic.edit(root, change, *name)


def header(**values) -> Change:
    return edit(lambda data: data.update(values))


def frame(number=2, **values) -> Change:
    return edit(lambda data: data["frames"][number].update(values))


def text(name: str, content: str) -> Change:
    return lambda root: (root / name).write_text(content)


def truncate(name: str) -> Change:
    """Cut a file in half, as a full disk does."""
    return lambda root: halved(root / name)


def remove(name: str) -> Change:
    return lambda root: (root / name).unlink()


def without_images(root):
    shutil.rmtree(root / "images")


def corrupt_jpeg(root: Path) -> None:
    """The header is whole, the pixels are cut off."""
    jpeg = root / "images/kf_0000.jpg"
    Image.open(root / "images/kf_0000.png").save(jpeg, quality=95)
    jpeg.write_bytes(jpeg.read_bytes()[:-500])
    frame(0, file_path="images/kf_0000.jpg")(root)


def model_without(*names: str) -> Change:
    """Photographs beside a COLMAP model that lacks files."""

    def apply(root: Path) -> None:
        synthetic.write_colmap(synthetic.write_dataset(root, depth=False), root / "colmap", True)
        for name in names:
            remove(f"colmap/sparse/0/{name}.bin")(root)

    return apply


def only_tests(root: Path) -> None:
    (root / "transforms.json").rename(root / "transforms_test.json")


def scanned(root: Path) -> None:
    """Pictures of another program with a matrix for each, as of ScanNet."""
    (root / "transforms.json").unlink()
    (root / "pose").mkdir()
    np.savetxt(root / "pose/0.txt", np.eye(4))


def points_in_one_place(root: Path) -> None:
    write_cloud(root / "points.ply", SparseCloud(np.ones((500, 3))))
    header(ply_file_path="points.ply")(root)


def every(key: str, make: Callable[[Path], object]) -> Change:
    """Write the files of all frames anew. key: field of a frame that has the path."""
    return lambda root: [make(getattr(frame, key)) for frame in load_dataset(root).frames]


def frames(change: Callable[[list], list]) -> Change:
    """Write transforms.json with other frames."""
    return lambda root: write_transforms(root, change(list(load_dataset(root).frames)))


def photographs(count: int = 10) -> Change:
    """Frames without depth."""
    cameras = synthetic.orbit_cameras(count, 64, 48)
    return lambda root: synthetic.write_dataset(root, cameras, depth=False)


def apart(root: Path) -> None:
    """Every camera looks away from what the others look at."""
    made = []
    for k, one in enumerate(synthetic.write_dataset(root, depth=False).frames):
        pose = look_at([10.0 * k, 0, 1], [10.0 * k, 1, 1 + 0.1 * (-1) ** k])
        made.append(replace(one, camera=replace(one.camera, world_to_camera=pose)))
    write_transforms(root, made)


def bare(root: Path) -> None:
    """Photographs of bare ground: no masks, no depth."""
    cameras = synthetic.orbit_cameras(10, 64, 48)
    dataset = synthetic.write_dataset(root, cameras, rocks=[], depth=False)
    write_transforms(root, [replace(frame, mask_path=None) for frame in dataset.frames])


def no_object(root: Path) -> None:
    """Bare ground with points on it."""
    bare(root)
    ground = np.column_stack([np.random.default_rng(0).uniform(-2, 2, (3000, 2)), np.zeros(3000)])
    write_cloud(root / "sparse.ply", SparseCloud(ground))


def millimetres(root: Path) -> None:
    mesh = synthetic.rock_mesh()
    mesh.vertices *= 1000
    mesh.export(root / "mm.ply")


def nothing(root: Path) -> None:
    pass


FAR = [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
DUST = "[rock]\ndetail = 0.1\nburied = 0.999\n[orbit]\naltitude = 0\n[arena]\nstones = 0"
BLACK, ZEROS = np.zeros((48, 64), bool), {"Z": np.zeros((48, 64))}
BUILD, PRIOR = "prior {d} --gaussians 300", "nbv {d} --out {out} --prior {d}/prior --budget 1"
ROWS: dict[tuple[Change, str], list[tuple[str, Change]]] = {
    (tiny.write_dataset, "nbv {d} --out {out}"): [
        ("holds no transforms.json; make", remove("transforms.json")),
        ("no frames", text("transforms.json", "[1, 2]")),
        ("frame 2", frame(transform_matrix=[["a"] * 4] * 4)),
        ("not a finite 4x4", frame(transform_matrix=[[float("nan")] * 4] * 4)),
        ("singular", frame(transform_matrix=np.diag([1, 1, 0, 1]).tolist())),
        ("entries beyond 1e+08", frame(transform_matrix=FAR)),
        ("frame 2 lacks", edit(lambda data: data["frames"][2].pop("transform_matrix"))),
        ("intrinsics", edit(lambda data: data.pop("fl_x"))),
        ("image size", header(w=0)),
        ("focal lengths", header(fl_x=-1)),
        ("does not exist", frame(file_path="images/none.png")),
        ("must be whole pixels", header(w=16.5)),
        ("must be whole pixels", header(w=float("inf"))),
        ("frame 0", header(fl_x=float("inf"))),
        ("mgs import", frame(p2=-1e-3)),
        ("mgs import", header(camera_model="OPENCV_FISHEYE")),
        ("kf_0000", frame(file_path="images/../images/kf_0000.png")),
        ("frame 2", frame(file_path="a\0b")),
        ("mask_path", frame(mask_path=["a"])),
        ("timestamp", frame(timestamp="noon")),
        ("kf_0003.exr", remove("depth/kf_0003.exr")),
    ],
    (lambda d: tiny.write_prior(tiny.write_dataset(d) / "prior"), PRIOR): [
        ("mgs prior", lambda root: shutil.rmtree(root / "prior")),
        ("prior.json", truncate("prior/prior.json")),
        ("must be positive metres", edit(lambda data: data.update(spacing=-1), "prior/prior.json")),
        ("numbers of the", edit(lambda d: d.update(triangulated="x"), "prior/prior.json")),
    ],
    (Path.mkdir, "synth-orbit {out} --frames 1 --size 16x12 --scene {d}/a.toml"): [
        ("centre, radii", text("a.toml", "[[rock.lobes]]\nradius = 1")),
        ("rock.detail", text("a.toml", "[rock]\ndetail = 2")),
        ("rock.detail", text("a.toml", "[rock]\ndetail = 1e-9")),
        ("rock.facets", text("a.toml", "[rock]\nfacets = 1000000000000")),
        ("rock.layers", text("a.toml", f"[rock]\nlayers = {10**400}")),
        ("arena.stones", text("a.toml", "[arena]\nstones = 1000000000000")),
        ("altitude", text("a.toml", DUST)),
        ("rock.size", text("a.toml", "[rock]\nsize = -1")),
        ("not valid TOML", text("a.toml", "[rock")),
        ("sky.turbidity", text("a.toml", "[sky]\nturbidity = nan")),
    ],
    (synthetic.write_dataset, "import {d} --out {out}"): [
        ("no such file or folder", shutil.rmtree),
        ("no usable intrinsics", edit(lambda d: (d.pop("fl_x"), d.update(camera_angle_x=0)))),
        ("not supported", header(camera_model="EQUIRECTANGULAR")),
        ("has k4", header(k4=0.1)),
        ("not finite", header(k1=float("nan"))),
        *[("the distortion", header(k1=k1)) for k1 in (-1e6, -5, 1e6)],
        ("more than once", frame(0, file_path="images/kf_0001.png")),
        ("is 64x48, but its camera is 100x48; give pictures, masks and depth of", header(w=100)),
        ("no such EXR", frame(0, depth_file_path="depth/none.exr")),
        ("depth_unit", header(depth_unit_scale_factor="mm")),
        ("up: must be three finite numbers", header(up="skyward")),
        ("none of the 8 images it lists exists, as images/kf_0000", without_images),
        ("kf_0000.jpg: not a readable image", corrupt_jpeg),
        ("points.ply: has values that are not finite", points_in_one_place),
    ],
    (synthetic.write_dataset, "import {d} --images {d}/none --out {out}"): [
        ("none: no such folder", nothing)
    ],
    (lambda d: d.symlink_to(d), "import {d} --out {out}"): [("no such file or folder", nothing)],
    (Path.mkdir, "suggest {d}"): [("d: holds no transforms.json; make", nothing)],
    (synthetic.write_dataset, "import {d} --out /"): [("/: is there already", nothing)],
    (synthetic.write_dataset, "import {d}/a.zip --out {out}"): [
        ("a.zip: is no file that can be imported", text("a.zip", "PK"))
    ],
    (synthetic.write_dataset, "import {d} --exclude kf_0000 --out {out}"): [
        ("exclude leaves no image", frames(lambda all: all[:1])),
        ("transforms_test.json: its poses would be ignored", only_tests),
        ("pose/0.txt: its poses would be ignored; give its folder", scanned),
    ],
    **{
        (lambda d: synthetic.write_dataset(d / "deep"), words): [
            ("deep/transforms.json: its poses would be ignored", nothing)
        ]
        for words in ("import {d} --out {out}", "suggest {d}")
    },
    (nothing, "import {d}/colmap --out {out}"): [
        ("sparse/0: a COLMAP model without points3D.bin; restore it", model_without("points3D")),
        ("without cameras.bin and images.bin", model_without("images", "cameras")),
    ],
    (synthetic.write_dataset, "import {d}/images --out {out}"): [("can be placed", nothing)],
    **{
        (synthetic.write_dataset, f"import {{d}}/{words} --out {{out}}"): [(said, nothing)]
        for words, said in {
            " --pose /slam": "is no ROS bag, so it has no topic /slam; leave out --pose",
            "images --pose /slam": "is no ROS bag, so it has no topic /slam; leave out --pose",
            "images --refine-poses": "its pictures come without poses",
            " --keyframes 2s": "is no recording or video, and all images are taken; leave out",
        }.items()
    },
    (synthetic.write_dataset, "import {d}/film.mp4 --out {out} --refine-poses"): [
        ("its pictures come without poses", text("film.mp4", ""))
    ],
    (synthetic.write_dataset, "import {d}/images --out {d}/images/e/f"): [
        ("images: the output would lie among its photographs", nothing)
    ],
    (synthetic.write_dataset, "import {d} --out {d}/images --force"): [
        ("kf_0000.png is in it and is read", nothing)
    ],
    (synthetic.write_dataset, "import {d} --out {out} --masks {d}/masks"): [
        ("is 32x26", lambda d: write_png(d / "masks/kf_0000.png", np.ones((26, 32), bool)))
    ],
    (synthetic.write_dataset, "import {d} --out {out} --masks b --mesh a"): [("one of", nothing)],
    (synthetic.write_dataset, "import {d} --out {out} --mesh {d}/mm.ply"): [
        ("the mesh is in no picture", millimetres),
        ("mm.ply", nothing),
    ],
    (synthetic.write_dataset, "prior {d} --mesh {d}/mm.ply"): [
        ("the mesh is in no picture", millimetres),
        ("mm.ply", nothing),
    ],
    (synthetic.write_dataset, "prior {d}"): [
        ("masks are black in every frame", every("mask_path", lambda p: write_png(p, BLACK))),
        ("no depth image has a return", every("depth_path", lambda p: write_exr(p, ZEROS))),
        ("is 10x10", lambda d: write_exr(d / "depth/kf_0003.exr", {"Z": np.ones((10, 10))})),
    ],
    (lambda d: synthetic.write_dataset(d, rocks=[]), "prior {d}"): [("no rock", nothing)],
    (nothing, BUILD): [
        ("too few photographs without depth, 7; take at least 8", photographs(7)),
        ("the photographs are not of one object", apart),
        ("points lie in one cluster above the ground; give masks", no_object),
    ],
    (bare, f"{BUILD} --source random --poisson-depth 6"): [("has no surface", nothing)],
    (bare, f"{BUILD} --source hull"): [("has no masks; ", nothing)],
    (synthetic.write_dataset, f"{BUILD} --source depth"): [
        ("has frames without depth images", frame(0, depth_file_path=None))
    ],
    (photographs(), f"{BUILD} --source depth"): [
        ("has frames without depth images; take the", nothing)
    ],
    (synthetic.write_dataset, "survey {d}"): [
        ("too few for a survey", frames(lambda all: all[:2])),
        ("depth_file_path", frames(lambda all: [replace(one, depth_path=None) for one in all])),
        ("cannot be registered", lambda d: write_exr(d / "depth/kf_0002.exr", ZEROS)),
    ],
}
"""World and command -> words of the line, and what is wrong with the world."""
CASES = [(*to, *row) for to, rows in ROWS.items() for row in rows]
IDS = [f"{command.split()[0]}: {words}" for _, command, words, _ in CASES]


@pytest.mark.parametrize(("world", "command", "words", "change"), CASES, ids=IDS)
@pytest.mark.usefixtures("coarse_arena", "coarse_priors")
def test_bad_input_is_one_line_and_leaves_nothing(capsys, tmp_path, world, command, words, change):
    world(tmp_path / "d")
    change(tmp_path / "d")
    given = command.format(d=tmp_path / "d", out=tmp_path / "out").split()
    # Of a cloud without an object, a picture is left.
    kept = tmp_path / "d/prior" if change is no_object else tmp_path
    assert words in refused(capsys, given, kept)


def test_broken_pixels(capsys, dataset, prior, tmp_path):
    (dataset / "images/kf_0000.png").write_text("no pixels")
    arguments = ["nbv", dataset, "--out", tmp_path / "out", "--prior", prior, "--budget", 1]
    assert "kf_0000.png" in refused(capsys, arguments)
    assert not (tmp_path / "out/steps.jsonl").exists()


@pytest.mark.parametrize(
    "command", [["nbv", "--resume"], ["eval"], ["diagnose"], ["simplify"], ["view"]]
)
def test_broken_run(capsys, dataset, prior, tmp_path, command):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    dataset.rename(tmp_path / "elsewhere")
    assert "correct `dataset`" in refused(capsys, [*command, run], run)
    (tmp_path / "elsewhere").rename(dataset)
    truncate("checkpoint.npz")(run)
    assert "checkpoint.npz" in refused(capsys, [*command, run], run)
