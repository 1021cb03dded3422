"""Lessons for the learned tour, and what learns from them."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from agents.learned.station_network import SIDE, StationNetwork, opening_numbers, picture, pixels
from agents.stations.sensor import BLIND
from agents.stations.survey import begin, find_pieces, first_hop, no_pieces, options, survey
from slam.grids.occupancy import UNKNOWN
from training.cli import main
from training.dungeons import networks as dungeon_networks
from training.dungeons.episode import _Run
from training.dungeons.lessons import gather, lessons_of, read_lessons
from training.dungeons.plans import dungeon_plan, loops
from training.dungeons.training import TrainingConfig, batch_of, train, turned
from training.dungeons.walks import BLIND_REACH, LUCK, MOST, REACH, LearnedDriver, TourDriver, Walk
from training.dungeons.world import CELL_M, SENSORS, Lattice, frontier_points

# ---- plans -----------------------------------------------------------------------------------------------------


def test_plans_are_like_the_published_maps():
    shares, plans = [], [dungeon_plan(seed) for seed in range(12)]
    for plan in plans:
        tiles = np.array([[plan.free[int(12.5 * i) + 3, int(12.5 * j) + 3] for j in range(20)] for i in range(20)])
        assert plan.free.shape == (250, 250) and plan.free[plan.start] and loops(tiles) == 1
        assert not tiles[[0, -1]].any() and not tiles[:, [0, -1]].any()
        shares.append(tiles.mean())
        # All of it can be reached: an episode by the nearest way-point sees every free cell but a few.
    assert 0.38 < np.mean(shares) < 0.46
    assert len({plan.start for plan in plans}) > 6
    again = dungeon_plan(3)
    np.testing.assert_array_equal(again.free, plans[3].free)
    assert again.start == plans[3].start


# ---- lessons ---------------------------------------------------------------------------------------------------


def test_a_walk_sees_and_counts_as_the_protocol_does():
    """Stations, ways, pieces and what is worth a visit, against the protocol's own count at every stop."""
    plan = dungeon_plan(4)
    walk, run = Walk(plan), _Run(plan, continuous=False, sensor=SENSORS[0])
    for _ in range(12):
        run.look()
        found = walk.survey()
        lattice = Lattice(walk.known, plan.start)
        np.testing.assert_array_equal(walk.known, run.known)
        np.testing.assert_array_equal(found.cells, lattice.cells)
        np.testing.assert_array_equal(found.pieces, frontier_points(walk.known))
        np.testing.assert_array_equal(found.worth, run.worth)
        np.testing.assert_allclose(found.way * CELL_M, run._length)
        np.testing.assert_array_equal(found.before, run._before)
        target = begin(found, LUCK)
        hop = found.cells[first_hop(found.before, found.places[0], target)]
        walk.hop((int(hop[0]), int(hop[1])))
        run.hop_towards(target)
    assert walk.path_m == pytest.approx(run.path_m)


def test_the_rest_of_the_tour_is_what_the_tour_takes():
    walk = Walk(dungeon_plan(2))
    blind = dict(known=walk.known, pieces=walk.pieces, visited=walk.visited, first=walk.plan.start, cell_m=CELL_M)

    def next_cell():
        found = survey(robot=walk.cell, reach=BLIND_REACH, sensor=BLIND, **blind)
        if not found.worth.any():
            return None
        hop = first_hop(found.before, found.places[0], begin(found, LUCK[:2]))
        return int(found.cells[hop][0]), int(found.cells[hop][1])

    hop = next_cell()
    (foreseen,) = TourDriver().finish([walk.after(hop)])
    assert walk.path_m == 0.0 and not walk.visited[hop]
    while (cell := next_cell()) is not None:
        walk.hop(cell)
    assert walk.path_m == pytest.approx(foreseen)
    assert (walk.plan.free & (walk.known == UNKNOWN)).sum() <= 25


