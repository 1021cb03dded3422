from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mecanum_env.config import NOISE_PRESETS
from mecanum_env.physics.floor import _segment_samples, build_floor
from tests.mecanum_env.physics.worlds import EXACT, room

ends = st.lists(st.tuples(*[st.floats(-20, 20)] * 4), min_size=1, max_size=5)


@given(ends, st.floats(0.01, 1.0))
def test_samples_of_segments_go_from_end_to_end_in_even_steps(
    segments: list[tuple[float, float, float, float]], spacing: float
) -> None:
    samples, done = _segment_samples(np.array(segments), spacing), 0
    for x1, y1, x2, y2 in segments:
        steps = max(1, int(np.ceil(np.hypot(x2 - x1, y2 - y1) / spacing)))
        part = samples[done : done + steps + 1]
        want = np.column_stack([np.linspace(x1, x2, steps + 1), np.linspace(y1, y2, steps + 1)])
        np.testing.assert_allclose(part, want, atol=1e-12)
        assert np.hypot(*np.diff(part, axis=0).T).max() <= spacing + 1e-9
        done += steps + 1
    assert done == len(samples)


def test_clearance_is_never_more_than_the_distance() -> None:
    box = np.array([[3.8, 2.5], [4.4, 2.7], [4.3, 3.4]])
    plan = room(6.0, (2.0, 3.0, 0.0), polygons=(box,), circles=np.array([[1.0, 1.2, 0.03]]))
    floor = build_floor(plan, EXACT, np.random.default_rng(0))
    points = np.random.default_rng(1).uniform(0, 6, (3000, 2))
    col, row = np.floor((points - floor.raster[:2]) * floor.raster[2]).astype(int).T
    known, true = floor.clearance[row, col], plan.distance_to_surfaces(points)
    assert np.all(known <= true)
    assert np.max(true - known) < 3.4 * plan.resolution  # and it is of use


def test_patches_cover_their_share_and_only_then_draw_numbers() -> None:
    plan = room(8.0, (4.0, 4.0, 0.0))
    rng = np.random.default_rng(5)
    floor = build_floor(plan, NOISE_PRESETS["slippery"], rng)
    pad = (floor.friction.shape[0] - plan.free.shape[0]) // 2
    inner = floor.friction[pad:-pad, pad:-pad][plan.free]
    share = np.mean(inner < 0.6)
    assert 0.25 <= share < 0.28
    assert np.all((floor.patches[:, 3] >= 0.15) & (floor.patches[:, 3] <= 0.3))
    assert inner.min() >= np.float32(0.15)
    x, y, _, mu = floor.patches[0]
    if 0 < x < 8 and 0 < y < 8:
        row, col = (int((v - o) * floor.raster[2]) for v, o in ((y, floor.raster[1]), (x, floor.raster[0])))
        assert floor.friction[row, col] <= np.float32(mu)
    rng = np.random.default_rng(5)
    build_floor(plan, EXACT, rng)
    assert rng.random() == np.random.default_rng(5).random()
