"""Structure from motion by pycolmap. Seeds are fixed and pictures enter the database in order, so
results repeat, but bundle adjustments of over 50,000 observations sum in any order."""

import os
import shutil
import signal
from collections import defaultdict
from collections.abc import Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.clouds import SparseCloud
from mgs.data.dataset import FILES, TEST_FOLDER, Dataset, load_dataset, write_transforms
from mgs.data.frames import Frame, moves
from mgs.data.lens import Lens
from mgs.errors import NoRoom
from mgs.files import below, copy_file, read_leftover, write_json
from mgs.images import exif_orientation, unlimited_headers
from mgs.progress import report

WIDEST = 1000  # longer side, pixels, to which larger pictures are reduced for features
FEATURES = 4096  # most features of a picture
FEATURE_BYTES = 152  # of a feature in the database
# In one call of pycolmap, which Ctrl-C waits for: a picture for each core, of at most 8 in memory.
PICTURES_AT_ONCE, PAIRS_AT_ONCE = min(8, len(os.sched_getaffinity(0))), 16
TILE = 4  # pictures whose pairs with as many are matched together: a call indexes each once
ROOM = 1 << 25  # bytes on disk that one call may take, twice as many as it keeps
ALIKE = 16  # pictures that each is matched with where poses are known: the most alike by pose
CLOUD = "sparse.ply"  # file of a dataset with its triangulated points
POSES = "poses.json"  # in the dataset of a run that refined poses: how far each moved
LEAST_POINTS = 100  # fewest triangulated points from which a fit can start
POSITION_STD = 0.0025  # standard deviation of a given position, over the distance to what is seen
ADJUSTMENTS = 2  # bundle adjustments of given poses, each after another triangulation
LEAST_SHARED = 15  # fewest points that a picture shares with others for its pose to be adjusted


