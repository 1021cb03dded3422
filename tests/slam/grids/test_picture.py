from __future__ import annotations

import numpy as np

from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slam.grids.picture import draw_known


def test_it_is_drawn_as_it_lies_with_y_upwards_and_cropped_to_what_is_known() -> None:
    classes = np.full((200, 300), UNKNOWN, np.int8)
    classes[100:120, 100:140] = FREE
    classes[119, 100:140] = OCCUPIED  # the highest y
    grid = OccupancyGrid.from_classes(classes, 0.1, (-5.0, -8.0))
    landmark, pose = np.array([[8.0, 2.5]]), np.array([6.0, 3.0, 0.0])
    image = draw_known(grid, landmark, pose)
    scale = 480 // (40 + 16)  # a margin of eight cells on every side
    assert image.shape == (36 * scale, 56 * scale, 3)

    def at(x: float, y: float) -> list[int]:
        row, col = (y + 8.0) / 0.1 - 92, (x + 5.0) / 0.1 - 92
        return list(map(int, image[int(image.shape[0] - row * scale), int(col * scale)]))

    assert at(4.7, 1.5) == [175, 175, 175]  # nothing known
    free, wall = at(5.5, 2.3), at(5.5, 3.95)
    assert min(free) > 210 > 175 > 60 > max(wall)
    blue, _, red = at(8.0, 2.5)
    assert red > 150 > blue  # the landmark, orange
    blue, _, red = at(6.0, 3.0)
    assert blue > 150 > red  # the robot, blue
    assert at(6.45, 3.0)[0] > 150 > at(6.45, 3.0)[2] and min(at(5.55, 3.0)) > 210  # it looks along x


def test_of_nothing_known_there_is_a_picture_too() -> None:
    assert draw_known(OccupancyGrid(), np.zeros((0, 2)), np.zeros(3)).ndim == 3
