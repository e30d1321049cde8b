"""Memory is bounded without a change of results, and no array is read beyond its end."""

import gc
import re
import weakref
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import synthetic
from program import python

import mgs
from mgs import Dataset, Frame, PriorSettings, build_prior, evaluation, load_dataset, run_nbv, scene
from mgs.data import importers
from mgs.data.masks import make_masks
from mgs.data.meshes import read_mesh
from mgs.data.sources import read_source
from mgs.fit import objective
from mgs.memory import PADDING, VIEW_BYTES, adopted, kept_within, padded
from mgs.run import checks


def test_results_are_kept_within_the_budget():
    made = Counter()

    def make(key):
        made[key] += 1
        return np.full(10, key, np.uint8)

    get = kept_within(25, make, lambda array: array.nbytes)
    for _ in range(3):
        assert [int(get(key)[0]) for key in range(4)] == [0, 1, 2, 3]
    assert made == {0: 1, 1: 1, 2: 3, 3: 3}


def test_only_arrays_with_room_behind_them_are_not_copied():
    known = padded(np.ones((4, 3)))
    assert adopted(known) is known
    plain = np.ones((4, 64), np.float32)
    for values in (plain, plain[-1:], known[:, :2], known.T, known.astype(np.float64), [1.0, 2.0]):
        copy = adopted(values)
        assert copy.dtype == np.float32
        assert np.array_equal(copy, values)
        assert not np.shares_memory(copy, values)


class Live:
    """Count of the images that are alive, and its maximum."""

    now = most = 0

    def watch(self, image):
        self.now += 1
        self.most = max(self.most, self.now)
        weakref.finalize(image, self.died)
        return image

    def died(self):
        self.now -= 1


@pytest.fixture(scope="module")
def rock(tmp_path_factory):
    root = tmp_path_factory.mktemp("rock") / "dataset"
    return synthetic.write_rock(root, synthetic.orbit_cameras(9, 48, 36), 300)


@pytest.mark.parametrize("exposure", [True, False])
def test_a_run_holds_few_images_at_once_and_finds_the_same(rock, tmp_path, monkeypatch, exposure):
    """Without gains, which change at every fit, a run keeps targets alone, not their images."""
    live, target, target_of = Live(), Frame.target, scene.target_of
    colours, compared = Live(), checks._compared

    def watched(frame):
        rgba, weight = target(frame)
        return live.watch(rgba), weight

    def watched_colours(frame):
        bits, truth, blurred = compared(frame)
        return bits, colours.watch(truth), blurred

    monkeypatch.setattr(Frame, "target", watched)
    monkeypatch.setattr(checks, "_compared", watched_colours)
    monkeypatch.setattr(scene, "target_of", lambda *frame: live.watch(target_of(*frame)))
    found, most = [], []
    for name, budget in (("kept", 1 << 30), ("read again", 0)):
        for module in (scene, objective, evaluation, checks):
            monkeypatch.setattr(module, "IMAGE_BYTES", budget)
        gc.collect()
        live.now = live.most = colours.now = colours.most = 0
        settings = {"policy": "uniform", "seeds": 6, "budget": 3, "evaluate_every": 1}
        settings |= {"exposure": exposure, "train": {"passes": 2}, "warm_passes": 1}
        found.append(run_nbv(rock.root, tmp_path / name, **settings).state)
        most.append(live.most)
    assert (most[0] >= 9) == exposure  # all images that were taken are counted
    assert max(most[exposure:]) <= 4
    assert colours.most <= 2
    kept, again = found
    assert np.array_equal(kept.gaussians.sh, again.gaussians.sh)
    assert np.array_equal(kept.H, again.H)


@pytest.mark.usefixtures("coarse_priors")
def test_a_fit_does_not_hold_the_information_about_the_model_before(rock, monkeypatch):
    prior = build_prior(rock, PriorSettings(gaussians=300), source="hull")
    whole, held, fit = scene.Scene(rock, prior, keep=VIEW_BYTES), [], scene.fit_gaussians

    def watched(*arguments, **how):
        held.append("views" in whole.memo)
        return fit(*arguments, **how)

    monkeypatch.setattr(scene, "fit_gaussians", watched)
    state = mgs.learn(whole, whole.seeds(3))
    view = next(i for i in range(len(rock)) if i not in state.taken)
    whole.information(state, view)
    assert "views" in whole.memo
    mgs.learn(whole, (*state.taken, view), state)
    assert held == [False, False]


