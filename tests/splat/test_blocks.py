"""Block lists are complete, ordered, and never change an image, however old they are."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import fails

from mgs import memory
from mgs.camera import MAX_PIXELS, MAX_SIDE
from mgs.gaussians import ARRAYS, MAX_GAUSSIANS
from mgs.splat import (
    ListCache,
    as_drjit,
    blocks,
    fisher,
    kernels,
    moved,
    render,
    rendering,
    walking,
)
from mgs.splat.blocks import BLOCK_X, BLOCK_Y, build, depth_order
from mgs.splat.projection import camera_array, project
from mgs.splat.walking import PIXELS, packet_count

from . import reference
from .scenes import changed, gradients_of, make_camera, make_gaussians, place, with_gradients


def projected(gaussians, camera):
    splats = project(as_drjit(gaussians), camera_array(camera))
    dr.eval(splats)
    return splats


def pairs_of(lists) -> set[tuple[int, int]]:
    """{(splat, block)}."""
    names = "place", "splat", "block", "start", "end"
    place, splat, block, start, end = (np.asarray(getattr(lists, name)) for name in names)
    splat = np.argsort(place)[splat]
    return {(int(j), int(b)) for b, s, e in zip(block, start, end, strict=True) for j in splat[s:e]}


def needed_pairs(gaussians, camera) -> set[tuple[int, int]]:
    """Pairs with a pixel where the splat alone is above the threshold, by the reference."""
    needed = set()
    across = -(-camera.width // BLOCK_X)
    for j in range(len(gaussians)):
        y, x = np.nonzero(reference.render(gaussians[j : j + 1], camera)["alpha"] > 0)
        needed |= {(j, int(b)) for b in (y // BLOCK_Y) * across + x // BLOCK_X}
    return needed


def test_lists_hold_every_pair_and_little_more():
    camera = make_camera()
    for seed, scales in ((0, (-6.0, -1.0)), (4, (-9.0, 0.5)), (5, (-2.0, 1.0))):
        g = make_gaussians(60, seed, log_scales=scales)
        needed, listed = needed_pairs(g, camera), pairs_of(build(projected(g, camera), camera))
        assert needed <= listed
        assert len(listed) < 1.25 * len(needed)


def test_sums_of_splats_of_many_pairs_come_first():
    lists = build(
        projected(make_gaussians(60, 4, log_scales=(-9.0, 0.5)), make_camera()), make_camera()
    )
    place, pairs = np.asarray(lists.summed), np.asarray(lists.slot_end - lists.slot_start)
    assert sorted(place) == list(range(60))
    assert (np.diff(pairs[place].astype(int)) <= 0).all()
    assert len(set(pairs)) > 10


@pytest.mark.parametrize("by_pose", [False, True])
def test_a_new_camera_compiles_nothing(by_pose):
    """Though the number of pairs differs from camera to camera. by_pose: to be differentiated by
    the pose, too."""
    g, still = as_drjit(make_gaussians(300, 3, log_scales=(-5.0, -3.0))), mi.Float64([0.0] * 6)
    dr.enable_grad(still)
    seen = []
    for angle in np.linspace(0, 0.3, 4):
        camera = make_camera(eye=(2 * np.cos(angle), 2 * np.sin(angle), 0.9))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(render(g, moved(camera, still) if by_pose else camera).rgb)
            history = dr.kernel_history()
        seen.append({entry["hash"] for entry in history if entry["type"] == dr.KernelType.JIT})
    assert seen[0]
    assert seen[1] == seen[2] == seen[3]


def test_kernels_are_recorded_once_whether_lists_are_new_kept_or_rebuilt(monkeypatch):
    """A recording depends on which inputs are the same array, as splats and footprints of new lists
    may be, and those of kept lists are not."""
    camera, g, cache, recorded = make_camera((46, 31)), make_gaussians(37, 3), ListCache(), []
    walk = walking._walk_until_done
    counted = lambda *arguments: recorded.append(1) or walk(*arguments)  # noqa: E731
    monkeypatch.setattr(walking, "_walk_until_done", counted)
    for growth, builds in ((0, 1), (0, 1), (0.05, 2), (0.05, 2), (0.4, 3)):
        grown = changed(g, log_scales=g.log_scales + np.float32(growth))
        image = render(with_gradients(grown, ["log_scales"]), camera, cache=cache)
        dr.backward(dr.sum(image.rgb, axis=None))
        fisher(grown, camera, cache=cache)
        assert cache.builds == builds
    assert len(recorded) == 4, "forward, adjoint, and the two walks of Fisher"


@pytest.mark.parametrize("kind", ["cpu", "gpu"])
def test_depth_order_is_a_stable_sort(monkeypatch, kind):
    """In two passes of 16 bits on the processor, and four of 8 on a GPU."""
    monkeypatch.setitem(blocks.DIGIT_BITS, "cpu", blocks.DIGIT_BITS[kind])
    rng = np.random.default_rng(0)
    depth = rng.choice(rng.uniform(0.01, 50, 300), 1000).astype(np.float32)
    found = np.asarray(depth_order(mi.Float(depth)))
    np.testing.assert_array_equal(found, np.argsort(depth, kind="stable"))


def images(gaussians, camera, cache=None) -> list[np.ndarray]:
    image = render(gaussians, camera, (0.2, 0.4, 0.6), cache)
    return [np.asarray(image.rgb), np.asarray(image.alpha), np.asarray(image.depth)]


def assert_cached_is_cold(gaussians, camera, cache) -> None:
    """Images with a cache are bitwise those without."""
    for a, b in zip(images(gaussians, camera, cache), images(gaussians, camera), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("names", [*((name,) for name in ARRAYS), ARRAYS])
@settings(derandomize=True, deadline=None, max_examples=5)
@given(
    seed=st.integers(0, 2**31),
    drift=st.sampled_from([0.1, 1e-3, 1e-2, 1.0]),
    teleport=st.booleans(),
)
def test_stale_lists_never_change_an_image(names, seed, drift, teleport):
    """Parameters drift, jump behind the camera and back. (If antialiased, all change opacity.)"""
    camera, style = make_camera(), {"log_scales": (-5.0, -1.5), "antialiased": False}
    g = make_gaussians(60, seed, **style)
    rng, cache = np.random.default_rng(seed), ListCache()
    behind = place(camera, rng.uniform(0, 30, (60, 2)), np.full(60, -1.5))
    for step in range(6):
        assert_cached_is_cold(g, camera, cache)
        if step in (2, 4):
            np.testing.assert_array_equal(fisher(g, camera, cache=cache), fisher(g, camera))
        arrays = {name: getattr(g, name) for name in names}
        values = {name: a + drift * rng.normal(size=a.shape) for name, a in arrays.items()}
        if teleport:
            jump = rng.random(60) < 0.3
            there = behind if step % 2 else rng.uniform(-0.6, 0.6, (60, 3))
            values["means"] = np.where(jump[:, None], there, g.means)
        g = changed(g, **values)


def test_lists_are_reused_until_a_footprint_changes():
    camera, g, cache = make_camera(), make_gaussians(60, 3), ListCache()

    def see(**values):
        render(changed(g, **values), camera, cache=cache)
        return cache.builds

    larger = g.log_scales + np.float32(0.01)
    assert [see(), see(), see(sh=g.sh + 1)] == [1, 1, 1]
    assert [see(log_scales=larger), see(log_scales=larger, sh=g.sh + 1)] == [2, 2]
    fisher(changed(g, log_scales=larger), camera, cache=cache)
    assert see(logit_opacities=g.logit_opacities - 1, log_scales=larger) == 3
    assert see(means=g.means + np.float32(0.01)) == 4


def test_each_camera_and_number_of_gaussians_has_its_own_lists():
    g, cache = make_gaussians(60, 3), ListCache()
    options = {}, {"eye": (1, 1, 1)}, {"focal": 40.0}, {"size": (24, 16)}, {"centre": (9, 9)}
    cameras = [make_camera(**values) for values in options]
    for _ in range(2):
        for camera in cameras:
            assert_cached_is_cold(g, camera, cache)
    assert cache.builds == len(cameras)
    for n in (16, 60):
        assert_cached_is_cold(make_gaussians(n, 4), cameras[0], cache)


AZIMUTHS = 2 * np.pi * np.arange(24) / 24
RING = [make_camera(eye=(2.0 * np.cos(a), 2.0 * np.sin(a), 1.0)) for a in AZIMUTHS]
IN_ORDER = [np.arange(12)] * 5
SHUFFLED = [np.random.default_rng(i).permutation(12) for i in range(6)]


def misses(passes, room: int) -> list[int]:
    """Number of lists that each pass over the ring builds, in a cache with so much room."""
    splats = projected(make_gaussians(60, 3), RING[0])
    cache = ListCache()
    cache.get(RING[0], splats)
    cache, built = ListCache(budget=room * cache.nbytes), []
    for cameras in passes:
        before = cache.builds
        for i in cameras:
            cache.get(RING[i], splats)
            assert cache.nbytes <= cache.budget
        built.append(cache.builds - before)
    return built


def test_cache_keeps_what_it_has_room_for():
    assert misses(IN_ORDER, 12) == [12, 0, 0, 0, 0]
    assert misses(IN_ORDER, 11) == [12, 1, 1, 1, 1]
    assert misses(IN_ORDER, 6) == [12, 6, 6, 6, 6]
    assert max(misses(SHUFFLED, 11)[1:]) <= 2
    assert np.mean(misses(SHUFFLED, 6)[1:]) < 8.5, "LRU: 10"
    for passes in (IN_ORDER, SHUFFLED):
        others = [cameras + 12 for cameras in passes]
        assert max(misses([*passes, *others], 11)[-2:]) <= 2, "it goes over to other cameras"
    assert misses([[0], [1], [1], [1]], 1) == [1, 1, 1, 0], "one camera after another"


def test_views_larger_than_the_budget_still_render(monkeypatch):
    monkeypatch.setattr(rendering, "REMEMBERED", 2)
    g, cache = make_gaussians(60, 3), ListCache(budget=1)
    for i in (0, 1, 2, 3, 3, 3):
        assert_cached_is_cold(g, RING[i], cache)


@pytest.mark.parametrize(
    ("size", "n", "what"),
    [((65536, 4), 1 << 19, "blocks"), ((4, 65536), 1 << 18, "rows of blocks")],
)
def test_pairs_are_counted_in_64_bits(size, n, what):
    """2^32 pairs, which 32 bits count as none, are refused before memory is taken."""
    camera, one = make_camera(size, focal=100.0), make_gaussians(1, 0, spread=0)
    many = one.map(lambda array: np.repeat(array, n, 0))
    many.log_scales[:], many.logit_opacities[:] = 9, 2
    said = f"^view: 4,294,967,296 pairs of a Gaussian and one of its {what} .* 512.0 GiB.*$"
    fails(said, render, many, camera)


def test_what_memory_has_no_room_for_is_refused(monkeypatch, tmp_path):
    camera, g, spare = make_camera(), make_gaussians(60, 3), tmp_path / "meminfo"
    monkeypatch.setattr(memory, "MEMORY_FILE", spare)
    monkeypatch.setattr(memory, "LITTLE", 0)
    spare.write_text("MemTotal:  9 kB\nMemAvailable:  20 kB\n")
    fails(r"view: [0-9,]+ pairs .* GiB are free; draw fewer", render, g, camera)
    fails("fisher: blocks of 60 G", fisher, g, camera, "block")
    spare.unlink()  # a system that does not report it
    render(g, camera)
    fisher(g, camera, "block")


def test_what_drjit_keeps_for_later_is_given_back_before_anything_is_refused(monkeypatch):
    given_back = []
    monkeypatch.setattr(dr, "flush_malloc_cache", lambda: given_back.append(True))
    monkeypatch.setattr(memory, "_spare", lambda: 3e9 if given_back else 1e9)
    memory.check_room(2e9, "much", "take less")
    assert given_back == [True]
    fails(r"more .* 3\.7 GiB, 2\.8 GiB", memory.check_room, 4e9, "more", "take less")


def test_places_in_buffers_stay_below_31_bits():
    """For the most pairs, the most Gaussians and the largest images. (Sums with means have a check
    of their own.)"""
    most = max(kernels.ADJOINT_SUMS[True], kernels.fisher_sums(True, False))
    assert blocks._room(blocks.MAX_PAIRS) * 4 * packet_count(most) < 1 << 31
    assert MAX_GAUSSIANS * max(3 * 16, 4 * packet_count(kernels.fisher_sums(True, True))) < 1 << 31
    for width in (1, 9, MAX_PIXELS // MAX_SIDE, 12_345, MAX_SIDE):
        height = min(MAX_SIDE, MAX_PIXELS // width)
        blocks_x, blocks_y = -(-width // BLOCK_X), -(-height // BLOCK_Y)
        assert blocks_x * blocks_y * PIXELS * 4 < 1 << 31
        assert blocks._tile_numbers(blocks_x, blocks_y) < 1 << 31


def test_what_is_too_large_for_the_kernels_is_refused_at_once():
    for size in ((1, MAX_SIDE + 1), (MAX_SIDE + 1, 1)):
        fails("must be at most 1,048,576 pixels either way", make_camera, size)
    one = make_gaussians(1, 0, 3)

    def many(n):
        return one.map(lambda array: np.broadcast_to(array[0], (n, *array.shape[1:])))

    for call in (render, fisher):
        fails("gaussians: 33,554,433", call, many(MAX_GAUSSIANS + 1), make_camera())
    fails(r"blocks of 700,000 .* 8\.2 GiB", fisher, many(700_000), make_camera(), "block")


@pytest.mark.parametrize("tile", [1, 3, 1000])
def test_the_size_of_tiles_changes_no_bit(tile, monkeypatch):
    camera, g = make_camera((150, 70), focal=150.0), make_gaussians(80, 7, log_scales=(-5.0, -1.5))

    def everything():
        model = with_gradients(g)
        dr.backward(dr.sum(dr.square(render(model, camera).rgb), axis=None))
        gradients = gradients_of(model).values()
        return [*images(g, camera), *gradients, fisher(g, camera), fisher(g, camera, "block")]

    expected = everything()
    monkeypatch.setattr(blocks, "TILE", tile)
    for a, b in zip(everything(), expected, strict=True):
        np.testing.assert_array_equal(a, b)
