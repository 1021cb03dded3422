from __future__ import annotations

import math
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import pytest

from mecanum_env import rooms
from mecanum_env.config import LidarConfig, RobotConfig
from mecanum_env.env import ExploreEnv
from mecanum_env.ground_truth import GroundTruth
from mecanum_env.rooms.files.importers import from_raster
from mecanum_env.views import canvas
from mecanum_env.views.canvas import FLOOR, ROBOT, WALL, Canvas, View, _round_length
from mecanum_env.views.paint import FRONTIER, LANDMARK, PLANNED_PATH
from mecanum_env.views.pictures import draw_map, draw_truth, episode_view
from mecanum_env.views.render import FRAME_SHAPE, frontier_cells, render_frame
from slam.geometry import inverse, transform_points
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid


def explored(steps: int = 60, **kwargs: Any) -> ExploreEnv:
    """Return an environment in which the robot drove in an arc from a start that is turned in the plan."""
    plan = rooms.make("rectangular", seed=3)
    plan = plan.with_start((plan.start[0], plan.start[1], 0.7))
    env = gym.make("mecanum_env:mecanum_env/Explore-v0", render_mode="rgb_array", disable_env_checker=True)
    env.reset(seed=3, options={"floor_plan": plan})
    inner = env.unwrapped
    assert isinstance(inner, ExploreEnv)
    for _ in range(steps):
        inner.step(np.array([0.2, 0.1, 0.3], np.float32))
    return inner


@pytest.fixture(scope="module")
def env() -> ExploreEnv:
    return explored()


def mask_of(image: np.ndarray, bgr: tuple[int, int, int], *, rgb: bool = False) -> np.ndarray:
    colour = bgr[::-1] if rgb else bgr
    return np.all(np.abs(image.astype(int) - colour) < 12, axis=2)


def centre(mask: np.ndarray) -> np.ndarray:
    rows, cols = np.nonzero(mask)
    return np.array([cols.mean(), rows.mean()])


def test_without_a_font_of_its_own_opencv_is_given_letters_that_it_has(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(canvas, "_font", lambda: None)
    told: list[str] = []
    monkeypatch.setattr(cv2, "putText", lambda image, text, *_: told.append(text))
    monkeypatch.setattr(cv2, "getTextSize", lambda text, *_: (told.append(text) or (0, 0), 0))
    for text in ("– steps/s", "cave, seed 1 …", "landmark, 3σ", "büro.png"):
        canvas.put_text(np.zeros((9, 9, 3), np.uint8), text, (0, 0), canvas.INK)
        canvas.text_width(text)
    spelt = ("- steps/s", "cave, seed 1 ...", "landmark, 3sigma", "b?ro.png")
    assert told == [text for text in spelt for _ in range(2)], "written, and measured alike"


def test_a_frame_is_rgb_of_one_size_and_changes_nothing(env: ExploreEnv) -> None:
    frame = env.render()
    assert frame is not None and frame.shape == (*FRAME_SHAPE, 3) == (720, 1280, 3) and frame.dtype == np.uint8
    assert frame.flags["C_CONTIGUOUS"] and frame.flags["OWNDATA"]
    assert np.array_equal(frame, env.render())
    left = frame[:, :640]
    # The robot in its own colour: red, green, blue.
    assert np.count_nonzero(mask_of(left, ROBOT, rgb=True)) > 300
    assert np.count_nonzero(mask_of(left, ROBOT)) == 0
    looked_at, left_alone = explored(20), explored(20)
    looked_at.render()
    action = np.array([0.5, 0.0, -0.2], np.float32)
    one, two = looked_at.step(action), left_alone.step(action)
    assert np.array_equal(one[0]["map_local"], two[0]["map_local"]) and one[1] == two[1]


def test_truth_and_belief_are_drawn_to_one_scale(env: ExploreEnv) -> None:
    frame = render_frame(env)
    robot_left = centre(mask_of(frame[:, :640], ROBOT, rgb=True))
    goal = env.belief.pose[None, :2]  # a dot where the robot believes to be, over the belief
    marked = render_frame(env, planned_path=goal + np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]))
    way = mask_of(marked[60:, 640:], PLANNED_PATH, rgb=True)
    rows, cols = np.nonzero(way)
    # The far end is one metre right of and above the pose; panels are 632 pixels apart.
    end = np.array([cols[rows < rows.min() + 8].mean() + 640, rows.min() + 60 + 4.0])
    scale = (end[0] - (robot_left[0] + 632.0), robot_left[1] - end[1])
    assert scale[0] == pytest.approx(scale[1], abs=5.0) and scale[0] > 40.0