@pytest.mark.usefixtures("coarse_priors")
def test_commands_before_a_run_hold_few_images_at_once(rock, tmp_path, monkeypatch):
    live, read, rgb, mask = Live(), importers.read_rgba, Frame.rgb, Frame.mask
    monkeypatch.setattr(importers, "read_rgba", lambda path: live.watch(np.array(read(path))))
    monkeypatch.setattr(Frame, "rgb", lambda frame: live.watch(rgb(frame).copy()))
    monkeypatch.setattr(Frame, "mask", lambda frame: live.watch(mask(frame).copy()))
    build_prior(rock, PriorSettings(gaussians=300), source="hull")
    imported = importers.import_source(read_source(rock.root), tmp_path / "d")
    for path in (tmp_path / "d/masks").iterdir():
        path.unlink()
    bare = [Frame(f.name, f.camera, f.timestamp, f.image_path) for f in imported.frames]
    make_masks(Dataset(tmp_path / "d", tuple(bare)), read_mesh(rock.root / "rock.glb"))
    assert live.most <= 4
    assert len(load_dataset(tmp_path / "d")) == 9


AT_THE_END = """
import ctypes, mmap
import numpy as np
import tiny, mgs
from mgs.splat import fisher, render

def at_the_end(values):
    "Copy an array to memory that ends with it, before a page that must not be read."
    values = np.ascontiguousarray(values, np.float32)
    size = -(-values.nbytes // mmap.PAGESIZE) * mmap.PAGESIZE
    pages = np.frombuffer(mmap.mmap(-1, size + mmap.PAGESIZE), np.uint8)
    end = ctypes.c_void_p(pages.ctypes.data + size)
    assert ctypes.CDLL(None).mprotect(end, mmap.PAGESIZE, 0) == 0
    copy = pages[size - values.nbytes : size].view(np.float32).reshape(values.shape)
    copy[:] = values
    return copy

model, camera = tiny.initial([]), tiny.orbit(1)[0]
moved = model.map(at_the_end)
assert np.array_equal(np.asarray(render(moved, camera).rgb), np.asarray(render(model, camera).rgb))
assert np.array_equal(fisher(moved, camera), fisher(model, camera))
print("drawn")
"""


def test_memory_that_ends_with_an_array_is_not_read_beyond():
    """In a new process, which Dr.Jit would crash: its kernels read beyond NumPy's arrays."""
    done = python(AT_THE_END, cwd=Path(__file__).parent)
    assert done.stdout == "drawn\n", (done.returncode, done.stderr)


@pytest.mark.parametrize("shape", [(0,), (5,), (3, 4), (2, 3, 4)])
def test_a_padded_array_is_the_same_with_memory_behind_it(shape):
    values = np.random.default_rng(0).normal(size=shape)
    copy = padded(np.asfortranarray(values), np.float64)
    assert np.array_equal(copy, values)
    assert copy.flags.c_contiguous
    aligned = not copy.size or copy.ctypes.data % 64 == 0
    assert aligned, "Dr.Jit compiles another kernel for other addresses"
    memory = copy.base if copy.base.base is None else copy.base.base
    end, needed = memory.ctypes.data + memory.nbytes, (copy.size + PADDING) * copy.itemsize
    assert end >= copy.ctypes.data + needed
    assert padded([1, 2]).dtype == np.float32


def test_all_that_dr_jit_takes_from_numpy_is_padded():
    """In the code, each Dr.Jit array that is made of a NumPy expression calls `padded`."""
    taken = re.compile(r"mi\.(?:Float|Float64|UInt32|TensorXf|Vector\d[fd]?|Point\d[fd]?)\((.*)")
    for path in (Path(mgs.__file__).parent).rglob("*.py"):
        for line in path.read_text().splitlines():
            found = taken.search(line)
            if found and re.search(r"np\.|\.astype\(|asarray", found[1]):
                assert "padded(" in found[1], f"{path}: {line.strip()}"