def test_robots_driven_together_come_as_far_as_alone():
    torch.manual_seed(1)
    driver = LearnedDriver(dungeon_networks.StationNetwork())
    plans = [dungeon_plan(seed) for seed in range(3)]
    together = driver.finish([Walk(plan) for plan in plans])
    for plan, length in zip(plans, together, strict=True):
        walk = Walk(plan)
        while (stop := walk.stop()) is not None:
            (choice,) = driver.choose([stop])
            walk.hop(stop.hop_cell(choice))
        # Half precision: where two openings are as good, the batch may decide.
        assert walk.path_m == pytest.approx(length, rel=0.15)
        assert (plan.free & (walk.known == UNKNOWN)).sum() <= 25


def test_where_nothing_is_news_the_robot_that_goes_on_goes_with_the_tour(monkeypatch):
    driver = LearnedDriver(dungeon_networks.StationNetwork())
    walk = Walk(dungeon_plan(0))
    while len((stop := walk.stop()).openings.targets) < 2:
        walk.hop(stop.hop_cell(0))
    worst = torch.tensor([[-float(k) for k in range(MOST)]])
    monkeypatch.setattr(driver, "_network", lambda *_: (worst, None))
    other = walk.after(stop.hop_cell(0))  # knows where it decided; what it decides stays its own
    assert driver.choose([stop]) == [len(stop.openings.targets) - 1]
    assert driver.choose([stop]) == [0]
    assert walk.decided_at and other.decided_at is not walk.decided_at and other.path_m > 0 == walk.path_m


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """Lessons of two plans to learn from and one to validate on."""
    out = tmp_path_factory.mktemp("run")
    gather(out / "round-1" / "lessons", range(2))
    gather(out / "round-1" / "lessons", range(1000, 1001))
    return out


def test_lessons_are_drawn_once_and_the_same_each_time(run_folder):
    folder = run_folder / "round-1" / "lessons"
    dates = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert set(dates) == {"000000.npz", "000001.npz", "001000.npz"}
    gather(folder, range(2))
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == dates
    lessons, own = read_lessons((folder, range(2))), lessons_of(1, TourDriver())
    assert len(lessons.planes) > len(own.planes) > 5
    assert own.outside.max() == 100 > own.outside.mean() > 0
    for field in dataclasses.fields(own):
        theirs = getattr(lessons, field.name)[-len(own.planes) :]
        np.testing.assert_array_equal(theirs, getattr(own, field.name))
    assert np.isfinite(own.path_m[:, :2]).all() and (own.path_m[:, 0] > 0).all()
    # What lies open in the truth is at least what is known to.
    assert (own.free.astype(int) * 4 + 1 >= own.planes[:, :4]).all()


def test_some_lessons_do_not_tell_how_far_the_plan_extends(run_folder):
    lessons = read_lessons((run_folder / "round-1" / "lessons", range(1)))
    told, untold = batch_of(lessons, np.arange(4)), batch_of(lessons, np.arange(4), np.zeros(4, np.bool_))
    beyond = lessons.outside[:4] == 100
    known = lessons.planes[:4, :8].reshape(4, 2, 4, SIDE, SIDE).sum(axis=1) > 0
    assert (told.planes[:, 4:8][beyond & ~known] == 1).all() and (
        untold.planes[:, 4:8][beyond & ~known] == 0
    ).all()
    np.testing.assert_allclose(untold.planes[:, :13], lessons.planes[:4] / 100.0, atol=1e-6)
    for batch in (told, untold):
        np.testing.assert_allclose(batch.planes[:, :8].sum(axis=1) / 4 + batch.planes[:, 13], 1.0, atol=0.06)


