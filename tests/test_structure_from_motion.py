"""Points triangulated at given poses, and poses of photographs alone, against the truth."""

import os
import shutil
import subprocess
import sys
from contextlib import closing, suppress
from dataclasses import replace
from itertools import combinations, pairwise
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest
import synthetic
from PIL import ExifTags, Image
from program import command, exit_code, output, python, said, stop_at
from refusals import fails, refused
from scipy.ndimage import map_coordinates

from mgs import Camera, Frame, InputError, build_prior
from mgs.cli.suggest import _place
from mgs.data import photographs
from mgs.data.clouds import read_cloud
from mgs.data.colmap import image_count
from mgs.data.dataset import load_dataset, write_transforms
from mgs.data.importers import import_source
from mgs.data.on_site import dataset_at
from mgs.data.photographs import sharpest_frames
from mgs.data.shots import Spacing
from mgs.data.sources import read_source
from mgs.data.structure import Matcher
from mgs.errors import Notice
from mgs.files import read_json, write_json
from mgs.fit.poses import displaced, motion_between
from mgs.images import read_depth, write_exr, write_png
from mgs.prior.photographs import check_photographs
from mgs.progress import listening

pytestmark = pytest.mark.usefixtures("features_once")
WIDTH, HEIGHT = 320, 240


def views(root, cameras, seed=0):
    """Frames that show the rock and its ground, with a texture of noise."""
    rng, frames = np.random.default_rng(seed), []
    noise = [rng.random((40, 40, 40)) for _ in range(2)]
    for k, camera in enumerate(cameras):
        depth, _, points = synthetic.cast(camera, [(synthetic.CENTRE, synthetic.AXES)])
        grey = sum(
            map_coordinates(grid, step * points.reshape(-1, 3).T, order=1, mode="grid-wrap")
            for grid, step in zip(noise, (8, 25), strict=True)
        ).reshape(depth.shape)
        path = root / f"images/view {k:02d}.png"
        pixels = np.where(depth > 0, grey / 2, 0)
        write_png(path, np.repeat(pixels[..., None], 3, -1).astype(np.float32), linear=False)
        frames.append(Frame(path.stem, camera, float(k), path))
    return frames


def arc(count, step=8.0):
    """Cameras on an arc about the rock, `step` degrees apart, at two heights."""
    angles = np.radians(step * np.arange(count))
    eyes = [[2.6 * np.cos(a), 2.6 * np.sin(a), 1.2 + 0.4 * (k % 2)] for k, a in enumerate(angles)]
    lens = 1.1 * WIDTH, WIDTH, HEIGHT
    return [synthetic.pinhole(*lens, eye, synthetic.CENTRE) for eye in eyes]


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return views(tmp_path_factory.mktemp("views"), arc(9))


def distances(points):
    """Distance of each point [N,3] from the ground or the rock."""
    return np.minimum(np.abs(points[:, 2]), np.abs(synthetic.level(points)) * synthetic.AXES.min())


def test_poses_without_points_get_those_of_the_pictures_of_the_source(frames, tmp_path, capsys):
    root, found = frames[0].image_path.parent.parent, []
    write_transforms(root, frames[::-1])
    for downscale in (1, 4):
        out = tmp_path / f"{downscale}"
        command("import", root, "--out", out, "--downscale", downscale)
        printed, warned = said(capsys)
        assert "points with a reprojection error of 0." in printed
        assert "a little wrong" not in warned
        found.append(read_cloud(out / "sparse.ply").points)
    assert np.array_equal(*found)
    assert len(found[0]) > 500
    assert np.median(distances(found[0])) < 0.005