def test_the_planned_path_may_come_with_the_environment(env: ExploreEnv) -> None:
    path = env.belief.pose[None, :2] + np.array([[0.0, 0.0], [0.5, 0.5]])
    plain, given = render_frame(env), render_frame(env, planned_path=path)
    env.planned_path = path  # type: ignore[attr-defined]
    try:
        attached = render_frame(env)
    finally:
        del env.planned_path  # type: ignore[attr-defined]
    assert np.array_equal(given, attached) and not np.array_equal(plain, given)


def test_a_view_puts_metres_where_they_belong() -> None:
    view = View.fit((-1.0, -2.0, 3.0, 0.0), 400, 400)
    assert view.scale == 100.0
    # The box is centred: y from −3 to 1. Pixels count from the centre of the first, in sixteenths.
    assert view.pixels(np.array([(-1.0, 1.0), (3.0, -3.0), (0.0, 0.0)])).tolist() == [
        [-8, -8], [6392, 6392], [1592, 1592],
    ]  # fmt: skip
    wide = View.around((0.0, 0.0, 4.0, 1.0), longest_px=800)
    assert (wide.width, wide.height, wide.scale) == (800, 200, 200.0) or wide.scale == 150.0
    far = view.pixels(np.array([(1e300, -1e300)]))
    assert np.all(np.abs(far) < 2**31)


@pytest.mark.parametrize("frame", [None, np.array([0.3, -0.4, 0.9])])
def test_rasters_lie_where_points_do(frame: np.ndarray | None) -> None:
    view = View.fit((-2.0, -2.0, 2.0, 2.0), 500, 300)
    matrix = view.raster_matrix(0.05, (-0.3, 0.2), frame)
    for col, row in ((0, 0), (7, 3)):
        point = np.array([[-0.3 + (col + 0.5) * 0.05, 0.2 + (row + 0.5) * 0.05]])
        point = point if frame is None else transform_points(frame, point)
        expected = view.pixels(point)[0] / 16.0
        assert matrix @ (col, row, 1.0) == pytest.approx(expected, abs=0.05)


def test_an_ellipse_has_the_covariances_axes() -> None:
    view = View.fit((-1.0, -1.0, 1.0, 1.0), 400, 400)
    canvas = Canvas(np.zeros((400, 400, 3), np.uint8), view)
    turn = np.array([[math.cos(0.6), -math.sin(0.6)], [math.sin(0.6), math.cos(0.6)]])
    cov = turn @ np.diag([0.2**2, 0.08**2]) @ turn.T
    canvas.ellipses(np.array([(0.1, -0.1)]), cov[None], LANDMARK, sigmas=3.0)
    rows, cols = np.nonzero(mask_of(canvas.image, LANDMARK))
    points = np.stack([(cols + 0.5) / 200.0 - 1.0 - 0.1, 1.0 - (rows + 0.5) / 200.0 + 0.1], axis=1) @ turn
    assert np.abs(points[:, 0]).max() == pytest.approx(0.6, abs=0.02)
    assert np.abs(points[:, 1]).max() == pytest.approx(0.24, abs=0.02)