def test_turning_a_lesson_turns_all_of_it(run_folder):
    batch = batch_of(read_lessons((run_folder / "round-1" / "lessons", range(1))), np.arange(4))
    round_again = batch
    for _ in range(4):
        round_again = turned(round_again, 1, False)
    twice = turned(turned(batch, 0, True), 0, True)
    for field in dataclasses.fields(batch):
        for other in (round_again, twice):
            np.testing.assert_array_equal(getattr(other, field.name), getattr(batch, field.name))
    # The cells themselves, two by two to a pixel: turned as a whole they are turned within each pixel, too.
    fine = batch.planes[:, :4].reshape(4, 2, 2, SIDE, SIDE).transpose(0, 3, 1, 4, 2).reshape(4, 2 * SIDE, 2 * SIDE)
    for quarters, mirrored in ((1, False), (3, True)):
        other = turned(batch, quarters, mirrored)
        expected = np.rot90(fine, quarters, axes=(1, 2))
        expected = expected[:, :, ::-1] if mirrored else expected
        own = (
            other.planes[:, :4]
            .reshape(4, 2, 2, SIDE, SIDE)
            .transpose(0, 3, 1, 4, 2)
            .reshape(4, 2 * SIDE, 2 * SIDE)
        )
        np.testing.assert_array_equal(own, expected)
        for k in range(4):  # a place keeps what is drawn there
            before, after = batch.targets[k, 0], other.targets[k, 0]
            np.testing.assert_array_equal(
                batch.planes[k, 8:, before[0], before[1]], other.planes[k, 8:, after[0], after[1]]
            )


# ---- the network -----------------------------------------------------------------------------------------------


def test_numpy_computes_what_pytorch_does():
    torch.manual_seed(3)
    network = dungeon_networks.StationNetwork().to(memory_format=torch.channels_last)
    weights = {name: np.asarray(value.numpy(), order="C") for name, value in network.state_dict().items()}
    walk = Walk(dungeon_plan(1))
    found = walk.survey()
    openings = options(found, LUCK, most=MOST, most_loss_m=40.0)
    shown = picture(walk.known, walk.visited, walk.plan.start, CELL_M, found)
    targets, hops = (pixels(found.cells[at], walk.plan.start, shown) for at in (openings.targets, openings.hops))
    with torch.no_grad():
        numbers = torch.tensor(opening_numbers(openings.losses, openings.legs))[None]
        scores, odds = network(
            torch.tensor(shown.planes)[None], torch.tensor(targets)[None], torch.tensor(hops)[None], numbers
        )
    np.testing.assert_allclose(
        StationNetwork(weights).costs_m(shown, targets, hops, openings), 20.0 * scores[0].numpy(), atol=1e-4
    )
    assert odds.shape == (1, 4, SIDE, SIDE)


def test_training_goes_on_where_it_stopped(run_folder, tmp_path):
    config = TrainingConfig(plans=2, validation_plans=1, epochs=2, batch=8)
    whole, curve = train(run_folder, config)
    assert [point["epoch"] for point in curve] == [1, 2] and curve[1]["cost"] < 2.0 * curve[0]["cost"]
    (tmp_path / "round-1").mkdir()
    (tmp_path / "round-1" / "lessons").symlink_to(run_folder / "round-1" / "lessons")
    from training.dungeons import training as learned_tour

    kept = learned_tour._keep

    def stop(*arguments):
        kept(*arguments)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learned_tour, "_keep", stop)
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path, config)
    again, _ = train(tmp_path, config)
    for name, value in whole.state_dict().items():
        np.testing.assert_array_equal(again.state_dict()[name], value, err_msg=name)


def test_of_fewer_lessons_than_a_batch_one_batch_is_made(run_folder, tmp_path):
    (tmp_path / "round-1").mkdir()
    (tmp_path / "round-1" / "lessons").symlink_to(run_folder / "round-1" / "lessons")
    _, curve = train(tmp_path, TrainingConfig(plans=1, validation_plans=1, epochs=1, batch=1000))
    assert len(curve) == 1


