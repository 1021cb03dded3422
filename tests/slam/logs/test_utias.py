"""What a UTIAS rig makes of its commands and observations: undone as the log is read."""

from __future__ import annotations

import numpy as np
import pytest

from slam.logs import open_log, utias
from tests.slam.logs.logs_on_disk import write_utias


def test_depths_of_the_utias_camera_become_ranges():
    rng = np.random.default_rng(0)
    ranges, bearings = rng.uniform(1.0, 7.0, 20), rng.uniform(-0.6, 0.6, 20)
    depth = (0.0385 + 1.0152 * (ranges + 0.15 * (1.0 - np.cos(bearings)))) * np.cos(bearings)
    rows = utias._measured(np.column_stack([np.full(20, 5.0), np.full(20, 63.0), depth, bearings]))
    np.testing.assert_allclose(rows, np.column_stack([np.full(20, 4.97), np.full(20, 63.0), ranges, bearings]))


def test_the_utias_base_follows_its_commands_late_and_not_quite():
    commands = np.array([[0.0, 0.1, 0.0], [1.0, 0.1, 0.4], [2.0, -0.1, -0.4], [3.0, 0.02, 0.4], [4.0, 0.0, 0.4]])
    driven = utias._driven(commands)
    np.testing.assert_allclose(driven[0], 0.0)  # until the first command comes through
    np.testing.assert_allclose(driven[1:, 0], commands[:, 0] + 0.19)
    np.testing.assert_allclose(driven[1:, 1], [0.1038, 0.0678, -0.0678, 0.0, 0.0])
    np.testing.assert_allclose(driven[1:, 2], 0.97 * commands[:, 2])


STEP_S = 0.01


def commanded(*parts, stray=0):
    """Return commands (k, 3) every 10 ms: (seconds, v, ω) one after the other, each stray-th row zeros."""
    twists = np.vstack([np.tile(part[1:], (round(part[0] / STEP_S), 1)) for part in parts])
    if stray:
        twists[stray::stray] = 0.0
    return np.column_stack([STEP_S * np.arange(len(twists)), twists])


def turned(driven, at):
    """Return how far (n,) [rad] the base has turned by each of the times ``at`` (n,)."""
    times, rates = driven[:, 0], driven[:, 2]
    return np.interp(at, times, np.append(0.0, np.cumsum(rates[:-1] * np.diff(times))))


AHEAD = (2.0, 0.086, 0.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("burst_s", [0.12, 0.2, 0.3, 0.37])
def test_a_short_turn_of_the_utias_base_is_a_pulse_however_long_it_was_logged(burst_s, sign):
    driven = utias._driven(commanded(AHEAD, (burst_s, 0.086, 0.4 * sign), AHEAD))
    end = 2.0 + burst_s + 0.15
    assert turned(driven, 5.0) == pytest.approx(0.97 * 0.4 * 0.21 * sign)
    np.testing.assert_allclose(
        turned(driven, [end - 0.21, end - 0.105, end]), 0.97 * 0.4 * sign * np.array([0.0, 0.105, 0.21]), atol=1e-9
    )
    speeds = driven[np.searchsorted(driven[:, 0], [end - 0.25, end - 0.1, end + 0.05]), 1]
    np.testing.assert_allclose(speeds, [1.038 * 0.086, 1.038 * 0.086 - 0.09 * 0.4, 1.038 * 0.086])


@pytest.mark.parametrize(
    "parts",
    [
        [AHEAD, (0.45, 0.086, 0.4), AHEAD],  # long
        [AHEAD, (0.2, 0.086, 0.25), AHEAD],  # slow
        [AHEAD, (0.2, 0.086, 0.4), (0.2, 0.086, 0.0), (0.2, 0.086, -0.4), AHEAD],  # close to another one
        [AHEAD, (0.2, 0.086, 0.4), (0.3, 0.086, 0.1), AHEAD],  # within a slower turn
        [(0.2, 0.086, 0.4), AHEAD],  # where the log begins and ends
        [AHEAD, (0.2, 0.086, 0.4)],
        [(0.2, 0.086, 0.4)],
    ],
)
def test_other_turns_of_the_utias_base_are_as_long_as_they_were_logged(parts):
    commands = commanded(*parts)
    np.testing.assert_array_equal(utias._pulsed(commands), commands)


@pytest.mark.parametrize("stray", [7, 13, 97])
def test_stray_zeros_stop_no_utias_base(stray):
    parts = [AHEAD, (0.3, 0.086, 0.4), AHEAD, (1.0, 0.086, -0.4), AHEAD]
    np.testing.assert_array_equal(utias._driven(commanded(*parts, stray=stray)), utias._driven(commanded(*parts)))
    for pause_s, stops in ((0.11, False), (0.13, True)):
        commands = commanded(AHEAD, (pause_s, 0.0, 0.0), AHEAD)
        assert np.any(utias._driven(commands)[1:, 1] == 0.0) is np.bool_(stops)


def test_a_turn_that_pauses_for_a_moment_is_one_utias_pulse():
    parts = [AHEAD, (0.1, 0.086, 0.4), (0.08, 0.086, 0.05), (0.1, 0.086, 0.4), AHEAD]
    assert turned(utias._driven(commanded(*parts)), 6.0) == pytest.approx(0.97 * 0.4 * 0.21)


def test_a_utias_log_is_calibrated_unless_it_is_another_rigs_or_wanted_raw(tmp_path):
    write_utias(tmp_path)
    assert open_log(tmp_path).observation_noise == utias.RAW_NOISE  # bearings all round: no camera's
    measured = tmp_path / "Robot1_Measurement.dat"
    rows = np.loadtxt(measured)
    np.savetxt(measured, rows[np.abs(rows[:, 3]) < 1.0], fmt="%.9f")
    log, raw = open_log(tmp_path), open_log(tmp_path, raw=True)
    assert log.observation_noise == utias.NOISE and raw.observation_noise == utias.RAW_NOISE
    assert log.duration_s == pytest.approx(raw.duration_s + 0.19) and "as recorded" in raw.note
    assert np.all(log.range_bearing[:, 1] == raw.range_bearing[:, 1])
    assert np.all(log.range_bearing[:, 0] != raw.range_bearing[:, 0])


def test_a_log_is_the_same_whenever_its_clock_began(tmp_path):
    """A clock of seconds since 1970 tells a quarter of a microsecond, and commands are held for 20 ms exactly."""
    logs = []
    for name, later in (("then", 0.0), ("now", 1.2e9)):
        write_utias(tmp_path / name, seconds=5.0)
        for file in ("Odometry", "Measurement", "Groundtruth"):
            path = tmp_path / name / f"Robot1_{file}.dat"
            rows = np.loadtxt(path)
            rows[:, 0] += later
            np.savetxt(path, rows, fmt="%.6f")
        logs.append(open_log(tmp_path / name))
    then, now = logs
    assert now.clock_start_s == then.clock_start_s + 1.2e9
    for field in ("odometry_times", "twists", "observation_times", "reference_times", "start_pose"):
        np.testing.assert_array_equal(getattr(then, field), getattr(now, field))
