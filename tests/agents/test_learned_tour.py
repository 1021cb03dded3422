"""The learned tour: what it is shown of a map, what it may begin with, and where it is the tour."""

from __future__ import annotations

import itertools
import json
import math

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

import agents
from agents.learned.choice_network import apart
from agents.learned.station_network import PLANES, SIDE, StationNetwork, outside, picture, pixels, with_walls
from agents.learned_tour import SHIPPED, LearnedTour, load_station_policy
from agents.stations.lattice import edges, in_sight, join, lengths, ways
from agents.stations.sensor import BLIND, SENSORS, look, rays
from agents.stations.survey import (
    STRIDE,
    VOXEL,
    Survey,
    find_pieces,
    first_hop,
    no_pieces,
    options,
    survey,
    tour,
)
from agents.ways.routing import draw_luck
from slam.belief import Belief
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

STATIONS = {"spacing_m": 4.0, "hop": 2}
LUCK = draw_luck(6, 200)
CELL_M = 0.4


def rooms(seed: int, side: int = 130) -> np.ndarray:
    """Random rectangles that are free or unknown, between walls; the middle is free."""
    rng = np.random.default_rng(seed)
    known = np.full((side, side), OCCUPIED, np.int8)
    for value, count in ((FREE, 16), (UNKNOWN, 6)):
        for _ in range(count):
            row, col, rows, cols = (*rng.integers(2, side - 40, 2), *rng.integers(8, 38, 2))
            known[row : row + rows, col : col + cols] = value
    known[side // 2 - 6 : side // 2 + 6, 5 : side - 5] = FREE
    return known


def stop(known: np.ndarray, robot: tuple[int, int]):
    """What there is to do on a station of a grid, nothing having been looked from but that."""
    visited = np.zeros(known.shape, np.bool_)
    visited[robot] = True
    pieces = no_pieces(known.shape)
    find_pieces(known, pieces, np.array([0, known.shape[0] - 1, 0, known.shape[1] - 1]))
    return survey(known, pieces, visited, robot, robot, CELL_M, 30.0, rays(SENSORS[0])), visited


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


# ---- what there is to do ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_lengths_are_those_of_the_ways(seed):
    known = rooms(seed)
    picked = known[5::STRIDE, 5::STRIDE] == FREE
    own = np.argwhere(picked)
    index = np.full(picked.shape, -1, np.int64)
    index[picked] = np.arange(len(own))
    cells = own * STRIDE + 5
    joined = join(known, cells, own, index, 2)
    to, length, count = edges(cells, joined)
    for station in range(len(cells)):
        np.testing.assert_allclose(lengths(to, length, count, station), ways(cells, joined, station)[0], atol=1e-6)


def test_pieces_are_the_same_whether_found_at_once_or_bit_by_bit():
    truth = rooms(3)
    known = np.full(truth.shape, UNKNOWN, np.int8)
    pieces = no_pieces(known.shape)
    rng = np.random.default_rng(0)
    for _ in range(30):
        row, col = rng.integers(0, 110, 2)
        known[row : row + 25, col : col + 25] = truth[row : row + 25, col : col + 25]
        find_pieces(known, pieces, np.array([row, min(row + 24, 129), col, min(col + 24, 129)]))
    whole = no_pieces(known.shape)
    find_pieces(known, whole, np.array([0, 129, 0, 129]))
    np.testing.assert_array_equal(pieces, whole)
    assert (whole >= 0).any()
    before = whole.copy()
    find_pieces(known, whole, np.array([130, -1, 130, -1]))  # nothing became known
    np.testing.assert_array_equal(whole, before)


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("seed", range(3))
def test_what_counts_as_settled_is_settled_by_a_look(seed, sensor):
    """Where all that is unknown is wall, each piece that counts, and is no near one in sight, is gone then."""
    known, robot = rooms(seed), (65, 65)
    visited = np.zeros(known.shape, np.bool_)
    pieces = no_pieces(known.shape)
    find_pieces(known, pieces, np.array([0, 129, 0, 129]))
    blind, seeing = (
        survey(known, pieces, visited, robot, robot, CELL_M, 30.0, rays_) for rays_ in (BLIND, rays(sensor))
    )
    np.testing.assert_array_equal(blind.worth, seeing.worth)
    assert set(blind.places) <= set(seeing.places) and seeing.sight.sum() > blind.sight.sum()
    near = in_sight(known, seeing.cells, seeing.pieces, 30.0)
    for place, settles in list(zip(seeing.places.tolist(), seeing.sight, strict=True))[1:]:
        shown, left = known.copy(), no_pieces(known.shape)
        look(known == FREE, *seeing.cells[place].tolist(), rays(sensor), shown)
        find_pieces(shown, left, np.array([0, 129, 0, 129]))
        rows, cols = (seeing.pieces[settles & ~near[place]] // VOXEL).T
        assert (left[rows, cols] < 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_openings_begin_differently(seed):
    found, _ = stop(rooms(seed), (65, 65))
    assert found.worth.any()
    np.testing.assert_allclose(found.distance, found.distance.T, atol=1e-6)
    assert found.worth[found.places[1:]].all() and (found.views[found.worth] >= 2).all()
    openings = options(found, LUCK, most=5, most_loss_m=40.0)
    assert 1 <= len(openings.targets) <= 5 and openings.losses[0] == 0.0
    assert len(set(openings.hops.tolist())) == len(openings.hops)  # no two by the same first hop
    assert (np.diff(openings.losses[1:]) >= 0).all() and (openings.losses <= 40.0).all()
    for target, hop, leg in zip(openings.targets, openings.hops, openings.legs, strict=True):
        assert first_hop(found.before, found.places[0], target) == hop
        assert leg == pytest.approx(found.way[target] * CELL_M)
    few = draw_luck(6, 2)  # fewer columns than places: drawn anew
    assert len(options(found, few, most=3, most_loss_m=40.0).targets) <= 3


def to_do(seed: int) -> Survey:
    """What there is to do for a robot among six places in a square of 30 m that settle nine pieces."""
    rng = np.random.default_rng(seed)
    at = rng.uniform(0.0, 30.0, (7, 2))
    seen = rng.random((6, 9)) < 0.5
    sight = np.vstack([np.zeros(9, np.bool_), seen & (rng.random((6, 9)) < 0.8)])
    seen &= sight.any(axis=0)  # any piece can be settled
    distance = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    own = np.arange(7)
    return Survey(
        np.zeros((7, 2), np.int64), own, distance[0], own > 0, own, np.zeros((9, 2), np.int64), seen, own, sight,
        distance,
    )  # fmt: skip


def shortest(found: Survey, first: int | None = None) -> float:
    """The shortest order of places, by trying all, after which no station sees two pieces that are not settled."""
    best = math.inf
    for count in range(7):
        for order in itertools.permutations(range(1, 7), count):
            left = ~found.sight[list(order)].any(axis=0)
            if (found.seen[:, left].sum(axis=1) < 2).all() and (first is None or order[:1] == (first,)):
                best = min(best, sum(found.distance[a, b] for a, b in itertools.pairwise((0, *order))))
    return best


def test_a_tour_leaves_nothing_worth_a_visit_and_is_not_much_longer_than_the_shortest():
    shares, begun = [], []
    for seed in range(12):
        found = to_do(seed)
        if shortest(found) == 0.0:
            continue
        order = tour(found, LUCK)
        left = ~found.sight[order].any(axis=0)
        assert order[0] == 0 and len(set(order.tolist())) == len(order)
        assert (found.seen[:, left].sum(axis=1) < 2).all()
        cost = sum(found.distance[a, b] for a, b in itertools.pairwise(order))
        shares.append(cost / shortest(found))
        openings = options(found._replace(before=np.zeros(7, np.int64)), LUCK, most=6, most_loss_m=1e3)
        assert openings.targets[0] == order[1]
        for target, loss in zip(openings.targets, openings.losses, strict=True):
            begun.append((cost + loss) / shortest(found, int(target)))
    assert min(shares + begun) > 1.0 - 1e-9
    assert np.mean(shares) < 1.25 and np.mean(begun) < 1.25


# ---- what the network is shown ---------------------------------------------------------------------------------


def test_the_picture_is_made_of_what_is_known():
    known = rooms(1)
    robot = (65, 65)
    found, visited = stop(known, robot)
    shown = picture(known, visited, robot, CELL_M, found)
    assert shown.planes.shape == (PLANES, SIDE, SIDE)
    assert shown.planes[:4].sum() * 25 == pytest.approx((known == FREE).sum())
    assert shown.planes[4:8].sum() * 25 == pytest.approx((known == OCCUPIED).sum())
    assert shown.planes[8].sum() == pytest.approx(0.2 * len(found.pieces), rel=1e-5)
    np.testing.assert_allclose(shown.planes[:8].sum(axis=0) / 4.0 + shown.planes[13], 1.0, atol=1e-5)
    own = pixels(np.array([robot]), robot, shown)[0]
    assert shown.planes[12, own[0], own[1]] == 1.0 == shown.planes[12].sum()
    assert shown.planes[9, own[0], own[1]] == 1.0
    farthest = int(np.argmax(np.where(np.isfinite(found.way), found.way, -1.0)))
    far = pixels(found.cells[farthest : farthest + 1], robot, shown)[0]
    assert shown.planes[10, far[0], far[1]] == pytest.approx(0.25 + 0.01 * CELL_M * found.way[farthest], rel=1e-5)
    # A quarter of a pixel, by hand: five by five cells from half a stride before the station on.
    station = found.cells[3]
    corner = known[station[0] - 5 : station[0], station[1] : station[1] + 5]
    at = pixels(found.cells[3:4], robot, shown)[0]
    assert shown.planes[1, at[0], at[1]] == pytest.approx((corner == FREE).mean(), abs=1e-5)


def test_the_picture_does_not_tell_where_on_the_map_it_is():
    known = rooms(2)
    shifted = np.pad(known, ((30, 0), (20, 0)), constant_values=UNKNOWN)
    pictures = []
    for grid, robot in ((known, (65, 65)), (shifted, (95, 85))):
        found, visited = stop(grid, robot)
        pictures.append(picture(grid, visited, robot, CELL_M, found).planes)
    without = [k for k in range(PLANES) if k not in (8, 11)]  # pieces are counted by squares of the grid
    np.testing.assert_allclose(pictures[0][without], pictures[1][without], atol=1e-6)


def test_walls_beyond_the_extent_are_drawn_cell_by_cell():
    """What the shares say is what a grid says whose cells beyond the extent are known to be walls."""
    known = rooms(2)
    robot, box = (65, 65), (3, -20, 127, 111)
    found, visited = stop(known, robot)
    shown = picture(known, visited, robot, CELL_M, found)
    beyond = outside(shown, robot, box)
    for i, j in ((0, 0), (SIDE // 2, SIDE // 2), (7, 20), (8, 19), (20, 22)):
        for quarter in range(4):
            row = (shown.corner[0] + i) * STRIDE + robot[0] % STRIDE - 5 + 5 * (quarter // 2)
            col = (shown.corner[1] + j) * STRIDE + robot[1] % STRIDE - 5 + 5 * (quarter % 2)
            inside = [
                box[0] <= r < box[2] and box[1] <= c < box[3]
                for r in range(row, row + 5)
                for c in range(col, col + 5)
            ]
            assert beyond[quarter, i, j] == pytest.approx(1.0 - np.mean(inside))
    walled = with_walls(shown.planes, beyond)
    np.testing.assert_array_equal(walled[:4], shown.planes[:4])
    np.testing.assert_array_equal(walled[8:13], shown.planes[8:13])
    assert (walled[4:8] >= shown.planes[4:8] - 1e-6).all() and walled[:8].sum(axis=0).max() <= 4.0 + 1e-5
    np.testing.assert_allclose(walled[:8].sum(axis=0) / 4.0 + walled[13], 1.0, atol=1e-5)
    assert 0 < beyond.mean() < 1 and (beyond == 1).any() and (beyond == 0).any()


def test_on_a_map_too_large_the_robot_stays_in_the_picture():
    known = np.full((60, 900), FREE, np.int8)
    known[:, 890:] = UNKNOWN
    robot = (25, 15)
    found, visited = stop(known, robot)
    shown = picture(known, visited, robot, CELL_M, found)
    assert shown.planes[12].sum() == 1.0
    own = pixels(found.cells, robot, shown)
    assert own.min() >= 0 and own.max() < SIDE


# ---- the agent -------------------------------------------------------------------------------------------------


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