def test_training_may_begin_with_a_policy_and_trusts_the_tour_more(run_folder, tmp_path):
    from safetensors.numpy import load_file

    from agents.learned.choice_network import apart
    from agents.learned_tour import SHIPPED
    from training.dungeons.training import _kept

    (tmp_path / "round-1").mkdir()
    (tmp_path / "round-1" / "lessons").symlink_to(run_folder / "round-1" / "lessons")
    config = TrainingConfig(plans=2, validation_plans=1, epochs=1, batch=8, rate=1e-9, start=str(SHIPPED))
    begun, _ = train(tmp_path, config)
    first = apart(load_file(SHIPPED))[0]
    kept = _kept(begun, 0.25)
    assert kept.keys() == first.keys()
    for name, value in first.items():
        np.testing.assert_allclose(kept[name] - (0.25 if name == "loss_share" else 0.0), value, atol=1e-5)
    other, _ = train(tmp_path, config, member=1)  # the others begin anew
    assert np.abs(_kept(other, 0.0)["up_0.first.weight"] - first["up_0.first.weight"]).max() > 0.01


def test_a_run_writes_a_policy_that_the_agent_reads(run_folder, tmp_path, capsys, monkeypatch):
    import agents
    from training.dungeons.episode import explore

    # What has learned so little goes a long way round: it is followed seldom, and not to the end.
    # (walks.MOST_HOPS is in a kernel, which would be kept with another number.)
    monkeypatch.setattr(LearnedDriver, "asked", 0.05)
    monkeypatch.setattr(LearnedDriver, "most_hops", 10)
    monkeypatch.setattr("training.dungeons.lessons.MOST_HOPS", 40)
    out = tmp_path / "run"
    (out / "round-1").mkdir(parents=True)
    (out / "round-1" / "lessons").symlink_to(run_folder / "round-1" / "lessons")
    arguments = [
        "study",
        "learned-tour",
        "--out",
        str(out),
        "--plans",
        "2",
        "--later-plans",
        "1",
        "--validation-plans",
        "1",
    ]
    arguments += ["--members", "2", "--epochs", "1", "--batch", "8"]
    assert main(arguments) == 0
    path = out / "learned-tour.safetensors"
    assert capsys.readouterr().out.strip() == str(path)
    about = json.loads(path.with_suffix(".json").read_text())
    assert about["config"]["plans"] == 2 and "--epochs=1" in about["command"]
    assert [len(curve) for curve in about["curves"]] == [1, 1, 1, 1]  # two rounds of two networks
    assert set(about["validation_path_m"]) == {"tour", "learned-tour"}
    first, second = ({p.name for p in (out / name / "lessons").iterdir()} for name in ("round-1", "round-2"))
    assert first == {*second, "000001.npz"}  # of the same plans, driven by what the first round learned
    assert agents.make(str(path)).about == about
    row = explore(dungeon_plan(5), str(path))
    assert row["end"] == "covered" and row["coverage"] > 0.99
    # The same folder for another training is refused.
    assert main([*arguments[:-1], "16"]) == 2
    assert "batch" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (["--plans", "0"], "--plans"),
        (["--plans", "1001"], "1000"),
        (["--epochs", "0"], "--epochs"),
        (["--rounds", "0"], "--rounds"),
        (["--later-plans", "1001"], "--later-plans"),
        (["--untold", "1.5"], "--untold"),
        (["--workers", "0"], "--workers"),
        (["--members", "0"], "--members"),
        (["--start", "nowhere.safetensors"], "nowhere.safetensors"),
    ],
)
def test_bad_input_is_one_line(change, says, tmp_path, capsys):
    assert main(["study", "learned-tour", "--out", str(tmp_path / "out"), *change]) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1 and not (tmp_path / "out").exists()


def test_the_tour_reaches_as_far_as_the_agent_is_told():
    import agents

    assert agents.make("learned-tour").config.stations.reach_m == pytest.approx(REACH * CELL_M)
    known = np.full((20, 20), UNKNOWN, np.int8)
    pieces = no_pieces(known.shape)
    find_pieces(known, pieces, np.array([0, 19, 0, 19]))
    assert (pieces < 0).all()
