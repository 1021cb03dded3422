"""A batch of exploration environments as one of Gymnasium's vector environments."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from copy import copy as shallow_copy
from copy import deepcopy
from functools import partial
from itertools import pairwise
from typing import Annotated, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from mecanum_env.config import Steps
from mecanum_env.env import ExploreEnv
from mecanum_env.vector.board import Board
from mecanum_env.vector.workers import CALL, LISTEN, RESET, SET, STEP, Answer, Share, Worker
from slam.files import quoted
from slam.settings import Within, check_name, checked, require
from slam.types import Array, Flags, Floats

__all__ = ["ExploreVectorEnv"]

Observations = dict[str, NDArray[Any]]

_ARRAYS = spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete
"""Of what lies in shared memory."""

Environments = Annotated[int, Within("[1, 4096]")]


class ExploreVectorEnv(VectorEnv[Observations, Floats, Any]):
    """Many exploration environments, stepped by the caller and its worker processes over shared memory.

    Each is what ``gym.make`` makes, and with the same seeds all that ``reset`` and ``step`` return is as from
    Gymnasium's ``SyncVectorEnv``, bit for bit, however many workers there are::

        envs = gym.make_vec("mecanum_env/Explore-v0", num_envs=8, vectorization_mode="vector_entry_point")

    Parameters
    ----------
    num_envs : int
        How many environments.
    workers : int, optional
        Processes, each with its share of them, the caller's own among them; if left out, one a core.
    autoreset_mode : AutoresetMode or str
        As in Gymnasium: ``"NextStep"``, ``"SameStep"`` or ``"Disabled"``. With the first, other
        processes begin the next episode while the caller is still busy with the end of the last: what ``render``,
        ``call`` and ``get_attr`` show between the two is of either, by which process it is in. What is set or
        called then holds for that episode: it is begun again. Ctrl-C in the middle of a step closes them all.
    copy : bool
        Whether ``reset`` and ``step`` return copies of the observations; else views, until the next step.
    max_episode_steps : int, optional
        Steps after which an episode is truncated; None or -1: none.
    context : str, optional
        How processes are started (``"fork"``, ``"forkserver"``, ``"spawn"``); the platform's way if left out.
    make : callable, optional
        Makes one of them, instead of settings: an environment around an ``ExploreEnv``, that hands on its infos.
        Observations are a ``Dict`` of one level; they and actions are arrays, or ``Discrete``.
        It is called in the processes, so they must be able to import it.
    **settings
        Those of :class:`mecanum_env.env.ExploreEnv`.

    Raises
    ------
    ValueError
        For a number of environments or workers below one, and where ``ExploreEnv`` does.

    Attributes
    ----------
    wrappers : tuple of type
        What each environment is wrapped in, the outermost first.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        workers: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        max_episode_steps: int | None = None,
        context: str | None = None,
        make: Callable[[], gymnasium.Env[Any, Any]] | None = None,
        **settings: Any,
    ) -> None:
        super().__init__()
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        num_envs = checked("num_envs", Environments, num_envs)
        workers = cores if workers is None else checked("workers", Environments, workers)
        if isinstance(max_episode_steps, int) and max_episode_steps == -1:  # as gym.make has it
            max_episode_steps = None
        limit = None if max_episode_steps is None else checked("max_episode_steps", Steps, max_episode_steps)
        copy = checked("copy", bool, copy)
        if context is not None:
            check_name("context", context, multiprocessing.get_all_start_methods())
        require(make is None or callable(make), f"make must be a function, got {quoted(make)}")
        if not isinstance(autoreset_mode, AutoresetMode):
            check_name("autoreset_mode", autoreset_mode, [mode.value for mode in AutoresetMode])
        if make is not None and settings:
            raise ValueError(
                f"make takes the place of all settings: leave out {', '.join(settings)}, or make (gym.make_vec "
                "always gives an action: with make, call ExploreVectorEnv itself)"
            )
        make = partial(_limited, make or partial(_make, settings), limit)
        like = make()  # tells what is wrong with the settings before any process is started
        observation, action = _shareable(like)
        self.wrappers = tuple(map(type, _layers(like)))[:-1]
        mode = AutoresetMode(autoreset_mode)
        self.num_envs, self.copy = num_envs, copy
        self.metadata = {**like.metadata, "autoreset_mode": mode}
        self.render_mode = like.render_mode
        self.single_observation_space, self.single_action_space = observation, action
        self.observation_space = batch_space(observation, num_envs)
        self.action_space = batch_space(action, num_envs)
        like.close()
        processes = multiprocessing.get_context(context)
        shares = min(workers, num_envs)
        # The first is the caller's, who has more to do than its share: where they differ, the smaller one.
        edges = [num_envs * k // shares for k in range(shares + 1)]
        self._rows = [range(first, last) for first, last in pairwise(edges)]
        self._board = board = Board(processes, num_envs, observation, action, shares - 1)
        # With arrays of its own on that memory: who holds the board's is counted.
        self._own: Share | None = Share(make, shallow_copy(board), 0, len(self._rows[0]), mode)
        self._workers: list[Worker] = []
        try:
            for number, rows in enumerate(self._rows[1:]):
                self._workers.append(Worker(processes, number, make, board, rows[0], len(rows), mode))
        except BaseException:  # those that were started would wait for orders
            self.close_extras()
            raise

    # ---- Gymnasium -----------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode in every environment, or in those of ``options["reset_mask"]`` ``(num_envs,)``.

        A single seed stands for it and those that follow, one an environment.
        """
        seeds = [seed + k for k in range(self.num_envs)] if isinstance(seed, int) else seed
        seeds = [None] * self.num_envs if seeds is None else list(seeds)
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments")
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        if mask is not None and (np.shape(mask) != (self.num_envs,) or np.asarray(mask).dtype != np.bool_):
            raise ValueError(f"reset_mask must be {self.num_envs} booleans, got {mask!r}")
        chosen = np.ones(self.num_envs, np.bool_) if mask is None else mask
        if not np.any(chosen):
            raise ValueError("reset_mask chooses no environment")
        page = self._turn()
        parts = [(page, {k: seeds[k] for k in rows if chosen[k]}, options or None) for rows in self._rows]
        infos = self._infos(page, self._ask(RESET, parts))
        return self._observations(page), infos

    def step(self, actions: Floats) -> tuple[Observations, Array, Flags, Flags, dict[str, Any]]:
        """Step every environment by its row of the actions ``(num_envs, a)``, in the action space's precision."""
        board = self._board
        if np.shape(actions) != board.actions.shape:
            raise ValueError(f"actions must be {board.actions.shape}, got {np.shape(actions)}")
        if not _taken(actions, board.actions):  # before any environment has stepped
            what = "finite numbers in [-1, 1]" if board.actions.dtype.kind == "f" else "whole numbers"
            raise ValueError(f"actions must be {what}, got {quoted(actions)}")
        number = self._turn()
        page, infos = board.pages[number], self._infos(number, self._step(number))
        return (
            self._observations(number), page.rewards.copy(), page.terminated.copy(), page.truncated.copy(), infos,
        )  # fmt: skip

    def render(self) -> tuple[Any, ...] | None:
        """Return a frame of each environment."""
        return self.call("render")

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Return an attribute of each environment, or what it returns where it is a method."""
        answers = self._ask(CALL, [(name, args, kwargs)] * len(self._rows))
        return tuple(value for answer in answers for value in answer)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of each environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of each environment, to its own of a list or tuple, or to the same."""
        each = list(values) if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(each) != self.num_envs:
            raise ValueError(f"{len(each)} values for {self.num_envs} environments")
        self._ask(SET, [(name, {k: each[k] for k in rows}) for rows in self._rows])

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The environments' random number generators, as copies."""
        return self.get_attr("np_random")

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """What they were seeded with."""
        return self.get_attr("np_random_seed")

    def close_extras(self, **kwargs: Any) -> None:
        """Have the workers quit; those that do not are ended."""
        for worker in getattr(self, "_workers", []):
            worker.quit()
        if (own := getattr(self, "_own", None)) is not None:
            own.close()
        self._workers, self._own = [], None

    # ---- between caller and workers ------------------------------------------------------------------------

    def _step(self, page: int) -> list[Any]:
        """Step all shares onto a page; return what it has no place for."""
        self._board.orders[0] = page
        return self._all(STEP, (page,), Worker.step, Worker.stepped)

    def _ask(self, command: str, parts: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Give every share its part of a command; return their results."""
        self._board.orders[0] = LISTEN
        rest = iter([Worker.order(command, *part) for part in parts[1:]])  # all, before any worker waits for one
        return self._all(command, parts[0], lambda worker: worker.tell(next(rest)), Worker.told)

    def _all(
        self, command: str, part: tuple[Any, ...], begin: Callable[[Worker], None], end: Callable[[Worker], Answer]
    ) -> list[Any]:
        """Have the workers begin, do the caller's own part, and return all results, or raise what one raised."""
        if self._own is None:
            raise gymnasium.error.ClosedEnvironmentError("the environments are closed; make them anew")
        try:
            for worker in self._workers:
                begin(worker)
            try:
                answers: list[Answer] = [(None, getattr(self._own, command)(*part))]
            except Exception as error:  # the others' answers first
                answers = [(error, None)]
            answers += [end(worker) for worker in self._workers]
        except (EOFError, BrokenPipeError, ConnectionResetError) as error:
            self.close()
            raise RuntimeError("a worker process has ended; make the environments anew") from error
        except BaseException:  # Ctrl-C: some have done it and some have not
            self.close()
            raise
        for raised, _ in answers:
            if raised is not None:
                raise raised
        return [result for _, result in answers]

    def _turn(self) -> int:
        """Return the page to write next: where the caller keeps what it is given, one that it holds nothing of."""
        return self._board.free_page() if self.copy else self._board.spare

    def _observations(self, page: int) -> Observations:
        return self._board.pages[page].lend(copy=self.copy and page == self._board.spare)

    def _infos(self, page: int, rests: list[dict[int, dict[str, Any]]]) -> dict[str, Any]:
        # Terms of a wrapper's own are added below, and must not be to the board.
        own = any("reward_terms" in more for rest in rests for more in rest.values())
        infos = self._board.pages[page].infos(copy=own or page == self._board.spare)
        for rest in rests:
            for row, more in rest.items():
                infos = self._add_info(infos, more, row)
        return infos


def _taken(actions: Any, into: NDArray[Any]) -> bool:
    """Write actions into an array of their shape; tell whether they are finite numbers, as that one has them."""
    if np.iscomplexobj(actions):
        return False
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            into[:] = actions
    except (OverflowError, TypeError, ValueError):
        return False
    if into.dtype.kind != "f":  # whole numbers are not made of others
        return np.array_equal(into, actions)
    return bool(np.isfinite(into).all())


def _make(settings: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    return ExploreEnv(**deepcopy(settings))


def _shareable(env: gymnasium.Env[Any, Any]) -> tuple[spaces.Dict, spaces.Space[Any]]:
    """Return an environment's spaces; ``ValueError`` where the board has no place for what is of them."""
    observation, action = env.observation_space, env.action_space
    parts = list(observation.values()) if isinstance(observation, spaces.Dict) else [observation]
    if not isinstance(observation, spaces.Dict) or not all(isinstance(part, _ARRAYS) for part in [*parts, action]):
        env.close()
        names = ", ".join(kind.__name__ for kind in _ARRAYS)
        raise ValueError(
            f"make: shared memory holds a one-level Dict of {names}, and actions of these; got observations "
            f"{quoted(observation)}, actions {quoted(action)}; Gymnasium's SyncVectorEnv takes any "
            '(vectorization_mode="sync")'
        )
    return observation, action


def _layers(env: gymnasium.Env[Any, Any]) -> Iterator[gymnasium.Env[Any, Any]]:
    """Yield the wrappers of an environment, the outermost first, and the environment itself."""
    while isinstance(env, gymnasium.Wrapper):
        yield env
        env = env.env
    yield env


def _limited(
    make: Callable[[], gymnasium.Env[Any, Any]], max_episode_steps: int | None
) -> gymnasium.Env[Any, Any]:
    return make() if max_episode_steps is None else TimeLimit(make(), max_episode_steps)
