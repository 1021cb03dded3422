"""A team's episode: it is a single robot's where there is one, its figures add up, its map is everybody's."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from mecanum_env.team.config import TeamConfig
from slam.geometry import compose
from slam.grids.occupancy import FREE, UNKNOWN
from slam.metrics.measures import corner_deviation
from tests.training.team_episode import STEPS, Explored, explore_together
from training.episodes import explore as single
from training.episodes import team as task
from training.episodes.team_log import team_landmarks, team_map
from training.runs.errors import BadInput


@pytest.fixture(scope="module")
def explored(tmp_path_factory: pytest.TempPathFactory) -> Explored:
    return explore_together(tmp_path_factory.mktemp("team"), communication="range", range_m=4.0)


def test_a_team_of_one_is_a_robot_alone_bit_for_bit(tmp_path: Path) -> None:
    alone = single.prepare(out=tmp_path, rooms="rectangular", seed=5, max_steps=60, agent="brisk-tour")
    single.run(alone, lambda **_: None)
    team = task.prepare(
        TeamConfig(robots=1), out=tmp_path, rooms="rectangular", seed=5, max_steps=60, agent="brisk-tour"
    )
    task.run(team, lambda **_: None)
    ours, theirs = team.team.members[0].truth.record, alone.env.truth.record
    assert np.array_equal(ours.true_poses, theirs.true_poses) and np.array_equal(ours.estimates, theirs.estimates)
    assert np.array_equal(team.log.coverage, theirs.coverage)
    metrics, own = team.metrics(), alone.metrics()
    assert team.end == alone.end
    for name in ("coverage", "time_to_50_s", "map_iou", "ate_rmse_m", "anees", "path_length_m", "collisions"):
        assert metrics[name] == pytest.approx(own[name], rel=1e-12), name


def test_what_is_counted_adds_up(explored: Explored) -> None:
    metrics = explored.episode.metrics()
    robots = metrics["per_robot"]
    assert metrics["steps"] == STEPS and metrics["robots"] == len(robots) == 3
    for name in ("path_length_m", "collisions", "robot_collisions", "landmarks"):
        assert metrics[name] == pytest.approx(sum(robot[name] for robot in robots))
    assert sum(robot["first_share"] for robot in robots) == pytest.approx(1.0)
    assert all(0.0 < robot["first_share"] < 1.0 for robot in robots)
    # ATE over all poses: of equally many a robot.
    assert metrics["ate_rmse_m"] ** 2 == pytest.approx(np.mean([robot["ate_rmse_m"] ** 2 for robot in robots]))
    assert max(robot["coverage"] for robot in robots) <= metrics["coverage"]
    log = explored.episode.log
    assert metrics["coverage"] == log.coverage[-1] and len(log.times) == STEPS + 1
    reached = log.times[log.coverage >= 0.5]
    assert metrics["time_to_50_s"] == (pytest.approx(reached[0]) if len(reached) else None)


def test_coverage_is_of_what_any_robot_has(explored: Explored) -> None:
    """Counted anew from the robots' own maps, cell by cell."""
    team = explored.episode.team
    ground = team.ground
    rows, cols = np.nonzero(ground.mappable)
    covered = np.zeros(len(rows), np.bool_)
    for member in team.members:
        grid = member.backend.grid
        r = rows + ground.lattice_origin[0] - grid.lattice_origin[0]
        c = cols + ground.lattice_origin[1] - grid.lattice_origin[1]
        inside = (r >= 0) & (r < grid.shape[0]) & (c >= 0) & (c < grid.shape[1])
        covered[inside] |= grid.classes()[r[inside], c[inside]] == FREE
    assert explored.episode.log.coverage[-1] == pytest.approx(covered.mean())


def test_the_map_of_all_holds_each_robots_own_and_needs_to_know_their_frames(
    explored: Explored, tmp_path: Path
) -> None:
    merged, together = team_map(explored.episode.team)
    assert together == [0, 1, 2]
    known = merged.known_cells
    assert all(known >= member.backend.grid.known_cells for member in explored.episode.team.members)
    apart = explore_together(tmp_path, robots=2, steps=1, unknown_starts=True, communication="none")
    merged, together = team_map(apart.episode.team)
    assert together == [0] and merged.known_cells == apart.episode.team.members[0].backend.grid.known_cells


def test_landmarks_of_all_are_merged_where_they_are_the_same(explored: Explored, tmp_path: Path) -> None:
    team = explored.episode.team
    merged = team_landmarks(team)
    assert merged is not None and merged.robots == (0, 1, 2)
    each = [len(member.backend.belief.landmarks) for member in team.members]
    assert max(each) <= len(merged.points) < sum(each), "some are the same"
    assert sum(map(len, merged.seen_by)) == sum(each)
    assert corner_deviation(merged.points, team.ground.corners).mean < 0.03
    # Where frames have to be found, only what is tied to the first robot's.
    apart = explore_together(tmp_path, robots=2, steps=1, unknown_starts=True, communication="none")
    alone = team_landmarks(apart.episode.team)
    assert alone is not None and alone.robots == (0,)
    without = explore_together(tmp_path, robots=2, steps=1, slam="odometry")
    assert team_landmarks(without.episode.team) is None


