from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mecanum_env.physics.floor import _segment_samples

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