def test_noisy_poses_are_adjusted_to_the_pictures(frames, tmp_path, capsys, monkeypatch):
    """Noise of 0.25 degrees and 6 mm about each axis: turns between neighbours become right. Where
    it was interrupted between test views and others, it begins with the given poses again."""
    rng, std = np.random.default_rng(0), [np.radians(0.25)] * 3 + [0.0065] * 3
    noisy = [replace(f, camera=displaced(f.camera, rng.normal(0, std))) for f in frames]
    root = frames[0].image_path.parent.parent
    write_transforms(root, noisy)
    options = ["--refine-poses", "--up", "0,0,1", "--test-every", "4"]
    command("import", root, "--out", tmp_path / "whole", *options)
    assert "given poses compared" in said(capsys)[0]

    def written_and_stopped(*arguments):
        write_transforms(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("mgs.data.structure.write_transforms", written_and_stopped)
        assert exit_code("import", root, "--out", tmp_path / "d", *options) == 130
    for words in ("poses moved 0.", "is finished already"):
        assert words in output(capsys, "import", root, "--out", tmp_path / "d", *options)
    for name in ("transforms.json", "test/transforms.json", "sparse.ply"):
        assert (tmp_path / "d" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    data = load_dataset(tmp_path / "d")
    after = sorted([*data.frames, *data.test_views().frames], key=lambda frame: frame.name)

    def error(views):
        """Mean turn from the truth, degrees, of each camera in the axes of the one before."""
        both = pairwise(frames), pairwise(views)
        steps = [[motion_between(a.camera, b.camera)[:3] for a, b in pairs] for pairs in both]
        return np.degrees(np.linalg.norm(np.subtract(*steps), axis=1)).mean()

    assert error(noisy) > 0.4
    assert error(after) < 0.1


@pytest.mark.parametrize(("downscale", "size"), [(1, 1.0), (2, 0.6)])
def test_poses_that_are_a_little_wrong_are_named(downscale, size, frames, tmp_path, capsys):
    """Also where their error is under a pixel of pictures that are reduced."""
    rng, root = np.random.default_rng(0), frames[0].image_path.parent.parent
    noise = size * rng.normal(0, [0.01] * 3 + [0.02] * 3, (len(frames), 6))
    noisy = [replace(f, camera=displaced(f.camera, n)) for f, n in zip(frames, noise, strict=True)]
    write_transforms(root, noisy)
    command("import", root, "--out", tmp_path / "d", "--downscale", downscale)
    assert "--refine-poses adjusts them" in said(capsys)[1]


def test_a_survey_that_looks_at_no_one_place_starts_from_its_points(tmp_path):
    K = np.array([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]])
    down = np.diag([1.0, -1, -1, 1])
    eyes = [[0.3 * k - 1.7, 0.7 * (k % 2), 1.5] for k in range(12)]
    poses = [down @ np.block([[np.eye(3), -np.array([eye]).T], [0, 0, 0, 1]]) for eye in eyes]
    frames = views(tmp_path / "s", [Camera(K, WIDTH, HEIGHT, pose) for pose in poses])
    write_transforms(tmp_path / "s", frames)
    command("import", tmp_path / "s", "--out", tmp_path / "d", "--up", "0,0,1")
    with pytest.raises(InputError, match=r"not of one object.*a whole scene is fitted"):
        check_photographs(load_dataset(tmp_path / "d").frames, "is fitted")
    prior = build_prior(tmp_path / "d", source="random")
    assert prior.numbers["triangulated"] > 200
    assert np.median(distances(prior.points[: prior.numbers["triangulated"]])) < 0.01


def test_wrong_poses_get_no_points(frames, tmp_path, capsys):
    root = frames[0].image_path.parent.parent
    shuffled = [frames[(4 * k) % 9].camera for k in range(9)]
    write_transforms(root, [replace(f, camera=c) for f, c in zip(frames, shuffled, strict=True)])
    command("import", root, "--out", tmp_path / "d")
    assert "do not belong to these pictures" in said(capsys)[1]
    assert not (tmp_path / "d/sparse.ply").exists()


def test_pictures_without_texture_get_no_points(tmp_path):
    frames = synthetic.write_dataset(tmp_path / "plain", depth=False).frames
    write_transforms(tmp_path / "plain", [replace(frame, mask_path=None) for frame in frames])
    command("import", tmp_path / "plain", "--out", tmp_path / "d")
    assert not (tmp_path / "d/sparse.ply").exists()
    assert len(load_dataset(tmp_path / "d")) == len(frames)


@pytest.fixture(scope="module")
def placed(frames, tmp_path_factory):
    """Import of the same pictures as JPEG without poses: one lies on its side and says so in its
    EXIF, all have GPS, and there are a copy, a PNG of one, a blank one and one that is cut off."""
    root = tmp_path_factory.mktemp("photographs") / "photos"
    root.mkdir()
    for k, frame in enumerate(frames):
        image = Image.open(frame.image_path)
        exif = image.getexif()
        east, north, up = frame.camera.position
        gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
        gps.update({1: "N", 2: degrees(48 + north / 111_320), 3: "E", 5: b"\0", 6: float(up + 10)})
        gps[4] = degrees(11 + east / (111_320 * np.cos(np.radians(48))))
        if k == 3:
            exif[ExifTags.Base.Orientation] = 6
            image = image.transpose(Image.Transpose.ROTATE_90)
        image.save(root / f"{frame.name}.jpg", exif=exif, quality=98)
    shutil.copy(root / "view 00.jpg", root / "z copy.jpg")
    shutil.copy(frames[1].image_path, root / "view 01.png")
    Image.new("RGB", (WIDTH, HEIGHT), "grey").save(root / "blank.jpg")
    whole = (root / "view 01.jpg").read_bytes()
    for name, part in {"cut off": whole[:100], "half": whole[: len(whole) // 2]}.items():
        (root / f"{name}.jpg").write_bytes(part)
    (root / "phone.heic").write_bytes(bytes(100))
    source = read_source(root, unpack=root.parent / "again")
    return import_source(read_source(root), root.parent / "d"), source


def degrees(value):
    """Degrees, minutes and seconds of EXIF."""
    minutes = 60 * (value % 1)
    return (float(int(value)), float(int(minutes)), 60 * (minutes % 1))


def test_photographs_alone_get_their_poses_in_metres(frames, placed):
    found, source = placed
    true = {frame.name: frame.camera for frame in frames}
    assert sorted(frame.name for frame in found.frames) == sorted(true)
    assert (source.unit, source.up) == ("m", (0, 0, 1))
    offsets, angles, place = [], [], _place(found.root)
    for frame, again in zip(found.frames, source.shots, strict=True):
        ours, camera = frame.camera, true[frame.name]
        east, north, _ = camera.position
        latitude, longitude, _ = place.geodetic(ours.position)
        assert 111_320 * (latitude - 48) == pytest.approx(north, abs=0.1)
        assert 111_320 * np.cos(np.radians(48)) * (longitude - 11) == pytest.approx(east, abs=0.1)
        offsets.append(ours.position - camera.position)
        angles.append(np.degrees(np.linalg.norm(motion_between(ours, camera)[:3])))
        poses = ours.world_to_camera, again.camera.world_to_camera
        assert np.allclose(*poses, atol=1e-9, rtol=0), "they do not repeat"
    assert np.median(np.linalg.norm(offsets - np.mean(offsets, axis=0), axis=1)) < 0.03
    assert np.median(angles) < 0.5


def test_photographs_that_are_left_out_are_named_with_the_reason(placed):
    assert sum(placed[1].left_out.values()) == 6
    notes = " ".join(placed[1].notes)
    for names, why in {
        "view 01.png, z copy.jpg": "with the content or name of another",
        "blank.jpg": "blurred or blank",
        "cut off.jpg, half.jpg": "not readable: damaged, or neither grey nor RGB",
        "phone.heic": "in HEIC or a raw format: convert to JPEG",
    }.items():
        assert f"{names}, {why}" in notes


def test_photographs_of_one_name_or_none_are_left_out(frames, tmp_path):
    paths = [tmp_path / name for name in ("a/1.png", "a_1.png", "b\n.png")]
    for frame, path in zip(frames, paths, strict=False):
        path.parent.mkdir(exist_ok=True)
        shutil.copy(frame.image_path, path)
    usable, dropped = photographs._usable(tmp_path, paths)
    assert (usable, [*dropped]) == (paths[:1], ["a_1.png", r"'b\n.png'"])


def test_depth_among_photographs_is_left_out_and_its_place_is_named(frames, tmp_path):
    paths = [frame.image_path for frame in frames[:3]]
    deep = [paths[0].parent / f"depth_{k}.png" for k in range(2)]
    for k, path in enumerate(deep):
        write_png(path, np.full((4, 4), 1000 + k, np.uint16))
    usable, dropped = photographs._usable(paths[0].parent, [*paths, *deep])
    alone = photographs._usable(paths[0].parent, deep)
    for path in deep:
        path.unlink()
    assert (usable, [*dropped]) == (paths, [path.name for path in deep])
    assert "its place is a folder `depth`" in dropped["depth_0.png"]
    assert alone == (deep, {})  # photographs may be grey, of 16 bits


def test_neighbours_by_gps_are_matched(frames, placed, monkeypatch):
    """A blank picture, the first by name, has none."""
    monkeypatch.setattr(photographs, "NEAR", 2)
    folder = placed[0].root.parent / "again/matches"
    names = [f"{k:06d}.jpg" for k in range(10)]
    pairs = photographs._near_by_gps(SimpleNamespace(database=folder / "database.db", names=names))
    eyes = np.stack([frame.camera.position for frame in frames])
    apart = np.linalg.norm(eyes[:, None] - eyes, axis=2)
    ones, others = np.transpose(pairs) - 1
    assert np.allclose(apart[ones, others], np.sort(apart)[:, 1:3].ravel(), atol=0.01)


def test_a_distance_gives_the_scale(placed):
    scaled = placed[1].with_distance("view 00.jpg, view 06.jpg, 10")
    eyes = {shot.name: shot.camera.position for shot in scaled.shots}
    assert np.linalg.norm(eyes["view 00"] - eyes["view 06"]) == pytest.approx(10)
    for wrong in ("view 00.jpg,10", "view 00.jpg,other,10", "view 00.jpg,view 01.jpg,0"):
        fails("distance", placed[1].with_distance, wrong)
    for far in ("1e300", "1e-300"):
        fails("expected METRES from", placed[1].with_distance, f"view 00,view 06,{far}")


def write_depth(frames, folder, change=lambda z, k: z):
    """Depth images in turn as EXR and as PNG of half the sides, the one that lies on its side as
    its picture does."""
    shutil.rmtree(folder, ignore_errors=True)
    for k, frame in enumerate(frames):
        depth = change(synthetic.cast(frame.camera, [(synthetic.CENTRE, synthetic.AXES)])[0], k)
        depth = np.rot90(depth) if k == 3 else depth
        if k % 2:
            write_png(folder / f"{frame.name}.png", np.uint16(1000 * depth[1::2, 1::2]))
        else:
            write_exr(folder / f"{frame.name}.exr", {"Z": depth})


@pytest.fixture
def deep(placed, monkeypatch):
    """read(**options): the photographs of `placed` again, as if without GPS unless asked, and the
    folder of their depth."""
    root = placed[0].root.parent / "photos"

    def read(gps=False, **options):
        with monkeypatch.context() as patched:
            patched.setattr("pycolmap.extract_features", stop_at())
            if not gps:
                patched.setattr(photographs, "_to_gps", lambda *_: None)
            return read_source(root, unpack=root.parent / "again", **options)

    yield read, root / "depth"
    shutil.rmtree(root / "depth", ignore_errors=True)


@pytest.mark.parametrize("given", ["", "GPS", "--distance", "--unit"])
def test_depth_beside_photographs_gives_the_scale_or_is_made_to_fit(given, frames, deep, tmp_path):
    """One photograph has no depth; pictures are as without any."""
    read, folder = deep
    write_depth(frames[:-1], folder, lambda z, k: 1.05 * z if given == "GPS" else z)
    options = {"--distance": {"distance": "view 00,view 06,10"}, "--unit": {"unit": 3}}
    source = read(given == "GPS", **options.get(given, {}))
    assert (source.unit, len(source.shots)) == ("m", 9)
    eyes = [{s.name: s.camera.position for s in each}["view 06"] for each in (source.shots, frames)]
    firsts = [each[0].camera.position for each in (source.shots, frames)]
    ours, true = (np.linalg.norm(one - two) for one, two in zip(eyes, firsts, strict=True))
    assert given or ours == pytest.approx(true, rel=0.01)
    note, factor = source.notes[-1], source.shots[0].depth_factor
    if given:
        assert note.startswith(f"{given} gives the scale; the depth of 8 photographs is multiplied")
        assert f"by {factor:.4g} " in note
        assert factor == pytest.approx(ours / true / (1.05 if given == "GPS" else 1), rel=0.01)
    else:
        assert "m per unit from the depth of 8 photographs, spread 0." in note
    data = import_source(source, tmp_path / "d")
    assert [bool(frame.depth_path) for frame in data.frames] == [True] * 8 + [False]
    points = read_cloud(data.root / "sparse.ply").points
    for k, frame in enumerate(data.frames[:-1]):
        pixels, z = data.world.leave(frame.camera).project(points)
        column, row = pixels.astype(int).T
        depth = frame.depth()
        inside = (pixels > 0).all(1) & (column < WIDTH) & (row < HEIGHT)
        measured = depth[row[inside], column[inside]]
        assert np.median(np.abs(measured / z[inside] - 1)) < 0.01
        if not k:  # never blended
            kept = factor * read_depth(source.shots[k].depth)
            assert np.isin(depth, kept.astype(np.float32)).all()


@pytest.mark.parametrize("fault", ["of each its own", "inverse", "flat", "few"])
def test_depth_that_gives_no_scale_is_left_out_with_the_reason(fault, frames, deep):
    changes = {
        "of each its own": lambda z, k: z * 1.3**k,
        "inverse": lambda z, k: 3 / np.where(z > 0, z, np.inf),
        "flat": lambda z, k: z**0.3,
        "few": lambda z, k: np.where(np.arange(len(z)) < 9, z.T, 0).T,
    }
    write_depth(frames, deep[1], changes[fault])
    source = deep[0]()
    assert (source.unit, source.depth_scale) == (None, None)
    assert not any(shot.depth for shot in source.shots)
    why = "a scale needs 100" if fault == "few" else "it contradicts the distance of their points"
    assert "depth of 9 photographs is left out: " in source.notes[-1]
    assert why in source.notes[-1]
    assert fault == "few" or "give z-depth aligned with the photographs" in source.notes[-1]
    assert fault != "flat" or "(spread 6 %)" in source.notes[-1]


def test_depth_beside_photographs_on_site_is_used(frames, tmp_path):
    write_depth(frames[:3], tmp_path / "photos/depth")
    for frame in frames[:3]:
        shutil.copy(frame.image_path, tmp_path / "photos")
    data, notes = dataset_at(tmp_path / "photos", tmp_path / "site")
    assert "from the depth of 3 photographs" in notes[-1]
    assert data.unit == "m"
    assert all(frame.depth_path for frame in data.frames)


def test_depth_of_other_names_or_kinds_is_refused_before_photographs_are_placed(frames, deep):
    read, folder = deep
    folder.mkdir()
    write_png(folder / "0.png", np.ones((HEIGHT, WIDTH), np.uint16))
    fails("none of its 1 depth images has the name of a photograph, as blank.png", read)
    (folder / "0.png").unlink()
    write_png(folder / "view 04.png", np.ones((HEIGHT, WIDTH), bool))
    fails("view 04.png: a picture of 8 bits is no depth", read)


@pytest.mark.parametrize("case", ["one", "apart", "file", "none", "tripod"])
def test_photographs_that_cannot_be_placed_are_refused(case, frames, tmp_path, capsys):
    root = tmp_path / "photos"
    root.mkdir()
    picked = {"one": frames[:1], "file": frames[:1], "apart": frames[::5]}.get(case, [])
    for frame in picked:
        shutil.copy(frame.image_path, root)
    for quality in range(80, 84) if case == "tripod" else ():
        Image.open(frames[0].image_path).save(root / f"{quality}.jpg", quality=quality)
    if case == "apart":
        noise = np.random.default_rng(1).random((2, HEIGHT, WIDTH, 3)).astype(np.float32)
        for k, pixels in enumerate(noise):
            write_png(root / f"noise{k}.png", pixels)
    source = root / frames[0].image_path.name if case == "file" else root
    assert exit_code("import", source, "--out", tmp_path / "d") == 2
    words = {"one": "1 can be used", "apart": "can be placed", "file": "the folder of all"}
    words |= {"tripod": "all taken from one place", "none": "holds no photographs"}
    assert words[case] in said(capsys)[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos"]


def test_a_video_gives_the_sharpest_frames_up_to_where_it_ends(tmp_path):
    """Cut a copy at 60 % of 24 frames at 10 a second, of which the last of each five is sharp."""
    rng, whole = np.random.default_rng(0), tmp_path / "whole.avi"
    level = cv2.utils.logging.getLogLevel()
    film = cv2.VideoWriter(str(whole), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for k in range(24):
        film.write(rng.integers(0, 255 if k % 5 == 4 else 120, (48, 64, 3), np.uint8))
    film.release()
    spacing = Spacing.parse("0.5s")
    paths = sharpest_frames(whole, tmp_path / "whole", spacing)
    assert len(paths) == 5
    assert all(np.ptp(Image.open(path)) > 200 for path in paths[:4])
    part = whole.read_bytes()
    (tmp_path / "cut.avi").write_bytes(part[: len(part) * 3 // 5])
    with pytest.warns(Notice, match="only 1[2-5] of 24 frames can be read"):
        found = sharpest_frames(tmp_path / "cut.avi", tmp_path / "cut", spacing)
    assert cv2.utils.logging.getLogLevel() == level
    for one, other in zip(found[:2], paths, strict=False):
        assert one.read_bytes() == other.read_bytes()
    for name, words in (("whole", "its 24 frames"), ("cut", "1[2-5] of 24 frames can be read")):
        video, few = tmp_path / f"{name}.avi", tmp_path / "few"
        fails(f"{words}.* under 3", sharpest_frames, video, few, Spacing(1.2, False))
    (tmp_path / "no.mp4").write_bytes(b"no video")
    words = [sys.executable, "-m", "mgs", "import", tmp_path / "no.mp4", "--out", tmp_path / "d"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "not a readable video" in done.stderr


def test_an_interrupted_import_keeps_its_matches(frames, tmp_path, capsys, monkeypatch):
    """So does one that is refused then, and one that is refused after the photographs are placed. A
    finished one places none again, and names what differs. What is made of large images is
    said before it is written."""
    root = frames[0].image_path.parent
    out, matches = tmp_path / "d", tmp_path / "d.unpacked/matches/database.db"
    with monkeypatch.context() as patched:
        patched.setattr("pycolmap.incremental_mapping", stop_at())
        assert exit_code("import", root, "--out", out) == 130
    written = matches.stat().st_size
    assert written > 100_000
    monkeypatch.setattr("pycolmap.extract_features", stop_at())
    for wrong in (["--exclude", "other"], ["--distance", "view 00,other,2"]):
        assert exit_code("import", root, "--out", out, *wrong) == 2
        assert "other" in said(capsys)[1]
    monkeypatch.setattr("pycolmap.incremental_mapping", stop_at())
    monkeypatch.setattr("mgs.data.importers.MOST_PIXELS", WIDTH * HEIGHT // 3)
    with monkeypatch.context() as patched:
        patched.setattr("mgs.data.importers.write_png", stop_at())
        unmasked = ["import", root, "--out", out, "--masks", matches.parent]
        assert "no mask for image" in refused(capsys, unmasked)
        assert exit_code("import", root, "--out", out) == 130
        assert "are written at 1/2 of their sides; downscale 1 keeps them" in said(capsys)[1]
    command("import", root, "--out", out)
    assert len(load_dataset(out)) == len(frames)
    assert not (tmp_path / "d.unpacked").exists()
    words = [sys.executable, "-m", "mgs", "import", root, "--out", out]  # also in another process
    done = subprocess.run(words, capture_output=True, text=True)
    cure = "--force makes it again, and places all photographs again"
    assert done.stdout == f"{out} is finished already; {cure}\n"
    again = ["import", os.path.relpath(root), "--out", out, "--up", "auto", "--downscale", "2"]
    assert "is finished already" in output(capsys, *again)
    options = ["--up", "0,0,1"], ["--masks", root], ["--refine-poses"], ["--downscale", "1"]
    for words in options:
        assert f"finished with another {words[0]}; {cure}" in refused(
            capsys, [*again[:4], *words], out
        )
    shutil.copytree(root, tmp_path / "other")
    assert "another source" in refused(capsys, ["import", tmp_path / "other", *again[2:]], out)
    record = read_json(out / "import.json")
    masked = record["options"] | {"masks": "elsewhere"}
    write_json(out / "import.json", record | {"options": masked})
    assert "another --masks" in refused(capsys, again, out)
    write_json(out / "import.json", record | {"options": {}})  # of another version: unknown
    assert "is finished already" in output(capsys, *again, "--up", "0,0,1")


def test_placing_continues_from_its_largest_whole_state(frames, tmp_path, monkeypatch):
    """Unless it is of under half the photographs."""
    monkeypatch.setattr(photographs, "STEP", 2)
    matcher = Matcher([frame.image_path for frame in frames], tmp_path / "m")
    matcher.match(combinations(range(9), 2))
    states = tmp_path / "m" / photographs.STATES

    def placing(count, stop=99):
        """Numbers of photographs placed that are reported until `stop`, and models."""
        seen, models = [], []

        def listen(stage, done, total):
            seen.append(done)
            if done == stop:
                raise KeyboardInterrupt

        with suppress(KeyboardInterrupt), listening(listen):
            models = photographs._models(matcher, count)
        return seen, [model.num_reg_images() for model in models]

    assert placing(9, stop=8)[0][0] == 0
    *_, less, most = sorted(states.iterdir())
    points = most / "points3D.bin"
    points.write_bytes(points.read_bytes()[:-5])
    whole = image_count(less)
    seen, models = placing(9)
    assert seen[0] == whole > 2
    assert models == [9]
    assert not states.exists()
    shutil.rmtree(tmp_path / "m/models")
    placing(30, stop=8)
    again, models = placing(30)
    assert again.count(0) == 1 < again.index(0)
    assert models == [9]


def test_photographs_added_later_are_taken_with_the_same_camera(frames, tmp_path):
    paths = [frame.image_path for frame in frames]
    for count in (3, 5):
        matcher = Matcher(paths[:count], tmp_path / "m")
        matcher.match([(0, count - 1)])
    with closing(pycolmap.Database.open(matcher.database)) as database:
        assert len(database.read_all_images()) == 3
        assert len(database.read_all_cameras()) == 1


def test_a_call_matches_few_pairs_of_few_pictures(frames, tmp_path, monkeypatch):
    """Ctrl-C waits for a call, and each indexes its pictures anew."""
    matcher, calls = Matcher([frames[0].image_path], tmp_path / "m"), []
    matcher.names = [f"{k}.png" for k in range(40)]

    def listed(_, pairing_options, **options):
        calls.append(pairing_options.match_list_path.read_text().split())

    monkeypatch.setattr("pycolmap.match_image_pairs", listed)
    monkeypatch.setattr(matcher, "_extract", lambda places: None)
    matcher.match(combinations(range(40), 2))
    assert sum(map(len, calls)) == 40 * 39
    assert max(map(len, calls)) <= 2 * 16
    assert sum(len(set(names)) for names in calls) < 12 * len(calls)


def test_a_disk_that_is_too_small_is_one_line(frames, tmp_path, monkeypatch):
    """In place of the abort of pycolmap. What was done before is kept."""
    monkeypatch.setattr("mgs.data.structure.PICTURES_AT_ONCE", 2)
    matcher = Matcher([frame.image_path for frame in frames], tmp_path / "m")
    with monkeypatch.context() as patched:
        patched.setattr("mgs.data.structure.FEATURE_BYTES", 1 << 50)
        fails("m: features and matches may take .* make room", matcher.match, [(0, 1)])
    room = iter((1 << 40, 1 << 40, 1 << 20))
    with monkeypatch.context() as patched:
        patched.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=next(room)))
        fails("may take 32 MiB on disk, 1 are free; make room", matcher.match, [(0, 1)])
    monkeypatch.setattr("pycolmap.extract_features", stop_at())
    matcher.match([(0, 1)])
    assert len(matcher.between(0, 1)[0]) > 50


def test_an_import_that_fills_the_disk_keeps_its_features(frames, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("mgs.data.structure.PICTURES_AT_ONCE", 8)
    room = iter((1 << 40, 1 << 40, 1 << 20))
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=next(room)))
    assert exit_code("import", frames[0].image_path.parent, "--out", tmp_path / "d") == 2
    assert "repeat the command, or choose another place" in said(capsys)[1]
    with closing(pycolmap.Database.open(tmp_path / "d.unpacked/matches/database.db")) as database:
        assert database.num_keypoints() > 1000


def test_given_cameras_that_change_are_not_those_of_matches_before(frames, tmp_path):
    for focal in (300.0, 400.0):
        K = np.array([[focal, 0, WIDTH / 2], [0, focal, WIDTH / 2], [0, 0, 1]])
        given = [(f.image_path, replace(f.camera, K=K), None) for f in frames[:2]]
        matcher = Matcher.of_lenses(given, tmp_path / "m")
        matcher.match([(0, 1)])
    with closing(pycolmap.Database.open(matcher.database)) as database:
        (camera,) = database.read_all_cameras()
    assert camera.params[0] == 400


def test_a_process_that_is_asked_to_end_prints_no_stack(frames, tmp_path):
    program = "import os, signal, sys; from pathlib import Path\n"
    program += "from mgs.data.structure import Matcher; Matcher([Path(sys.argv[1])], Path('m'))\n"
    program += "os.kill(os.getpid(), signal.SIGTERM)"
    ended = python(program, frames[0].image_path, cwd=tmp_path)
    assert (ended.returncode, ended.stderr) == (-15, "")


def test_photographs_alone_are_one_command_to_the_next_picture(
    frames, tmp_path, capsys, monkeypatch, coarse_priors
):
    """Photographs of one side ask for another; one more, first by name, joins the same model."""
    root, site, found = tmp_path / "photos", tmp_path / "photos.site", []
    monkeypatch.setattr("mgs.data.importers.MOST_PIXELS", WIDTH * HEIGHT // 9)
    few = ("--dome", 12, "--gaussians", 500)
    root.mkdir()
    for frame in frames[:7]:
        shutil.copy(frame.image_path, root)
    assert f"{root}: too few photographs without depth, 7;" in refused(
        capsys, ["suggest", root, *few], site
    )
    shutil.copy(frames[7].image_path, root)
    there = ["suggest", root, *few, "--out", frames[0].image_path.parent]
    assert "is there already" in refused(capsys, there, site), "before pictures are placed"
    extract = pycolmap.extract_features

    def watched(*files, image_names, **options):
        found.extend(image_names)
        extract(*files, image_names=image_names, **options)

    monkeypatch.setattr("pycolmap.extract_features", watched)
    command("suggest", root, *few)
    (view,) = read_json(site / "next/suggestions.json")["plan"]
    text = said(capsys)[0]
    assert f"1: {view['way']}" in text
    assert "not PSNR" not in text, "the certificate of one view"
    for words in ("unit ", "unit)", "flight:", "step 0", "coverage"):  # no metres, no steps
        assert words not in text
    assert "round the object to the" in view["way"]
    assert len(found) == 8
    shutil.copy(frames[8].image_path, root / "a new one.png")
    command("suggest", root, *few)
    assert len(found) == 9
    assert read_json(site / "next/suggestions.json")["images"] == 9
    data = load_dataset(site / "dataset").frames
    assert data[0].name == "a new one"
    pairs = (data[1], data[0]), (frames[0], frames[8])
    turns = [motion_between(one.camera, other.camera)[:3] for one, other in pairs]
    assert np.degrees(np.linalg.norm(turns[0] - turns[1])) < 0.5
    kept = (site / "photographs").rename(tmp_path / "kept")
    (site / "photographs").symlink_to(kept)
    (root / "a new one.png").unlink()
    assert "leads out of" in refused(capsys, ["suggest", root, *few], kept)
    shutil.rmtree(site)
    kept.rename(site)
    assert "photos.site" in refused(capsys, ["suggest", root, *few], site)
