"""An episode as a Rerun recording: map, poses, scans, landmarks and what was measured, on one timeline.

Everything lies in the belief's frame, z up. The timeline ``time`` is the episode's own, in seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mecanum_env.config import LidarConfig, RobotConfig
from slam.formats import replacing
from slam.geometry import wrap
from slam.types import Array
from training.episodes.playback import ellipses, map_origin, maps
from training.episodes.recording import Recording
from training.runs.errors import needs_extra

__all__ = ["check_rerun", "write_rerun"]

APPLICATION = "mecanum-slam"
TIMELINE = "time"

_BODY_HEIGHT_M, _LANDMARK_HEIGHT_M = 0.14, 0.01
_SCAN_Z_M, _PATH_Z_M, _LANDMARK_Z_M = 0.03, 0.02, 0.04  # above the map, which would hide them
_SCAN_PX, _PATH_PX, _LANDMARK_PX = 1.2, 1.2, 3.0  # radii on the screen
_EYE = 1.05  # how high the eye is, in heights of the map

# Red, green, blue: those of the films and pictures.
_BELIEVED, _TRUE, _PLANNED, _LANDMARK = (44, 96, 205), (22, 140, 112), (222, 92, 42), (178, 38, 128)


def check_rerun() -> None:
    """Raise :class:`BadInput` where the library is missing, before an episode is run in vain."""
    with needs_extra("rerun", "--rerun"):
        import rerun  # noqa: F401


def write_rerun(
    recording: Recording, path: str | Path, *, robot: RobotConfig, lidar: LidarConfig, name: str = "episode"
) -> None:
    """Write an episode as a Rerun recording (.rrd) with its blueprint; docs/how-to/exports.md lists the entities.

    ``name`` is what the viewer calls it.

    Raises
    ------
    BadInput
        Where the package ``rerun-sdk`` is missing.
    """
    check_rerun()
    import rerun as rr

    with replacing(path) as temporary:
        stream = rr.RecordingStream(APPLICATION)
        stream.save(temporary, default_blueprint=_blueprint(recording))
        stream.send_recording_name(name)
        log = _Log(stream, recording)
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        log.map()
        log.robot("world/true", recording.true_poses, robot, _TRUE, solid=False)
        log.robot("world/believed", recording.estimates, robot, _BELIEVED, solid=True)
        log.scans("world/believed/lidar", lidar)
        log.plans()
        log.landmarks()
        log.curves()
        stream.flush()
        stream.disconnect()


class _Log:
    """A recording stream, told by step what it is told by time."""

    def __init__(self, stream: Any, recording: Recording) -> None:
        import rerun

        self.rr, self.stream, self.recording = rerun, stream, recording

    def columns(self, entity: str, steps: Sequence[int] | NDArray[np.integer[Any]], columns: Any) -> None:
        times = self.recording.times[np.asarray(steps, int)]
        self.stream.send_columns(entity, [self.rr.TimeColumn(TIMELINE, duration=times)], columns, strict=True)

    def style(self, entity: str, archetype: Any, colour: tuple[int, int, int], px: float) -> None:
        """Say once what all of an entity's points or lines look like."""
        look = archetype.from_fields(colors=[colour], radii=self.rr.Radius.ui_points(px))
        self.stream.log(entity, look, static=True)

    def map(self) -> None:
        rr = self.rr
        steps, cells = [], []
        rows = cols = 0
        for step, classes in maps(self.recording):
            rows, cols = classes.shape
            steps.append(step)
            cells.append(classes[::-1].tobytes())  # an image: its first row is the highest y
        x, y = map_origin(self.recording)
        n = len(steps)
        image = rr.components.ImageFormat(width=cols, height=rows, color_model="L", channel_datatype="U8")
        columns = rr.GridMap.columns(
            data=cells, format=[image] * n, cell_size=[self.recording.resolution] * n,
            translation=[(x, y, 0.0)] * n, colormap=[rr.components.Colormap.RvizMap] * n,
        )  # fmt: skip
        self.columns("world/map", steps, columns)

    def robot(
        self, entity: str, poses: Array, robot: RobotConfig, colour: tuple[int, int, int], *, solid: bool
    ) -> None:
        """Log a robot that moves, and the way it has come: a piece of it a step."""
        rr = self.rr
        steps = np.arange(len(poses))
        flat = np.zeros(len(poses))
        self.columns(
            entity, steps,
            rr.Transform3D.columns(
                translation=np.column_stack([poses[:, :2], flat]), quaternion=_quaternions(poses[:, 2])
            ),
        )  # fmt: skip
        half_sizes = [[0.5 * robot.length_m, 0.5 * robot.width_m, 0.5 * _BODY_HEIGHT_M]]
        fill = rr.components.FillMode.Solid if solid else rr.components.FillMode.MajorWireframe
        body = rr.Boxes3D(
            half_sizes=half_sizes, centers=[[0.0, 0.0, 0.5 * _BODY_HEIGHT_M]], colors=[colour], fill_mode=fill
        )
        self.stream.log(f"{entity}/body", body, static=True)
        ahead = rr.Arrows3D(vectors=[[0.4 * robot.length_m, 0.0, 0.0]], origins=[[0.0, 0.0, 1.2 * _BODY_HEIGHT_M]])
        self.stream.log(f"{entity}/ahead", ahead, static=True)
        points = np.column_stack([poses[:, :2], np.full(len(poses), _PATH_Z_M)])
        path = f"{entity}_path"
        self.style(path, rr.LineStrips3D, colour, _PATH_PX)
        self.columns(path, steps[1:], rr.LineStrips3D.columns(strips=np.stack([points[:-1], points[1:]], axis=1)))

    def scans(self, entity: str, lidar: LidarConfig) -> None:
        """Log each scan as points in the lidar's own frame, which the believed robot carries."""
        rr = self.rr
        scan = self.recording.scan
        rays = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
        rays = np.column_stack([np.cos(rays), np.sin(rays), np.zeros(len(rays))])
        self.stream.log(entity, rr.Transform3D(translation=[lidar.offset_m, 0.0, _SCAN_Z_M]), static=True)
        self.style(f"{entity}/scan", rr.Points3D, _TRUE, _SCAN_PX)
        points = [
            rays[returned := np.isfinite(ranges)] * ranges[returned, None]
            for ranges in (values.astype(np.float64) for values in self.recording.scans.values)
        ]
        columns = rr.Points3D.columns(positions=np.concatenate(points))
        self.columns(f"{entity}/scan", self.recording.scans.steps, columns.partition([len(p) for p in points]))

    def plans(self) -> None:
        rr = self.rr
        goals = self.recording.goals
        strips = [np.column_stack([path, np.full(len(path), _PATH_Z_M)]) for path in goals.values]
        columns = rr.LineStrips3D.columns(strips=[s for s in strips if len(s)])
        self.style("world/plan", rr.LineStrips3D, _PLANNED, _PATH_PX)
        self.columns("world/plan", goals.steps, columns.partition([int(len(s) > 0) for s in strips]))

    def landmarks(self) -> None:
        """Log the landmarks, and of each its 3σ ellipse, flat."""
        rr = self.rr
        noted = self.recording.landmarks
        rows = np.concatenate(noted.values)
        counts = [len(values) for values in noted.values]
        centres = np.column_stack([rows[:, :2], np.full(len(rows), _LANDMARK_Z_M)])
        axes, directions = ellipses(rows)
        half_sizes = np.column_stack([axes, np.full(len(rows), _LANDMARK_HEIGHT_M)])
        self.style("world/landmarks", rr.Points3D, _LANDMARK, _LANDMARK_PX)
        self.columns("world/landmarks", noted.steps, rr.Points3D.columns(positions=centres).partition(counts))
        rims = rr.Ellipsoids3D.from_fields(colors=[_LANDMARK], fill_mode=rr.components.FillMode.Solid)
        self.stream.log("world/landmarks/ellipses", rims, static=True)
        columns = rr.Ellipsoids3D.columns(
            half_sizes=half_sizes, centers=centres, quaternions=_quaternions(directions)
        )
        self.columns("world/landmarks/ellipses", noted.steps, columns.partition(counts))

    def curves(self) -> None:
        recording = self.recording
        off = recording.true_poses - recording.estimates
        curves = {
            "coverage": recording.coverage,
            "error/position_m": np.hypot(off[:, 0], off[:, 1]),
            "error/heading_rad": np.abs(wrap(off[:, 2])),
            "nees": recording.nees,
            "health": recording.health,
            "collisions": recording.collisions.astype(np.float64),
        }
        steps = np.arange(len(recording.times))
        for entity, values in curves.items():
            self.columns(entity, steps, self.rr.Scalars.columns(scalars=values))


