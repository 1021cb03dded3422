from __future__ import annotations

import json
import math
from importlib.metadata import PackageNotFoundError, version

import numpy as np
import pytest

from mecanum_env import rooms
from mecanum_env.arguments import make_config
from mecanum_env.sensing.sensors import Lidar
from training.cli import main
from training.studies.costs import peers


def _missing() -> str:
    try:
        for name in peers.PEERS["navground"]:
            version(name)
    except PackageNotFoundError as error:
        return f'{error.name} is not installed: pip install "mecanum-slam[peers]"'
    return ""


needs_navground = pytest.mark.skipif(bool(_missing()), reason=_missing())


def _check_own_part(result: dict[str, object]) -> None:
    assert {"steps_per_second", "stages_us", "landmarks_mean", "rss_mb", "config"} <= result.keys()
    rate = result["steps_per_second"]
    assert isinstance(rate, float) and 10 < rate < 1e6
    stages = result["stages_us"]
    assert isinstance(stages, dict)
    assert {"physics", "lidar", "grid", "observation", "wiring"} <= stages.keys()
    assert all(math.isfinite(us) and us >= 0 for us in stages.values())
    assert stages["lidar"] > 0 and stages["grid"] > 0
    # The stages are of the same steps as the whole, watched: together they are about its length, never twice it.
    watched = result["watched_step_us_median"]
    assert isinstance(watched, float)
    assert 0.3 * watched < sum(stages.values()) < 2.0 * watched
    assert isinstance(result["landmarks_mean"], float) and result["landmarks_mean"] > 1
    assert isinstance(result["rss_mb"], float)


def test_json_keys(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["speed", "--steps", "200", "--beams", "90", "--json"]) == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)  # one object, and nothing beside it
    _check_own_part(result)
    assert result["steps"] >= 200
    assert result["config"]["lidar"]["beams"] == 90
    assert result["config"]["rooms"] == "apartment" and result["config"]["slam"] == "ekf"
    assert "peer" not in result
    assert "90 beams" in printed.err


def test_many_environments_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    settings = ["--rooms", "rectangular", "--slam", "odometry", "--steps", "100"]
    assert main(["speed", "--envs", "2", *settings, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["steps_per_second"].keys() == {"one", "sync", "async", "vector_entry_point"}
    assert result["steps"] == 10 and result["ratio_to_one"]["one"] == 1.0
    undisturbed = result["steps_per_second_undisturbed"]
    assert all(undisturbed[way] >= rate for way, rates in result["rounds"].items() for rate in rates)
    assert main(["speed", "--envs", "2", *settings]) == 0
    assert "vector_entry_point" in capsys.readouterr().out
    assert main(["speed", "--envs", "0"]) == 2


def test_unknown_peer_is_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["speed", "--steps", "200", "--peer", "navgroud"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert "did you mean 'navground'" in line


def test_missing_peer_is_bad_usage_with_the_remedy(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(peers.PEERS, "navground", ("no-such-distribution-anywhere",))
    assert main(["speed", "--steps", "200", "--peer", "navground", "--json"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert "no-such-distribution-anywhere" in line
    assert 'pip install "mecanum-slam[peers]"' in line


def test_what_the_peer_is_told_is_our_robot() -> None:
    setup = peers.peer_setup(make_config(lidar={"beams": 180}))
    assert setup["beams"] == 180
    assert setup["radius_m"] == pytest.approx(math.hypot(0.29, 0.19))
    assert setup["lever_m"] == pytest.approx(0.3855)
    assert setup["speed_sigma_m_s"] == pytest.approx(0.01 * 0.8)
    assert setup["turn_rate_sigma_rad_s"] == pytest.approx(0.01 * 1.5)
    assert setup["field_of_view_rad"] == pytest.approx(2 * math.pi * 179 / 180)  # from the first beam to the last
    assert json.loads(json.dumps(setup)) == setup


@needs_navground
def test_peer_stands_in_the_same_room() -> None:
    config = make_config(noise={"range_sigma_m": 0.001})
    lidar = Lidar(config.lidar, config.noise)
    for seed in range(20):
        plan = rooms.make("apartment", seed=seed)
        plan = plan.with_start((*plan.start[:2], 0.7))  # turned, so that a wrong heading shows
        truth = lidar.true_ranges(plan.segments, plan.circles, plan.start)
        if np.any(truth < lidar.true_ranges(plan.segments, np.zeros((0, 3)), plan.start)):
            break  # a disc is seen from the start, too
    else:
        pytest.fail("no disc to be seen from any start")
    drives = [peers.Drive(seed=5, steps=20, plan=plan)]
    with peers.peer_process(peers.peer_setup(config), drives) as (ready, steps_per_second):
        assert ready["walls"] == len(plan.segments)
        assert ready["discs"] == len(plan.circles)
        theirs = np.array(ready["scan"])
        assert steps_per_second() > 10
    hit = np.isfinite(truth)
    assert np.all(theirs[~hit] == config.lidar.range_max_m)
    # Beam by beam, within the noise, but for rounding (they compute in single precision) on slanting walls.
    assert np.max(np.abs(theirs[hit] - truth[hit])) < 0.006


@needs_navground
def test_peer_that_breaks_down_says_why() -> None:
    setup = peers.peer_setup(make_config())
    del setup["beams"]
    drive = peers.Drive(seed=0, steps=20, plan=rooms.make("rectangular", seed=0))
    with (
        pytest.raises(RuntimeError, match="broke down: KeyError: 'beams'"),
        peers.peer_process(setup, [drive]),
    ):
        pass


@needs_navground
def test_peer_in_the_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["speed", "--steps", "200", "--rooms", "rectangular", "--peer", "navground", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    _check_own_part(result)
    peer = result["peer"]
    assert peer["name"] == "navground"
    assert peer["versions"] == {name: version(name) for name in peers.PEERS["navground"]}
    assert len(peer["rounds"]) == peers.ROUNDS
    assert peer["steps"] * peers.ROUNDS == 200
    for side, key in (("ours", "ours_steps_per_second"), ("theirs", "steps_per_second")):
        rates = sorted(measured[side] for measured in peer["rounds"])
        assert rates[0] > 10
        assert peer[key] == rates[peers.ROUNDS // 2]
    assert peer["ratio"] == peer["ours_steps_per_second"] / peer["steps_per_second"]
    assert peer["setup"]["walls"] == len(rooms.make("rectangular", seed=0).segments)
