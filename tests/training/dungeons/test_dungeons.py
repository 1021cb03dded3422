"""The dungeons protocol: maps, scans and hops as the published benchmark has them, and a command that goes on."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest

import agents
from agents.base import Agent, Goal
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from tests.slam.logs.logs_on_disk import data_folder
from training.cli import main
from training.dungeons import episode as dungeon_episode
from training.dungeons.bound import known_map_path, known_walls_path
from training.dungeons.episode import NEAREST, NEAREST_VIEW, explore, make_agent
from training.dungeons.plans import dungeon_plan
from training.dungeons.protocol import run_dungeons, summarise, table
from training.dungeons.world import SENSORS, Dungeon, Lattice, dungeon_of, frontier_points, layout, load
from training.runs.errors import BadInput

WALL, OPEN, START = 127, 195, 208


def pixels(*rooms: tuple[int, int, int, int], start: tuple[int, int], size: int = 200) -> np.ndarray:
    """A picture of ``size`` pixels a side with free rectangles (row, column, rows, columns) and a start patch."""
    picture = np.full((size, size), WALL, np.uint8)
    for row, col, rows, cols in rooms:
        picture[row : row + rows, col : col + cols] = OPEN
    picture[start[0] : start[0] + 24, start[1] : start[1] + 24] = START
    return picture


def hall() -> np.ndarray:
    """A hall of 40 × 12 cells whose start sees all of it."""
    return pixels((60, 20, 24, 80), start=(60, 20))


def corridor(length_m: float) -> Dungeon:
    """A straight corridor 3.6 m wide, the start in its left end."""
    cells = round(length_m / 0.4)
    free = np.zeros((30, cells + 20), bool)
    free[10:19, 10 : 10 + cells] = True
    return Dungeon("corridor", free, (14, 12))


def write(folder, **pictures) -> None:
    folder.mkdir(exist_ok=True)
    for name, picture in pictures.items():
        cv2.imwrite(str(folder / f"{name}.png"), picture)


# ---- the world -------------------------------------------------------------------------------------------------


def test_a_map_is_pooled_by_its_minimum_and_starts_in_the_patch(tmp_path):
    picture = hall()
    picture[59, 20:100] = OPEN  # half a cell more: not free, with a wall in its other half
    write(tmp_path, a=picture)
    dungeon = load(tmp_path / "a.png")
    assert dungeon.free.shape == (100, 100) and dungeon.free.sum() == 12 * 40
    assert dungeon.free[30, 10] and not dungeon.free[29, 10]
    # The patch is 12 cells high and wide; of its first row, the eleventh.
    assert dungeon.start == (30, 20)


@pytest.mark.parametrize("what", ["missing", "empty", "text", "no start"])
def test_a_map_that_is_none_is_refused_in_one_line(what, tmp_path):
    path = tmp_path / "1.png"
    if what == "no start":
        cv2.imwrite(str(path), np.full((20, 20), OPEN, np.uint8))
    elif what != "missing":
        path.write_bytes(b"" if what == "empty" else b"no picture")
    with pytest.raises(BadInput) as error:
        load(path)
    assert "1" in str(error.value) and "\n" not in str(error.value)


def test_a_map_turned_or_mirrored_is_the_same_layout():
    plan, other = dungeon_plan(3), dungeon_plan(4)
    for free in (np.rot90(plan.free), plan.free[::-1], np.rot90(plan.free, 3)[:, ::-1], np.roll(plan.free, 1, 1)):
        assert layout(Dungeon("turned", np.ascontiguousarray(free), (0, 0))) == layout(plan)
    assert layout(other) != layout(plan)


def test_way_points_and_hops():
    dungeon = corridor(40.0)
    known = np.where(dungeon.free, FREE, OCCUPIED).astype(np.int8)
    lattice = Lattice(known, dungeon.start)
    # Rows 10 … 18 hold one row of way-points, every ten cells from the start on.
    np.testing.assert_array_equal(np.unique(lattice.cells[:, 0]), [14])
    np.testing.assert_array_equal(np.diff(lattice.cells[:, 1]), 10)
    here = lattice.index(*dungeon.start)
    length, before = lattice.ways(here)
    assert length[here] == 0 and length[-1] == pytest.approx(4.0 * (len(length) - 1))
    assert before[-1] == len(length) - 2  # as many stops as can be had for the same length
    assert max(lattice.joined[here]) == 2  # a hop passes one way-point at most
    assert lattice.index(14, 13) == -1 and lattice.index(-6, 12) == -1
    assert len(frontier_points(known)) == 0 and not lattice.sees.any()


def test_frontiers_are_counted_by_squares():
    known = np.full((40, 40), OCCUPIED, np.int8)
    known[8:24, 8:24] = FREE
    known[8:24, 24:32] = UNKNOWN
    points = frontier_points(known)
    assert (points[:, 1] == 23).all() and len(points) == 4  # 16 cells, in squares of four
    # In sight up to 16 m; and one square alone makes no visit worth it.
    lattice = Lattice(known, (10, 10))
    assert lattice.sees[lattice.index(10, 10)] == 4
    everywhere = np.ones(len(lattice.cells), bool)
    visited = np.zeros(known.shape, bool)
    assert lattice.worth_a_visit(everywhere, visited).all()
    visited[10, 10] = True
    assert not lattice.worth_a_visit(everywhere, visited)[lattice.index(10, 10)]


# ---- an episode ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sensor", "hops"), [("wide", 9), ("public", 13)])
@pytest.mark.parametrize("name", ["nearest-frontier", "tour", "learned-tour"])
def test_a_corridor_is_as_long_as_it_is(name, sensor, hops):
    """The end, at 54.4 m from the start, comes into sight from 36 m: nine hops of 4 m.

    Rays that graze the walls near the end hit every cell of them from the last way-point only: thirteen hops.
    """
    dungeon = corridor(55.6)
    row = explore(dungeon, name, sensor=sensor)
    assert row["end"] == "covered" and row["unseen_cells"] == 0 and row["coverage"] == 1.0
    assert row["path_m"] == pytest.approx(4.0 * hops) and row["hops"] == hops
    again = explore(dungeon, name, sensor=sensor)
    row.pop("decision_ms_median")
    again.pop("decision_ms_median")
    assert row == again


def test_the_simplest_rule_goes_to_the_nearest_way_point_worth_a_visit(monkeypatch):
    """Every hop leads on the shortest way to a way-point that no other one worth a visit is nearer than."""
    hops = []
    hop_towards = dungeon_episode._Run.hop_towards

    def spy(run, station):
        hops.append((run._length[station], run._length[run.worth].min(), bool(run.worth[station])))
        hop_towards(run, station)

    monkeypatch.setattr(dungeon_episode._Run, "hop_towards", spy)
    dungeon = dungeon_of(pixels((20, 20, 30, 150), (20, 140, 150, 30), start=(22, 24)), "corner")
    row = explore(dungeon, NEAREST)
    assert row["end"] == "covered" and row["unseen_cells"] <= 3 and row["decision_ms_median"] is None
    assert len(hops) == row["hops"] > 3
    assert all(length == nearest and worth for length, nearest, worth in hops)


@pytest.mark.parametrize("seed", [3, 1003])
def test_nearest_frontier_on_stations_is_the_published_rule(seed):
    """From its belief alone, what the protocol says from its own count: the same path, hop for hop."""
    plan = dungeon_plan(seed)
    rule, agent, view = (explore(plan, name) for name in (NEAREST, "nearest-frontier", NEAREST_VIEW))
    assert agent["end"] == view["end"] == "covered"
    assert (agent["path_m"], agent["hops"]) == (rule["path_m"], rule["hops"]) != (view["path_m"], view["hops"])


def test_bounds_see_what_they_say():
    """A dead end of 30 m: its last wall is in sight of the sensor from farther than from 16 m."""
    dungeon = corridor(31.6)
    assert known_map_path(dungeon) == pytest.approx(12.0)
    assert known_walls_path(dungeon) == pytest.approx(16.0)
    assert known_walls_path(dungeon_of(hall(), "hall")) == 0.0


def test_one_look_is_enough():
    dungeon = dungeon_of(hall(), "hall")
    row = explore(dungeon, "nearest-frontier", sensor="wide")
    assert (row["path_m"], row["hops"], row["end"], row["path_to_250_m"]) == (0.0, 0, "covered", 0.0)
    assert row["decision_ms_median"] is None
    assert known_map_path(dungeon) == 0.0


def test_a_sensor_that_shows_the_cells_beside_its_rays_needs_less_way():
    plan = dungeon_plan(3)
    public, wide = (explore(plan, "nearest-frontier", sensor=sensor) for sensor in SENSORS)
    assert public == explore(plan, "nearest-frontier") | {"decision_ms_median": public["decision_ms_median"]}
    assert public["end"] == wide["end"] == "covered" and wide["path_m"] < 0.95 * public["path_m"]
    assert known_map_path(plan, "wide", tries=1) <= known_map_path(plan, tries=1) < public["path_m"]
    assert make_agent("tour", sensor="wide").config.stations.sensor == "wide"


def test_scanning_on_the_way_sees_no_less():
    dungeon = dungeon_of(pixels((20, 20, 30, 150), (20, 140, 150, 30), start=(22, 24)), "corner")
    by_stops, by_the_way = (explore(dungeon, "nearest-frontier", scan=how) for how in dungeon_episode.SCANS)
    assert by_stops["end"] == by_the_way["end"] == "covered"
    assert by_the_way["path_m"] <= by_stops["path_m"] + 1e-9
    assert 0.0 < known_map_path(dungeon) <= by_stops["path_m"]


class Stubborn(Agent):
    """Wants to go where it can see nothing new, for ever."""

    def choose(self, belief):
        return Goal(pose=np.array([0.2, 0.2, 0.0]), path=np.array([[0.2, 0.2]]))

    def act(self, observation, belief):
        return np.zeros(3, np.float32)


def test_an_agent_that_gets_nowhere_is_stuck(monkeypatch):
    monkeypatch.setattr(dungeon_episode, "make_agent", lambda name, extent_m, sensor: Stubborn())
    row = explore(corridor(95.6), "stubborn")
    assert row["end"] == "stuck" and 0 < row["hops"] < 20


def test_agents_are_set_up_as_far_as_they_can_be():
    assert make_agent("tour").config.stations.spacing_m == 4.0
    assert make_agent("nearest-frontier").config.frontiers.view_range_m == 16.0
    assert make_agent("nearest-frontier").config.stations.spacing_m == 4.0
    assert make_agent(NEAREST_VIEW).config.stations.spacing_m == 0.0
    assert make_agent("learned-tour", (80.0, 60.0)).config.extent == (0.0, 0.0, 80.0, 60.0)
    assert isinstance(make_agent("random"), Agent)


# ---- the command -----------------------------------------------------------------------------------------------


def test_runs_are_kept_and_gone_on_with(tmp_path, monkeypatch, capsys):
    maps, out = tmp_path / "maps", tmp_path / "out"
    write(maps, **{"2": hall(), "10": pixels((20, 20, 30, 150), start=(22, 24))})
    arguments = [
        "benchmark",
        "--protocol",
        "dungeons",
        "--maps",
        str(maps),
        "--agents",
        "nearest-frontier,tour",
        "--out",
        str(out),
        "--json",
    ]
    assert main(arguments) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["agents"]["tour"]["maps"] == 2 and summary["agents"]["tour"]["covered"] == 2
    assert summary["agents"]["nearest-frontier"]["ratio"] == 1.0
    store = out / "rows.jsonl"
    rows = store.read_text().splitlines()
    assert len(rows) == 4
    csv = (out / "rows.csv").read_text().splitlines()
    assert [line.split(",")[:2] for line in csv[1:3]] == [["nearest-frontier", "2"], ["tour", "2"]]
    # Broken off in the middle of a row: only that one is run again.
    store.write_text("\n".join(rows[:3]) + "\n" + rows[3][:20])
    ran = []
    import training.dungeons.protocol as command

    real = command._run
    monkeypatch.setattr(command, "_run", lambda files, job: ran.append(job) or real(files, job))
    assert run_dungeons(maps, ["nearest-frontier", "tour"], out=out)["agents"].keys() == summary["agents"].keys()
    assert ran == [tuple(json.loads(rows[3])[0])]
    assert "published: DARE" in table(summary) and "`tour`" in table(summary)
    bound = run_dungeons(maps, ["known-map", "nearest-frontier"], out=out)["agents"]["known-map"]
    assert bound["path_m_mean"] <= summary["agents"]["nearest-frontier"]["path_m_mean"] and bound["ratio"] <= 1.0
    # The same folder for another protocol is refused, and so is one whose rows an earlier version kept.
    for option, other in (("scan", "continuous"), ("sensor", "wide")):
        assert main([*arguments, f"--{option}", other]) == 2
        assert option in capsys.readouterr().err
    store.write_text(json.dumps(json.loads(rows[0])[1]) + "\n")
    assert main(arguments) == 2
    assert "earlier version" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"--agents": "nearest"}, "nearest-frontier"),
        ({"--agents": ","}, "--agents"),
        ({"--maps": "nowhere"}, "--maps"),
        ({"--maps": "."}, "no PNG"),
        ({"--scan": "always"}, "way-points"),
        ({"--sensor": "broad"}, "public"),
        ({"--workers": "0"}, "--workers"),
    ],
)
def test_bad_input_is_one_line(change, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "maps", a=hall())
    options = {"--maps": "maps", "--agents": "tour", "--out": "out"} | change
    assert main(["benchmark", "--protocol", "dungeons", *(part for item in options.items() for part in item)]) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_maps_of_odd_names_come_after_the_numbers_and_each_counts(tmp_path):
    write(tmp_path, **{"10": hall(), "2": hall(), "²": hall()})
    cv2.imwrite(str(tmp_path / "2.PNG"), hall()[:, ::-1])
    summary = run_dungeons(tmp_path, [NEAREST], out=tmp_path / "out")
    assert summary["agents"][NEAREST]["maps"] == 4
    lines = (tmp_path / "out" / "rows.csv").read_text("utf-8").splitlines()[1:]
    assert [line.split(",")[1] for line in lines] == ["2.PNG", "2.png", "10", "²"]


def test_the_ratio_is_of_means_and_has_an_interval():
    def row(agent, name, path_m):
        return {
            "agent": agent, "map": name, "layout": str(int(name) // 4), "path_m": path_m, "hops": 1,
            "coverage": 1.0, "end": "covered", "path_to_250_m": path_m, "decision_ms_median": 1.0,
        }  # fmt: skip

    rng = np.random.default_rng(0)
    base = rng.uniform(400, 800, 40)
    rows = [row("nearest-frontier", str(i), v) for i, v in enumerate(base)]
    rows += [row("tour", str(i), 0.9 * v + rng.normal(0, 20)) for i, v in enumerate(base)]
    assert summarise(rows)["tour"]["to"] == {} and summarise(rows)["tour"]["layouts"] == 10
    # Maps of one layout are no news: with each of them four times, intervals are what they are with each once.
    once = [row("nearest-frontier", str(4 * i), v) for i, v in enumerate(base)]
    once += [row("tour", str(4 * i), v + 20 * math.sin(i)) for i, v in enumerate(base)]
    often = [r | {"map": str(int(r["map"]) + k)} for r in once for k in range(4)]
    assert summarise(often)["tour"]["ratio_low"] == pytest.approx(summarise(once)["tour"]["ratio_low"], abs=1e-3)
    rows += [row("known-walls", str(i), 0.75 * v) for i, v in enumerate(base)]
    own = summarise(rows)["tour"]
    assert own["to"]["known-walls"]["ratio"] == pytest.approx(own["ratio"] / 0.75)
    lines = table({"agents": summarise(rows)}).splitlines()
    assert len({line.count("|") for line in lines}) == 1 and "to known-walls" in lines[0]
    assert any("nearest frontier" in line and "| 1.307 |" in line for line in lines)
    assert own["ratio"] == pytest.approx(0.9, abs=0.02)
    assert own["ratio_low"] < own["ratio"] < own["ratio_high"] < 0.93
    # Who gives up half of the maps has short paths there, which do not count.
    gone = [r | {"end": "nothing left", "path_m": 10.0} if r["agent"] == "tour" and int(r["map"]) % 8 < 4 else r
            for r in rows]  # fmt: skip
    assert summarise(gone)["tour"]["ratio"] == pytest.approx(0.9, abs=0.04)
    assert summarise(gone)["tour"]["covered"] == 20
    kept = [r["path_m"] for r in gone if r["agent"] == "tour" and r["end"] == "covered"]
    assert summarise(gone)["tour"]["path_m_mean"] == pytest.approx(np.mean(kept)), "nor in the mean"
    none = summarise([r | {"end": "stuck"} for r in gone if r["agent"] == "tour"])
    assert none["tour"]["path_m_mean"] is None is none["tour"]["hops_mean"] and none["tour"]["covered"] == 0
    assert "| `tour` | 40 (10) | 0 | – |" in table({"agents": none})
    alone = summarise([r for r in rows if int(r["map"]) < 4])["tour"]
    assert alone["ratio_low"] is None and alone["ratio"] == pytest.approx(0.9, abs=0.1)
    assert " (None" not in table({"agents": {"nearest-frontier": alone, "tour": alone}})


def test_a_published_map_is_covered():
    dungeon = load(data_folder("dungeons") / "1.png")
    assert dungeon.free.shape == (250, 250)
    row = explore(dungeon, "nearest-frontier")
    assert row["end"] == "covered" and row["coverage"] > 0.995
    assert known_map_path(dungeon, tries=2) < row["path_m"] < 1000.0


def test_agents_named_here_are_registered():
    assert {"nearest-frontier", "tour"} <= set(agents.names())
