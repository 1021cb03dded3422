"""What files and options get wrong: one line with the key or option, what is allowed, what was given."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest
import typer

from mecanum_env.arguments import make_config
from mecanum_env.config import from_toml
from tests.arguments import parts, refused
from training.cli.app import app, main
from training.cli.study import STUDIES, study_command


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("coverage_target = nan", "EnvConfig.coverage_target"),
        ("[robot]\nmass_kg = -1", "EnvConfig.robot.mass_kg"),
        ("[lidar]\nbeams = 1_000_000_000", "EnvConfig.lidar.beams"),
        ("[noise]\npatch_friction = [0.3, 0.1]", "EnvConfig.noise.patch_friction"),
        ("robot = 3", "EnvConfig.robot"),
        ("[[robot]]\nmass_kg = 3.0", "EnvConfig.robot"),
        ("rooms_config = 3", "EnvConfig.rooms_config"),
    ],
)  # fmt: skip
def test_a_file_says_which_key_is_wrong(text: str, path: str, tmp_path: Path) -> None:
    file = tmp_path / "room.toml"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"room\.toml") as caught:
        from_toml(file)
    refused(caught.value, path)


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ('slam = "ekf"\n[slam_config.odometry]\nlever_m = inf', "slam_config.odometry.lever_m"),
        ("[slam_config]\nodometry = 3", "slam_config.odometry"),
        ("[rooms_config]\nfurniture = 2", "rooms_config.furniture"),
        (
            'odometry_filter = "differential-transform"\n[odometry_filter_config]\nmodel = 3',
            "odometry_filter_config.model",
        ),
    ],
)  # fmt: skip
def test_a_part_of_a_file_says_which_key_is_wrong(text: str, path: str, tmp_path: Path) -> None:
    file = tmp_path / "room.toml"
    file.write_text(text)
    with pytest.raises(ValueError) as caught:
        make_config(config=file)
    refused(caught.value, path)


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("[ppo]\ngamma = nan", "TrainConfig.ppo.gamma"),
        ("[ppo]\nenvironments = 1e308", "TrainConfig.ppo.environments"),
        ("[world]\nseeds = [5, 3]", "TrainConfig.world.seeds"),
        ('policy = "drive"\n[lessons]\nshaken = -1', "DriveConfig.lessons.shaken"),
        ("members = 1_000_000_000_000", "TrainConfig.members"),
    ],
)
def test_a_trainings_file_says_which_key_is_wrong(
    text: str, path: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.toml").write_text(text)
    assert main(["train", "--config", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert path in said and said.count("\n") == 1


def commands() -> dict[str, Any]:
    """Return every command and study."""
    top: dict[str, Any] = dict(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    return top | {f"study {name}": study_command(name) for name in STUDIES}


@pytest.mark.parametrize(("name", "command"), commands().items(), ids=list(commands()))
def test_options_that_are_numbers_are_bounded(name: str, command: Any) -> None:
    hints = get_type_hints(inspect.unwrap(command.callback), include_extras=True)
    for option in command.params:
        hint = hints.get(option.name)
        if get_origin(hint) is not Annotated or parts(hint)[0] not in (int, float):
            continue
        bounds = get_args(hint)[1]
        assert bounds.min is not None and bounds.max is not None, f"{name} {option.opts[0]} has no bounds"
        for word in ("nan", "inf", "-inf", "1e308", "-1e308", str(10**30), "x", "", "1j"):
            with pytest.raises(Exception, match="got") as caught:
                command.make_context(name, [option.opts[0], word])
            assert type(caught.value).__name__ == "BadParameter", (option.opts, word)
            assert option.opts[0] in caught.value.format_message()  # type: ignore[attr-defined]


@pytest.mark.parametrize("words", [["explore", "--coverage-target", "nan"], ["speed", "--beams", "1000000000"]])
def test_an_option_out_of_bounds_is_one_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    said = capsys.readouterr().err
    assert words[1] in said and words[2] in said and said.count("\n") == 1
