"""The teams that a benchmark's options ask for."""

from __future__ import annotations

from mecanum_env.team.config import TeamConfig
from training.episodes.team import read_team
from training.runs.options import refuse_team_options, whole_numbers

__all__ = ["teams_of"]


def teams_of(
    robots: str, *, communication: str | None, range_m: float | None, starts: str | None, unknown_starts: bool
) -> tuple[TeamConfig | None, ...]:
    """Return the teams of ``--robots 1,2,3`` and ``--communication range,none``; None is one robot alone."""
    counts = whole_numbers("--robots", robots, low=1, high=64)
    if counts == [1]:
        refuse_team_options(
            communication=communication, range_m=range_m, starts=starts, unknown_starts=unknown_starts
        )
    words = [None] if communication is None else list(dict.fromkeys(map(str.strip, communication.split(","))))
    found: list[TeamConfig | None] = [None] if 1 in counts else []
    for count in counts:
        found += [
            read_team(None, {
                "robots": count, "communication": {"model": word, "range_m": range_m}, "starts": starts,
                "known_starts": False if unknown_starts else None,
            })
            for word in words
            if count > 1
        ]  # fmt: skip
    return tuple(found)