def _blueprint(recording: Recording) -> Any:
    """Return the layout that the viewer begins with: the scene from above, the curves below."""
    import rerun.blueprint as rrb

    row0, col0, row1, col1 = (index * recording.resolution for index in recording.bounds())
    x, y = 0.5 * (col0 + col1), 0.5 * (row0 + row1)
    height = _EYE * max(row1 - row0, 0.6 * (col1 - col0))  # the view is wider than high
    eye = rrb.EyeControls3D(
        position=(x, y - 0.01, height), look_target=(x, y, 0.0), eye_up=(0.0, 0.0, 1.0),
        kind=rrb.Eye3DKind.Orbital,
    )  # fmt: skip
    since_start = rrb.VisibleTimeRanges(
        timeline=TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    paths: Any = {f"world/{name}_path": [since_start] for name in ("true", "believed")}
    scene = rrb.Spatial3DView(origin="world", name="Episode", eye_controls=eye, overrides=paths)
    curves = [
        rrb.TimeSeriesView(origin="/", contents=[f"/{entity}"], name=title)
        for entity, title in (
            ("coverage", "Coverage"), ("error/position_m", "Position error [m]"),
            ("error/heading_rad", "Heading error [rad]"), ("nees", "NEES of the pose"),
        )
    ]  # fmt: skip
    folded = rrb.SelectionPanel(state="collapsed"), rrb.TimePanel(state="collapsed")
    return rrb.Blueprint(rrb.Vertical(scene, rrb.Horizontal(*curves), row_shares=[3, 1]), *folded)


# ---- helpers ---------------------------------------------------------------------------------------------------


def _quaternions(headings: Array) -> Array:
    """Return turns about z as quaternions ``(n, 4)``: x, y, z, w."""
    zero = np.zeros(len(headings))
    return np.column_stack([zero, zero, np.sin(0.5 * headings), np.cos(0.5 * headings)])