def test_frontiers_are_free_cells_beside_unseen_ones() -> None:
    classes = np.full((20, 24), UNKNOWN, np.int8)
    classes[4:12, 4:16] = FREE
    classes[4, 4:16] = OCCUPIED  # a wall below: no frontier behind it
    classes[18, 2:4] = FREE  # a speck
    grid = OccupancyGrid.from_classes(classes, 0.1, (0.0, 0.0))
    cells = frontier_cells(grid)
    row0, col0 = (-o for o in grid.lattice_origin)
    expected = np.zeros((20, 24), bool)
    expected[5:12, 4:16] = True
    expected[5:11, 5:15] = False
    assert np.array_equal(cells[row0 : row0 + 20, col0 : col0 + 24], expected)
    assert np.count_nonzero(cells) == np.count_nonzero(expected)


def test_frontiers_show_in_the_frame(env: ExploreEnv) -> None:
    young = explored(1)
    assert np.count_nonzero(mask_of(render_frame(young)[60:, 640:], FRONTIER, rgb=True)) > 50


def test_the_map_shows_each_class_where_it_is(env: ExploreEnv) -> None:
    belief, truth = env.belief, env.truth
    view = episode_view(truth.ground, belief, longest_px=900)
    believed = draw_map(belief, truth.record.estimates, view=view, title="a room")
    true = draw_truth(truth.ground, truth.record.true_poses, view=view, title="a room")
    assert believed.shape == true.shape == (view.height + 64, view.width, 3)
    assert max(view.width, view.height) <= 900
    classes = belief.grid.classes()
    grey = {FREE: 255, OCCUPIED: 62}
    for value, level in grey.items():
        cells = np.argwhere(classes == value)
        cols, rows = (view.pixels(belief.grid.to_points(cells)) // 16).T
        inside = (rows >= 0) & (rows < view.height) & (cols >= 0) & (cols < view.width)
        hit = np.abs(believed[rows[inside], cols[inside], 1].astype(int) - level) < 40
        # Paths, landmarks and the robot cover some.
        assert inside.all() and hit.mean() > 0.8
        if value == FREE:
            floor = true[rows, cols, 1] > 240
            assert floor.mean() > 0.8


def test_the_end_of_the_path_is_the_robot(env: ExploreEnv) -> None:
    view = episode_view(env.truth.ground, env.belief, longest_px=900)
    true = draw_truth(env.truth.ground, env.truth.record.true_poses, view=view)
    at = centre(mask_of(true, ROBOT))
    expected = view.pixels(env.truth.pose[None, :2])[0] / 16.0
    # The arrow on its back is cut out, a little ahead of the middle.
    assert np.hypot(*(at - expected)) < 0.15 * view.scale


@pytest.mark.parametrize(
    ("longest", "length"), [(1.0, 1.0), (1.9, 1.0), (2.0, 2.0), (7.0, 5.0), (0.49, 0.2), (35.0, 20.0)]
)
def test_scale_bars_are_round(longest: float, length: float) -> None:
    assert _round_length(longest) == pytest.approx(length)


def test_a_pillar_is_solid_however_thick() -> None:
    free = np.zeros((80, 80), bool)
    free[5:75, 5:75] = True
    free[30:50, 30:50] = False
    plan = from_raster(free, name="pillar", resolution=0.05, start=(0.8, 0.8, 0.4))
    ground = GroundTruth(plan, np.array(plan.start), robot=RobotConfig(), lidar=LidarConfig(), resolution=0.05)
    view = View.fit((-2.0, -2.0, 4.0, 4.0), 600, 600)
    image = draw_truth(ground, np.zeros((1, 3)), view=view)
    for point, colour in (((2.0, 2.0), WALL), ((1.0, 2.0), FLOOR), ((3.0, 3.0), FLOOR), ((0.2, 2.0), WALL)):
        ((col, row),) = view.pixels(transform_points(inverse(ground.start), np.array([point]))) // 16
        assert tuple(image[row, col]) == colour, point
