"""The learned tour: where it goes, and where it is the tour; its policies."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

import agents
from agents.learned.choice_network import apart
from agents.learned.station_network import SIDE, StationNetwork, picture, pixels
from agents.learned_tour import SHIPPED, LearnedTour, load_station_policy
from agents.stations.survey import STRIDE, options
from agents.ways.routing import draw_luck
from slam.belief import Belief
from slam.grids.occupancy import FREE, UNKNOWN, OccupancyGrid
from tests.agents.stations.floors import CELL_M, LUCK, rooms, stop

STATIONS = {"spacing_m": 4.0, "hop": 2}


def belief_of(known: np.ndarray, robot: tuple[int, int], start: tuple[int, int], pad: int = 0) -> Belief:
    """The belief of a robot in a cell whose frame begins in another, the grid larger by ``pad`` unknown cells."""
    grid = OccupancyGrid.from_classes(
        np.pad(known, pad, constant_values=UNKNOWN),
        CELL_M,
        ((-start[1] - pad) * CELL_M, (-start[0] - pad) * CELL_M),
    )
    at = [(robot[k] - start[k] + 0.5) * CELL_M for k in (1, 0)]
    return Belief(
        pose=np.array([*at, 0.0]), pose_cov=np.zeros((3, 3)), landmarks=np.zeros((0, 2)),
        landmark_cov=np.zeros((0, 2, 2)), landmark_ids=np.zeros(0, np.int64), grid=grid,
    )  # fmt: skip


def goal_cell(goal, start) -> tuple[int, int]:
    x, y = np.floor(np.asarray(goal.pose[:2]) / CELL_M + 1e-9).astype(int)
    return int(y + start[0]), int(x + start[1])


def test_it_goes_to_stations_worth_a_visit_wherever_the_grid_begins():
    known, start = rooms(1), (65, 65)
    goals = []
    for pad in (0, 7, 40):
        agent = agents.make("learned-tour", config={"stations": STATIONS})
        belief = belief_of(known, start, start, pad)
        agent.reset(belief, 0)
        agent.looked(belief)
        goal = agent.choose(belief)
        assert goal is not None and agent.status == "driving" and len(agent.frontiers)
        np.testing.assert_allclose(goal.path, [belief.pose[:2], goal.pose[:2]])
        goals.append(goal_cell(goal, start))
    assert len(set(goals)) == 1
    row, col = goals[0]
    assert (row - start[0]) % STRIDE == 0 and (col - start[1]) % STRIDE == 0 and known[row, col] == FREE


def test_who_knows_no_more_than_before_goes_with_the_tour(monkeypatch):
    """A network that always likes the second opening best would send it to and fro for ever."""
    known, start = rooms(1), (64, 64)  # squares of frontier lie alike in the agent's frame and in the grid
    agent = LearnedTour({"stations": STATIONS})
    monkeypatch.setattr(agent._network, "costs_m", lambda shown, targets, hops, openings: -openings.losses)
    belief = belief_of(known, start, start)
    agent.reset(belief, 0)
    agent.looked(belief)
    first, second = (goal_cell(agent.choose(belief), start) for _ in range(2))
    found, _ = stop(known, start)
    openings = options(found, draw_luck(6, 700), most=5, most_loss_m=40.0)
    assert first == tuple(found.cells[openings.targets[np.argmax(openings.losses)]])
    assert second == tuple(found.cells[openings.targets[0]])
    known[60:64, 100:104] = UNKNOWN
    assert goal_cell(agent.choose(belief_of(known, start, start)), start) != second
    agent.reset(belief, 0)
    agent.looked(belief)
    assert goal_cell(agent.choose(belief), start) == first


@pytest.mark.parametrize("stations", [{"spacing_m": 0.0}, {"spacing_m": 3.0}, {"spacing_m": 4.0, "hop": 1}])
def test_elsewhere_it_is_the_tour(stations):
    known, start = rooms(1), (65, 65)
    config = {"stations": stations, "planner": {"resolution_m": 0.4}, "frontiers": {"view_range_m": 12.0}}
    belief = belief_of(known, start, start)
    goals = []
    for name in ("tour", "learned-tour"):
        agent = agents.make(name, config=config, robot={"length_m": 0.1, "width_m": 0.8})
        agent.reset(belief, 0)
        goals.append(agent.choose(belief))
    assert goals[0] is not None and goals[1] is not None
    np.testing.assert_array_equal(goals[0].pose, goals[1].pose)


def test_off_the_stations_it_is_the_tour():
    known, start = rooms(1), (65, 65)
    config = {"stations": STATIONS, "planner": {"resolution_m": 0.4}, "frontiers": {"view_range_m": 12.0}}
    goals = []
    for name in ("tour", "learned-tour"):
        agent = agents.make(name, config=config, robot={"length_m": 0.1, "width_m": 0.8})
        agent.reset(belief_of(known, start, start), 0)
        agent.looked(belief_of(known, (65, 65), start))
        agent.looked(belief_of(known, (-900, 65), start))  # where nothing is known any more
        goals.append(agent.choose(belief_of(known, (65, 67), start)))
    assert goals[0] is not None and goals[1] is not None
    np.testing.assert_array_equal(goals[0].pose, goals[1].pose)
    agent.reset(belief_of(known, start, start), 0)
    agent.looked(belief_of(known, (-900, 65), start))
    assert agent.choose(belief_of(known, start, start)) is not None


def test_what_is_told_of_the_extent_reaches_the_network(monkeypatch):
    known, start = rooms(1), (65, 65)
    seen = []
    for extent in ((), (-400.0, -400.0, 14.0, 400.0)):
        agent = LearnedTour({"stations": STATIONS, "extent": extent})
        monkeypatch.setattr(
            agent._network,
            "costs_m",
            lambda shown, targets, hops, openings: (seen.append(shown), openings.losses)[1],
        )
        belief = belief_of(known, start, start, pad=5)
        agent.reset(belief, 0)
        agent.looked(belief)
        assert agent.choose(belief) is not None
    # The robot stands in cell (0, 0) of the frame: walls begin 35 cells to its right, in the ninth quarter.
    plain, walled = (shown.planes for shown in seen)
    own = np.argwhere(plain[12] == 1)[0]
    changed = np.flatnonzero((walled[4:8] - plain[4:8] > 0.5).any(axis=(0, 1)))
    assert changed.min() == own[1] + 4 and changed.max() == SIDE - 1


def test_settings_are_checked():
    bad_extents = ({"extent": (0.0, 0.0, 1.0)}, {"extent": (0.0, 5.0, 9.0, 5.0)})
    for bad in ({"most": 0}, {"most_loss_m": -1.0}, {"tries": 0}, *bad_extents):
        with pytest.raises(ValueError, match="must be"):
            agents.make("learned-tour", config=bad)


def test_its_policy_comes_with_where_it_is_from():
    network, about = load_station_policy(SHIPPED)
    assert about["command"].startswith("mecanum study learned-tour") and min(map(len, about["curves"])) > 1
    known, robot = rooms(1), (65, 65)
    found, visited = stop(known, robot)
    openings = options(found, LUCK, most=5, most_loss_m=40.0)
    shown = picture(known, visited, robot, CELL_M, found)
    targets, hops = (pixels(found.cells[at], robot, shown) for at in (openings.targets, openings.hops))
    costs = network.costs_m(shown, targets, hops, openings)
    assert costs.shape == openings.losses.shape and np.isfinite(costs).all() and math.isfinite(costs.std())


def test_several_networks_say_the_mean_of_what_each_says():
    ensemble, _ = load_station_policy(SHIPPED)
    weights = load_file(SHIPPED)
    assert len(ensemble.members) == 2
    known, robot = rooms(1), (65, 65)
    found, visited = stop(known, robot)
    openings = options(found, LUCK, most=5, most_loss_m=40.0)
    shown = picture(known, visited, robot, CELL_M, found)
    targets, hops = (pixels(found.cells[at], robot, shown) for at in (openings.targets, openings.hops))
    alone = [StationNetwork(own).costs_m(shown, targets, hops, openings) for own in apart(weights)]
    np.testing.assert_allclose(ensemble.costs_m(shown, targets, hops, openings), np.mean(alone, axis=0))
    assert np.abs(alone[0] - alone[1]).max() > 0.1


def test_a_policy_is_named_by_its_file_and_a_damaged_one_refused(tmp_path):
    weights = load_file(SHIPPED)
    path = tmp_path / "mine.safetensors"
    save_file(weights, path)
    path.with_suffix(".json").write_text(SHIPPED.with_suffix(".json").read_text())
    assert isinstance(agents.make(str(path)), LearnedTour)
    weights.pop("members.1.up_1.first.bias")
    save_file(weights, path)
    with pytest.raises(ValueError, match=r"mine.*up_1\.first\.bias"):
        agents.make("learned-tour", config={"policy": str(path)})
    path.with_suffix(".json").write_text(json.dumps({"format": "another"}))
    with pytest.raises(ValueError, match="format"):
        agents.make("learned-tour", config={"policy": str(path)})