class Matcher:
    """Features and matches of pictures, kept in a database of COLMAP.

    pictures: files. cameras: of pycolmap, one for each picture, by default as EXIF says; equal ones
    are taken as one camera.
    folder: of the database, which a later Matcher of the same pictures and cameras, or of more,
    continues."""

    def __init__(self, pictures: Sequence[Path], folder: Path, cameras: Sequence[Any] = ()) -> None:
        import PIL.Image  # noqa: F401  # after pycolmap, writing a PNG would crash in its zlib
        import pycolmap

        with suppress(ValueError, TypeError):  # else pycolmap prints its stack where it is stopped
            signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
        pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
        self.folder = below(folder.parent, folder.name)
        self.database = folder / "database.db"
        lenses = [str(camera.todict()) for camera in cameras] or [""] * len(pictures)
        about = [
            [str(path.resolve()), path.stat().st_mtime_ns, lens]
            for path, lens in zip(pictures, lenses, strict=True)
        ]
        record = folder / "pictures.json"
        before = read_leftover(record)
        if not isinstance(before, list) or any(picture not in about for picture in before):
            before = []
        order = [*before, *(picture for picture in about if picture not in before)]
        # Names of any characters become plain ones.
        places = [order.index(picture) for picture in about]
        self.names = [f"{k:06d}{path.suffix}" for k, path in zip(places, pictures, strict=True)]
        if not before:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        if order != before:
            for name, path in zip(self.names, pictures, strict=True):
                if not (folder / name).exists():
                    _link_upright(path, folder / name)
            write_json(record, order)
        reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
        self.cameras = cameras or [
            pycolmap.infer_camera_from_image(folder / name, reader) for name in self.names
        ]

    @classmethod
    def of_frames(cls, frames: Sequence[Frame], folder: Path) -> "Matcher":
        return cls.of_lenses([(frame.image_path, frame.camera, None) for frame in frames], folder)

    @classmethod
    def of_lenses(
        cls, pictures: Sequence[tuple[Path, Camera, Lens | None]], folder: Path
    ) -> "Matcher":
        """Matcher of files, each with its camera and lens, None for a pinhole."""
        cameras = []
        for _, camera, lens in pictures:
            K = camera.K
            lens = lens or Lens("PINHOLE", (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
            cameras.append(lens.camera(camera.width, camera.height))
        return cls([path for path, _, _ in pictures], folder, cameras)

    def match(self, pairs: Iterable[tuple[int, int]]) -> None:
        """Match pairs of pictures, given by their places; what is matched already is not again."""
        import pycolmap

        ordered = {(min(pair), max(pair)) for pair in pairs}
        every = sorted(ordered, key=lambda pair: (pair[0] // TILE, pair[1] // TILE, pair))
        self.check_disk(len(self.names))
        self._extract(sorted({place for pair in every for place in pair}))
        options, listed = pycolmap.TwoViewGeometryOptions(), self.folder / "pairs.txt"
        options.ransac.random_seed = 0
        for start in range(0, len(every), PAIRS_AT_ONCE):
            report("matching pictures", start, len(every))
            self.check_disk()
            lines = [
                f"{self.names[one]} {self.names[other]}\n"
                for one, other in every[start : start + PAIRS_AT_ONCE]
            ]
            listed.write_text("".join(lines), encoding="utf-8")
            pycolmap.match_image_pairs(
                self.database,
                pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listed),
                verification_options=options,
            )

    def check_disk(self, pictures: int = 0) -> None:
        """Raise NoRoom where the disk may be too small for the features of so many pictures, or
        for one more call of pycolmap, which aborts the process where a disk is full."""
        free = shutil.disk_usage(self.folder).free
        if pictures and self.database.is_file():
            free += self.database.stat().st_size  # it has features of a call before
        need = ROOM + pictures * FEATURES * FEATURE_BYTES
        if need > free:
            room = f"may take {need / 2**20:,.0f} MiB on disk, {free / 2**20:,.0f} are free"
            cure = "make room and repeat the command, or choose another place"
            raise NoRoom(f"{self.folder}: features and matches {room}; {cure}")

    def _extract(self, places: Sequence[int]) -> None:
        import pycolmap

        groups = defaultdict[str, list[int]](list)
        numbers = dict[str, int]()
        with closing(pycolmap.Database.open(self.database)) as database:
            images = {image.name: image for image in database.read_all_images()}
            for name, camera in zip(self.names, self.cameras, strict=True):
                if name in images:  # of a call before, with whose cameras it shares its own
                    numbers[str(camera.todict())] = images[name].camera_id
            for place in places:
                image = images.get(self.names[place])
                if image is None or not database.exists_keypoints(image.image_id):
                    groups[str(self.cameras[place].todict())].append(place)
            for key, members in groups.items():
                if key not in numbers:
                    numbers[key] = database.write_camera(self.cameras[members[0]])
        options = pycolmap.FeatureExtractionOptions(max_image_size=WIDEST)
        options.sift.max_num_features = FEATURES
        done, total = 0, sum(map(len, groups.values()))
        for key, members in groups.items():
            reader = pycolmap.ImageReaderOptions(existing_camera_id=numbers[key])
            for start in range(0, len(members), PICTURES_AT_ONCE):
                report("features of pictures", done, total)
                self.check_disk()
                some = members[start : start + PICTURES_AT_ONCE]
                files = self.database, self.folder
                names = [self.names[place] for place in some]
                # First in the database in order, because threads would enter them in any.
                pycolmap.import_images(*files, image_names=names, options=reader)
                pycolmap.extract_features(
                    *files, image_names=names, reader_options=reader, extraction_options=options
                )
                done += len(some)

    def between(self, one: int, other: int) -> tuple[np.ndarray, np.ndarray, int]:
        """Pixels [N,2] of the same points in two pictures that one epipolar geometry explains, and
        the number of all matches."""
        import pycolmap

        with closing(pycolmap.Database.open(self.database)) as database:
            images = [database.read_image_with_name(self.names[place]) for place in (one, other)]
            a, b = (image.image_id for image in images if image)
            pairs = database.read_two_view_geometry(a, b).inlier_matches
            pixels = (database.read_keypoints(number)[:, :2] for number in (a, b))
            first, second = (np.asarray(points, np.float64) for points in pixels)
            return first[pairs[:, 0]], second[pairs[:, 1]], len(database.read_matches(a, b))

    def triangulated(self, cameras: Sequence[Camera]) -> SparseCloud | None:
        """Points of the matches at the poses of cameras; None if they are under LEAST_POINTS."""
        self.match(alike(cameras))
        return self._cloud(self._points(cameras))

    def refined(self, cameras: Sequence[Camera]) -> tuple[list[Camera], SparseCloud | None]:
        """Cameras after bundle adjustment of their poses, and the points of `triangulated`. A prior
        holds each position to POSITION_STD of the distance to what the camera sees. Cameras that
        share no points with others, and all if there are under LEAST_POINTS, stay."""
        import pycolmap

        self.match(alike(cameras))
        result, moved = self._points(cameras), list(cameras)
        for _ in range(ADJUSTMENTS):
            if result.num_points3D() < LEAST_POINTS:
                return list(cameras), None
            report("adjusting poses", 0, 0)
            config, priors = pycolmap.BundleAdjustmentConfig(), []
            for number, image in result.images.items():
                if image.num_points3D < LEAST_SHARED:
                    continue
                config.add_image(number)
                config.set_constant_cam_intrinsics(image.camera_id)
                place = self.names.index(image.name)
                numbers = [mark.point3D_id for mark in image.get_observation_points2D()]
                seen = np.stack([result.points3D[k].xyz for k in numbers])
                std = POSITION_STD * float(np.median(cameras[place].project(seen)[1]))
                priors.append(
                    pycolmap.PosePrior(
                        corr_data_id=image.data_id,
                        position=cameras[place].position,
                        position_covariance=std**2 * np.eye(3),
                        coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
                    )
                )
            options = pycolmap.BundleAdjustmentOptions(print_summary=False)
            options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
            how = options, pycolmap.PosePriorBundleAdjustmentOptions(), config, priors, result
            pycolmap.create_pose_prior_bundle_adjuster(*how).solve()
            for number in config.images:
                image = result.images[number]
                place, pose = self.names.index(image.name), np.eye(4)
                pose[:3] = image.cam_from_world().matrix()
                moved[place] = replace(cameras[place], world_to_camera=pose)
            result = self._points(moved)
        return moved, self._cloud(result)

    def _cloud(self, result: Any) -> SparseCloud | None:
        cloud = cloud_of(result)
        return cloud if cloud is not None and len(cloud.points) >= LEAST_POINTS else None

    def _points(self, cameras: Sequence[Camera]) -> Any:
        """Reconstruction of pycolmap with the points of the matches at the poses of cameras."""
        import pycolmap

        report("triangulating", 0, 0)
        self.check_disk()
        model = pycolmap.Reconstruction()
        with closing(pycolmap.Database.open(self.database)) as database:
            for lens in database.read_all_cameras():
                model.add_camera_with_trivial_rig(lens)
            for name, camera in zip(self.names, cameras, strict=True):
                if image := database.read_image_with_name(name):
                    pose = pycolmap.Rigid3d(camera.world_to_camera[:3])
                    model.add_image_with_trivial_frame(image, pose)
        options = pycolmap.IncrementalPipelineOptions(extract_colors=False, random_seed=0)
        options.triangulation.random_seed = 0
        return pycolmap.triangulate_points(
            model, self.database, self.folder, self.folder, options=options
        )


def _link_upright(path: Path, link: Path) -> None:
    """Link a picture, or write it turned by its EXIF orientation, with its other EXIF data."""
    from PIL import Image, ImageOps

    if exif_orientation(path) == 1:
        link.symlink_to(path.resolve())
        return
    with unlimited_headers(), Image.open(path) as image:
        upright = ImageOps.exif_transpose(image)
        upright.save(link, exif=upright.getexif(), quality=95)


def lacks_points(dataset: Dataset) -> bool:
    """Whether nothing in a dataset says where its surfaces are: no points, depth or masks."""
    shaped = any(frame.depth_path or frame.mask_path or frame.rock_path for frame in dataset.frames)
    return not shaped and not (dataset.root / CLOUD).is_file()


def alike(cameras: Sequence[Camera]) -> set[tuple[int, int]]:
    """Pairs of places of each camera and the ALIKE that are nearest to it by distance, over the
    extent of all, plus the angle between their axes, radians."""
    eyes = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.world_to_camera[2, :3] for camera in cameras])
    extent = max(float(np.ptp(eyes, axis=0).max()), 1e-12)
    pairs = set()
    for place in range(len(cameras)):
        away = np.linalg.norm(eyes - eyes[place], axis=1) / extent
        away += np.arccos(np.clip(axes @ axes[place], -1, 1))
        away[place] = np.inf
        nearest = np.argsort(away, kind="stable")[: min(ALIKE, len(cameras) - 1)]
        pairs |= {(min(place, other), max(place, other)) for other in nearest.tolist()}
    return pairs


def cloud_of(reconstruction: Any) -> SparseCloud | None:
    """Triangulated points that some image saw. COLMAP writes -1 for an unknown error."""
    centres = {
        image.image_id: image.projection_center() for image in reconstruction.images.values()
    }
    points, views, tracks, errors = [], [], [], []
    for point in reconstruction.points3D.values():
        seen = {element.image_id for element in point.track.elements}
        if seen:
            rays = np.stack([centres[image] for image in seen]) - point.xyz
            points.append(point.xyz)
            views.append((rays / np.linalg.norm(rays, axis=1, keepdims=True)).mean(0))
            tracks.append(float(len(seen)))
            errors.append(point.error)
    if not points:
        return None
    directions, error = np.stack(views), np.array(errors)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    errors_px = error if (error >= 0).all() else None
    return SparseCloud(np.stack(points), directions, np.array(tracks), errors_px)


def refined(
    dataset: Dataset, folder: Path
) -> tuple[Dataset, SparseCloud | None, dict[str, dict[str, float]]]:
    """Adjust the poses of a dataset and its test views to the points that pictures share, and write
    them; returns the dataset as it is then, its points, and `mgs.data.frames.moves`. folder: for
    matches."""
    world, tests, count = dataset.world, dataset.test_views(), len(dataset)
    frames = [*dataset.frames, *(tests.frames if tests else ())]
    matcher = Matcher.of_frames(frames, folder)
    cameras, cloud = matcher.refined([world.leave(frame.camera) for frame in frames])
    there = [
        replace(frame, camera=world.enter(camera))
        for frame, camera in zip(frames, cameras, strict=True)
    ]
    if tests:
        write_transforms(dataset.root / TEST_FOLDER, there[count:], world)
    write_transforms(dataset.root, there[:count], world)
    return load_dataset(dataset.root), cloud, moves(frames, there)


def write_refined(folder: Path, given: Dataset, frames: Sequence[Frame]) -> None:
    """Write a dataset of frames with refined poses, of the same files as the given one, and
    poses.json: how far each moved, degrees and length. Points and test views stay as given."""

    def elsewhere(frame: Frame) -> Frame:
        paths = {key: path.resolve() for key in FILES if (path := getattr(frame, key))}
        return replace(frame, **paths)

    tests = given.test_views()
    if tests is not None:
        write_transforms(folder / TEST_FOLDER, [*map(elsewhere, tests.frames)], given.world)
    if (given.root / CLOUD).is_file():
        copy_file(given.root / CLOUD, folder / CLOUD)
    moved = {"dataset": str(given.root.resolve()), "moved": moves(given.frames, frames)}
    write_json(folder / POSES, moved)
    write_transforms(folder, [*map(elsewhere, frames)], given.world)
