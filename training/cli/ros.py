"""``mecanum ros`` on the command line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from training.runs import options as opt
from training.runs.errors import BadInput, bad_input, check_writable

__all__ = ["ros"]

_Topic = typer.Option(metavar="TOPIC")


def ros(
    agent: Annotated[str, typer.Option(help="Who decides where to go, or a policy file.")] = "brisk-tour",
    slam: opt.Slam = None,
    robot: opt.Robot = None,
    noise: opt.Noise = None,
    config: opt.ConfigFile = None,
    max_speed: Annotated[
        float | None, typer.Option(min=0.01, max=10, help="m/s.  [default: the robot's, 0.8]")
    ] = None,
    max_turn: Annotated[
        float | None, typer.Option(min=0.01, max=20, help="rad/s.  [default: the robot's, 1.5]")
    ] = None,
    scan: Annotated[str, _Topic] = "/scan",
    odom: Annotated[str, _Topic] = "/odom",
    cmd_vel: Annotated[str, _Topic] = "/cmd_vel",
    map_topic: Annotated[str, typer.Option("--map", metavar="TOPIC")] = "/map",
    pose: Annotated[str, _Topic] = "/pose",
    stamped: Annotated[bool, typer.Option("--stamped", help="cmd_vel as a TwistStamped.")] = False,
    mount: Annotated[
        str | None,
        typer.Option(metavar="X,Y,DEG", help="Where the lidar is, m and degrees.  [default: by /tf_static]"),
    ] = None,
    late_s: Annotated[
        float, typer.Option(min=0.05, max=10, help="It stands after so long without a scan or odometry, s.")
    ] = 0.5,
    seed: opt.Seed = 0,
    out: opt.Out = Path("out/ros"),
) -> None:
    """Map and explore with a real robot: a ROS 2 node that hears a lidar and odometry, and drives.

    Needs ROS 2 (rclpy). Publishes cmd_vel, /map (latched), the transform map → odom, and /pose. The robot stands
    when scans or odometry are late, when the belief is lost, and at the end: Ctrl-C, which writes map.pgm and
    map.yaml into --out. It was made for robots that drive to any side. See docs/how-to/ros.md before it moves.

    \b
    Examples:
      mecanum ros --slam graph-slam --agent brisk-tour --max-speed 0.3
      mecanum ros --scan /front/scan --odom /wheel/odometry --mount 0.2,0,180
      mecanum ros --config my-robot.toml --cmd-vel /base/cmd_vel --stamped
    """  # noqa: D301
    from training.ros.node import Topics, check_ros, run

    check_ros()
    check_writable(out, ("map.pgm", "map.yaml"))
    with bad_input():
        from mecanum_env.arguments import make_config
        from slam.logs import parse_mount
        from training.ros.driver import Driver

        world = make_config(config=config, slam=slam, robot=robot, noise=noise)
        limits = {"max_speed_m_s": max_speed, "max_turn_rate_rad_s": max_turn}
        body = replace(world.robot, **{name: value for name, value in limits.items() if value is not None})
        driver = Driver(
            replace(world, robot=body), agent, mount=None if mount is None else parse_mount(mount), seed=seed,
            late_s=late_s,
        )  # fmt: skip
    topics = Topics(scan=scan, odom=odom, cmd_vel=cmd_vel, map=map_topic, pose=pose, stamped=stamped)
    if not run(driver, topics, out):
        raise BadInput(f"no map: {driver.status}")
    print(f"wrote {out}/map.pgm and map.yaml")
