"""``mecanum replay`` on the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from training.runs import options as opt
from training.runs.errors import Interrupted
from training.runs.progress import Progress
from training.runs.typed import LAST_SEED

__all__ = ["replay"]


def replay(
    log: Annotated[
        Path,
        typer.Argument(
            metavar="LOG",
            help="ROS 2 bag, CARMEN or DP-SLAM log; UTIAS: Robot1_Odometry.dat or folder; Victoria Park: folder.",
        ),
    ],
    slam: Annotated[str | None, typer.Option(help="SLAM backend.  [default: invariant-ekf]")] = None,
    association: Annotated[
        str | None, typer.Option(help="known or unknown landmark ids.  [default: known where the log has them]")
    ] = None,
    robot: Annotated[int | None, typer.Option(min=1, max=100, help="Which robot of a UTIAS folder.")] = None,
    reference: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Log of the same scans with corrected poses.  [default: none]"),
    ] = None,
    scan_topic: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="Of a bag: LaserScan.  [default: /scan, or the only one]")
    ] = None,
    odom_topic: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC", help="Of a bag: Odometry, or /tf.  [default: /odom, the only one, or odom in /tf]"
        ),
    ] = None,
    reference_topic: Annotated[
        str | None,
        typer.Option(metavar="TOPIC", help="Of a bag: Odometry or PoseStamped, the true path.  [default: none]"),
    ] = None,
    mount: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,DEG", help="Of a bag: where the lidar is, m and degrees.  [default: by its transforms]"
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, max=LAST_SEED, help="Of backends that draw samples.  [default: 0]")
    ] = None,
    limit_s: Annotated[
        float | None, typer.Option(min=0.001, max=1e9, help="Stop after so many seconds of the log.")
    ] = None,
    config: opt.ConfigFile = None,
    out: opt.Out = Path("out/replay"),
    as_json: opt.Json = False,
) -> None:
    """Run a SLAM backend on the recorded log of a real robot, and compare it with the log's reference.

    Writes into --out: trajectory_estimate.tum, trajectory_true.tum, trajectory.png, landmarks.db (SQLite),
    landmarks.csv, config.toml and metrics.json; of a log with scans also map.png and map.pgm with map.yaml (ROS
    map_server). Ctrl-C ends the replay and keeps it as far as it came.

    \b
    Examples:
      mecanum replay utias6/Robot1_Odometry.dat.gz --slam ekf --out out/utias1
      mecanum replay utias6 --robot 3 --association unknown --json
      mecanum replay victoria_park --slam ekf --limit-s 300 --out out/park
      mecanum replay rosbag2_2026_01_31 --slam graph-slam --scan-topic /front/scan --out out/bag
      mecanum replay intel.gfs.log.gz --reference intel-corrected.log.gz --slam invariant-ekf
    """  # noqa: D301
    from training.replay import report as replay_report
    from training.replay import run as task

    with opt.json_alone(as_json):
        prepared = task.prepare(
            log, out=out, robot=robot, reference=reference, slam=slam, association=association, seed=seed,
            limit_s=limit_s, config=config, scan_topic=scan_topic, odom_topic=odom_topic,
            reference_topic=reference_topic, mount=mount,
        )  # fmt: skip
        whole_s = prepared.log.duration_s
        with Progress("replaying", whole_s) as progress:
            task.run(prepared, lambda time_s: progress.show(time_s, f"{time_s:.0f} of {whole_s:.0f} s"))
        metrics = replay_report.write(prepared)
    print(
        json.dumps(metrics, ensure_ascii=False) if as_json else replay_report.summary(metrics, out, prepared.files)
    )
    if prepared.interrupted:
        raise Interrupted(f"interrupted after {metrics['duration_s']:.1f} s of the log; what was done is in {out}")