def test_who_was_first_is_as_it_is_however_often_it_is_asked_for(explored: Explored) -> None:
    log = explored.episode.log
    found, first = log._found.copy(), log._first.copy()
    shares = log.first_shares
    assert shares.sum() == pytest.approx(1.0) and np.array_equal(log.first_shares, shares)
    assert np.array_equal(log._found, found) and np.array_equal(log._first, first)


def test_who_knows_the_map_bounds_no_team(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="known-map is the fastest way of one robot"):
        task.prepare(TeamConfig(robots=2), out=tmp_path, rooms="rectangular", seed=3, agent="known-map")


def test_frames_are_where_the_robots_started(tmp_path: Path) -> None:
    explored = explore_together(tmp_path, robots=2, steps=1, unknown_starts=True)
    team = explored.episode.team
    for member, frame, metrics in zip(
        team.members, team.frames, explored.episode.metrics()["per_robot"], strict=True
    ):
        start = compose(team.ground.start, compose(frame, member.truth.record.true_poses[0]))
        assert np.allclose(start, member.truth.plan.start)
        assert np.allclose(metrics["frame"], frame, atol=1e-8)


def test_goals_are_told(explored: Explored) -> None:
    episode = explored.episode
    for agent, member in zip(episode.agents, episode.team.members, strict=True):
        told = member.knowledge.goal
        assert (told is None) == (agent.goal is None)
        assert agent.goal is None or np.array_equal(told, agent.goal.pose[:2])


def test_the_recordings_are_the_robots(explored: Explored) -> None:
    for recording, member in zip(explored.recordings, explored.episode.team.members, strict=True):
        assert np.array_equal(recording.true_poses, member.truth.record.true_poses)
        assert len(recording.collisions) == len(recording.times) == STEPS + 1
        grid = member.backend.grid
        told = {(row, col): now for change in recording.map_changes.values for row, col, now in change.tolist()}
        cells = np.argwhere(grid.classes() != UNKNOWN)
        last = {tuple(cell): int(grid.classes()[tuple(cell)]) for cell in cells.tolist()}
        row0, col0 = grid.lattice_origin
        assert {cell: now for cell, now in told.items() if now != UNKNOWN} == {
            (row0 + row, col0 + col): now for (row, col), now in last.items()
        }


def test_the_team_of_a_file_gives_way_to_the_options(tmp_path: Path) -> None:
    file = tmp_path / "config.toml"
    file.write_text('[run.team]\nrobots = 4\n[run.team.communication]\nmodel = "walls"\nrange_m = 7.0\n')
    assert task.read_team(file).robots == 4 and task.read_team(file).communication.model == "walls"
    asked = task.read_team(file, robots=2, communication="range", unknown_starts=True)
    assert (asked.robots, asked.communication.model, asked.communication.range_m) == (2, "range", 7.0)
    assert not asked.known_starts and task.read_team() == TeamConfig(robots=1)
    file.write_text('[run.team]\nrobots = 2\ncommunication = "range"\n')
    with pytest.raises(BadInput, match=r"\[run.team\] communication must be a table, got 'range'"):
        task.read_team(file, communication="walls")
    file.write_text("[run]\nteam = 3\n")
    with pytest.raises(BadInput, match="team has the wrong type"):
        task.read_team(file)


def test_it_ends_when_nobody_has_anything_left(tmp_path: Path) -> None:
    episode = task.prepare(TeamConfig(robots=2), out=tmp_path, rooms="rectangular", seed=3, agent="brisk-tour")
    task.run(episode, lambda **_: None)
    assert episode.end == "covered" and episode.log.coverage[-1] > 0.95
    assert math.isclose(episode.log.times[-1], 0.1 * (len(episode.log.times) - 1))


def test_who_comes_back_is_not_ended_by_what_the_others_cover(tmp_path: Path) -> None:
    asked = {"rooms": "rectangular", "seed": 431, "agent": "explore-and-return"}
    episode = task.prepare(TeamConfig(robots=3), out=tmp_path, **asked)
    task.run(episode, lambda **_: None)
    assert episode.end == "returned" and episode.log.coverage[-1] > 0.95


def test_a_joint_belief_has_one_map_which_is_nobodys(tmp_path: Path) -> None:
    team = TeamConfig(robots=2, belief="joint")
    episode = task.prepare(team, out=tmp_path, rooms="rectangular", seed=3, max_steps=10)
    task.run(episode, lambda **_: None)
    metrics = episode.metrics()
    assert episode.config.slam == metrics["slam"] == "ekf-lines"
    assert [robot["first_share"] for robot in metrics["per_robot"]] == [None, None]
    merged, together = team_map(episode.team)
    assert together == [0, 1] and merged is episode.team.members[1].grid
    assert metrics["coverage"] == metrics["per_robot"][1]["coverage"] > 0.1
