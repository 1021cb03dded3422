"""``mecanum benchmark``: agents × backends × suites × seeds, kept row by row; see ``docs/how-to/benchmark.md``."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import tomli_w

import agents
from mecanum_env.arguments import make_config
from mecanum_env.team.config import TeamConfig
from mecanum_env.team.team import JOINT_SLAM
from slam.formats import atomic_write
from slam.settings import check_name, to_mapping
from training.benchmark import store as benchmark_store
from training.benchmark import suites
from training.benchmark.episode import EpisodeFailure, EpisodeJob, EpisodeRow, Key, run_job
from training.benchmark.figures import Group, group_rows, with_regrets
from training.benchmark.output import FILES, Report, markdown, write_tables
from training.benchmark.suites import NOMINAL, SPLITS, Place, Suite
from training.benchmark.team_episode import TeamJob
from training.episodes.explore import LEAST_STEPS, STEPS_PER_M2, read_run_table
from training.episodes.room_pictures import parse_seeds
from training.episodes.team import refuse_bounds
from training.runs.campaign import Workers, backend_names, keep_settings, run_all
from training.runs.config_files import read_config
from training.runs.errors import BadInput, bad_input, one_line
from training.runs.provenance import behind_agent, code_digest, modules_of_backend, short_digest
from training.runs.running import versions
from training.runs.typed import parts_of
from training.truth.known_map import KNOWN_MAPS, KnownMap

__all__ = ["BenchmarkPlan", "EpisodesFailed", "benchmark"]

DEFAULT_BASELINE = "nearest-frontier"
_MOST_SEEDS = 10_000
_EPISODE = "training.benchmark.episode"  # the code that makes a row, with all that it imports
_TEAM_EPISODE = "training.benchmark.team_episode"
_BOUND = (KnownMap.__module__,)


class EpisodesFailed(Exception):
    """Errors ended some of the episodes; the rows of the others are kept and their tables written.

    Attributes
    ----------
    report : Report
        Of the others.
    """

    def __init__(self, message: str, report: Report) -> None:
        super().__init__(message)
        self.report = report


@dataclass(frozen=True, kw_only=True)
class BenchmarkPlan:
    """What was asked for, checked."""

    suites: tuple[Suite, ...]
    agents: tuple[str, ...]
    backends: tuple[str, ...]
    split: str
    seeds: tuple[int, ...] | None  # None: the split's
    baseline: str | None  # the agent that the others are compared with
    max_steps: int | None
    teams: tuple[TeamConfig | None, ...] = (None,)  # None: one robot alone
    robot: str | None = None  # a preset, with its lidar and noise
    config: Path | None = None  # a file that says what robot, lidar, noise, rewards, … are like

    @classmethod
    def parse(
        cls, *, suite: str | None, agents: str, slam: str | None, split: str = "test", seeds: str | None = None,
        baseline: str | None = None, floor_plans: Path | None = None, max_steps: int | None = None,
        teams: tuple[TeamConfig | None, ...] = (None,), robot: str | None = None, config: Path | None = None,
    ) -> BenchmarkPlan:  # fmt: skip
        """Check options as typed; :class:`BadInput` says what is allowed."""
        with bad_input():
            names = _agent_names(agents)
            if any(team is not None for team in teams):
                refuse_bounds(names)
            world = make_config(config=config, robot=robot)
            joint = any(team is not None and team.belief == "joint" for team in teams)
            backends = tuple(backend_names(slam if slam is not None else JOINT_SLAM if joint else world.slam))
            if joint and backends != (JOINT_SLAM,):
                raise ValueError(f"a joint belief is one {JOINT_SLAM} over all robots; leave out --slam {slam}")
            check_name("split", split, SPLITS)
            chosen = tuple(parse_seeds(seeds, most=_MOST_SEEDS)) if seeds is not None else None
            if baseline is not None and baseline not in names:
                raise ValueError(f"--baseline {baseline} is none of --agents {','.join(names)}; add it there")
            if suite is None:
                suite = "apartments" if floor_plans is None else suites.FLOOR_PLANS
            which = suites.choose(suite, floor_plans=floor_plans)
        if config is not None:
            read_run_table(config)
        if baseline is None and DEFAULT_BASELINE in names:
            baseline = DEFAULT_BASELINE
        return cls(
            suites=which, agents=names, backends=backends, split=split, seeds=chosen, baseline=baseline,
            max_steps=max_steps, teams=teams, robot=robot, config=config and config.absolute(),
        )  # fmt: skip

    def settings(self) -> dict[str, Any]:
        """Return what every row depends on, whichever it is."""
        limit: Any = self.max_steps or {"least": LEAST_STEPS, "per_m2": STEPS_PER_M2}
        world: dict[str, Any] = {} if self.robot is None else {"robot": self.robot}
        if self.config is not None:
            world["config"] = read_config(self.config, {})[0]
        return {"max_steps": limit, **world, **versions()}

    def _world(self, suite: Suite, place: Place) -> dict[str, Any]:
        """Return robot, noise, rooms and configuration of the episodes of a suite at a place.

        A robot, or a configuration, has a noise of its own, which stands for the nominal one.
        """
        own = suite.noise == NOMINAL and (self.robot is not None or self.config is not None)
        return {
            "robot": self.robot, "config": self.config, "noise": None if own else suite.noise,
            "rooms": place.rooms,
        }  # fmt: skip

    def _seeds_of(self, suite: Suite) -> list[int]:
        return list(self.seeds or suite.seeds(self.split))

    def _told_teams(self) -> dict[str, Any]:
        """Return the settings of the teams under their name, nothing where there are none."""
        teams = [to_mapping(team) for team in self.teams if team is not None]
        return {"teams": teams} if teams else {}

    @cached_property
    def jobs(self) -> tuple[EpisodeJob, ...]:
        """Every episode; all agents get to a seed before any gets to the next."""
        found = [
            (rank, _job(
                team, suite=suite.name, place=place.name, seed=seed, agent=agent, slam=backend,
                floor_plan=place.floor_plan, max_steps=self.max_steps, **self._world(suite, place),
            ))
            for suite in self.suites
            for place in suite.places
            for backend in self.backends
            for agent in self.agents
            for team in self.teams
            for rank, seed in enumerate(self._seeds_of(suite))
        ]  # fmt: skip
        return tuple(job for _, job in sorted(found, key=lambda pair: pair[0]))

    def made_by(self) -> dict[Key, str]:
        """Return the key of each job → digest of all that its row is made by but the seed.

        Raises
        ------
        BadInput
            For an agent that cannot be made without settings of its own, or code whose source is not found.
        """
        made = {name: (_BOUND, "") if name in KNOWN_MAPS else behind_agent(name) for name in self.agents}
        modules_of_backends = {name: modules_of_backend(name) for name in self.backends}
        common = json.dumps(self.settings(), sort_keys=True)
        places = {(suite.name, place.name): place for suite in self.suites for place in suite.places}
        configs = {(s.name, b): self._config_text(s, b) for s in self.suites for b in self.backends}

        @cache
        def digest(suite: str, place: str, agent: str, backend: str, team: TeamConfig | None) -> str:
            modules, told = made[agent]
            episode = _EPISODE if team is None else _TEAM_EPISODE
            code = code_digest(episode, *modules, *modules_of_backends[backend])
            parts = (code, told, common, configs[suite, backend], place, places[suite, place].digest)
            extra = () if team is None else (json.dumps(to_mapping(team), sort_keys=True),)
            return short_digest(part.encode() for part in (*parts, *extra))

        teams = ((job, job.team if isinstance(job, TeamJob) else None) for job in self.jobs)
        return {job.key: digest(job.suite, job.place, job.agent, job.slam, team) for job, team in teams}

    def config_text(self) -> str:
        """Return the effective configuration of the first suite and backend as TOML; [run] has what varies."""
        run: dict[str, Any] = {
            "suites": {s.name: {"noise": s.noise, "places": [p.name for p in s.places]} for s in self.suites},
            "agents": list(self.agents),
            "backends": list(self.backends),
            "split": self.split if self.seeds is None else "given seeds",
            "seeds": {s.name: self._seeds_of(s) for s in self.suites},
            "step_limit": self.settings()["max_steps"],
            "versions": versions(),
        }
        if self.baseline is not None:
            run["baseline"] = self.baseline
        run |= self._told_teams()
        return self._config_text(self.suites[0], self.backends[0]) + "\n" + tomli_w.dumps({"run": run})

    def described(self) -> dict[str, Any]:
        """Return what was asked for, as a report tells it."""
        return {
            "suites": [suite.name for suite in self.suites],
            "agents": list(self.agents),
            "backends": list(self.backends),
            "split": self.split if self.seeds is None else None,
            "seeds": {s.name: self._seeds_of(s) for s in self.suites},
            "baseline": self.baseline,
            **self._told_teams(),
            **self.settings(),
        }

    def _config_text(self, suite: Suite, backend: str) -> str:
        place = suite.places[0]
        config = make_config(slam=backend, **self._world(suite, place))
        plan = config.floor_plan if place.floor_plan else None  # a file's own gives way to the suite's rooms
        return tomli_w.dumps(to_mapping(replace(config, floor_plan=plan)))


def benchmark(plan: BenchmarkPlan, *, out: Path, workers: Workers) -> Report:
    """Run the episodes that ``out`` does not hold yet, write the tables, and return what they hold.

    Raises
    ------
    BadInput
        For a folder that cannot be used, or rows in it that other code or settings made.
    Interrupted
        On Ctrl-C; running it again goes on.
    EpisodesFailed
        After the tables of the other episodes are written.
    """
    made_by = plan.made_by()
    keep_settings(out, plan.settings(), FILES, holds_runs=_holds_rows)
    failures: list[tuple[EpisodeJob, EpisodeFailure]] = []
    with benchmark_store.Store(out / benchmark_store.FILE) as store:
        missing = _missing(plan, store, made_by, out)
        atomic_write(out / "config.toml", plan.config_text())

        def keep(job: EpisodeJob, result: EpisodeRow | EpisodeFailure) -> None:
            if isinstance(result, EpisodeFailure):
                failures.append((job, result))
                return
            try:
                store.add(job, result, made_by=made_by[job.key])
            except ValueError as error:  # of an agent or a backend that puts something else into a row
                failures.append((job, EpisodeFailure(message=one_line(error))))

        # Even one worker is a process of its own: the libraries' threads, and with them the roundings, are the
        # same in any number of workers.
        run_all(missing, run_job, workers=workers, keep=keep, what="episodes", apart=True)
        groups = _groups(plan, store)
    report = Report.of(groups, baseline=plan.baseline, config=plan.described())
    write_tables(out, report)
    atomic_write(out / "tables.md", markdown(report))
    if failures:
        job, first = failures[0]
        failed = EpisodesFailed(
            f"{len(failures)} of {len(missing)} episodes failed, the first on {job.suite} ({job.place}) with seed "
            f"{job.seed}, {job.agent}, {job.slam}: {first.message}; the others are kept in {out}",
            report,
        )
        failed.add_note(first.trace)  # a traceback of this error shows that one, too
        raise failed
    return report


def _holds_rows(out: Path) -> bool:
    path = out / benchmark_store.FILE
    if not path.exists():
        return False
    with benchmark_store.Store(path) as store:
        return bool(store.made_by())


def _missing(
    plan: BenchmarkPlan, store: benchmark_store.Store, made_by: dict[Key, str], out: Path
) -> list[EpisodeJob]:
    there, missing = store.made_by(), []
    for job in plan.jobs:
        wanted = made_by[job.key]
        if job.key not in there:
            missing.append(job)
        elif there[job.key] != wanted:
            raise BadInput(
                f"{out} holds rows of {job.agent} with {job.slam} on {job.suite} that other code, configuration "
                "or plans made; choose another --out"
            )
    return missing


def _groups(plan: BenchmarkPlan, store: benchmark_store.Store) -> list[Group]:
    order = {s.name: k for k, s in enumerate(plan.suites)}
    jobs = sorted(plan.jobs, key=lambda job: order[job.suite])  # stable: agents as they were given, then seeds
    return with_regrets(group_rows(list(store.rows(job.key for job in jobs))))


def _job(team: TeamConfig | None, **about: Any) -> EpisodeJob:
    return EpisodeJob(**about) if team is None else TeamJob(team=team, **about)


def _agent_names(text: str) -> tuple[str, ...]:
    chosen = tuple(parts_of(text))
    for name in chosen:
        agents.check(name, *KNOWN_MAPS)
    return chosen
