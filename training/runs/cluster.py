"""Work on a Ray cluster: the same items as in processes of this machine, and what they return comes back here.

Nothing of Ray is imported before a cluster is asked for. ``docs/how-to/cluster.md`` says how one is started.
"""

from __future__ import annotations

import functools
import os
import pickle
import queue
import signal
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2

from training.runs.errors import BadInput, needs_extra, one_line
from training.runs.processes import ONE_THREAD
from training.runs.provenance import project_digest
from training.runs.running import versions

__all__ = ["LOCAL", "RETRIES", "Cluster", "RayPool", "find_cluster", "ray_pool"]

Result = TypeVar("Result")

RETRIES = 5
"""How often an item is begun anew where its worker, or the node, died under it."""

LOCAL, RUNNING = "local", "auto"
_WITHIN_S = 30.0
_REMEDY = (
    "start one by ray start --head and give the address that it names, set RAY_AUTH_MODE=token if it asks for "
    "one, or leave the address out for a Ray of this machine alone"
)


@dataclass(frozen=True)
class Cluster:
    """Which Ray does the work."""

    address: str  # HOST:PORT of a head; auto: what runs on this machine; local: started here, ends with the work
    most: int | None = None  # items at a time; None: as many as the cluster has cores for, or gets to have


def find_cluster(address: str, most: int | None) -> Cluster:
    """Return the cluster at an address, before any work is begun.

    Raises
    ------
    BadInput
        Where Ray is not installed, or none answers at the address.
    """
    with needs_extra("ray", "--ray"):
        import ray  # noqa: F401
    if address not in (LOCAL, RUNNING):
        _check_reachable(address)
    if address != LOCAL:
        _check_answers(address)
    return Cluster(address, most)


def _check_reachable(address: str) -> None:
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or "/" in host:
        raise BadInput(f"--ray {address!r} is no address; give HOST:PORT of a cluster's head, auto or local")
    try:
        socket.create_connection((host.strip("[]"), int(port)), _WITHIN_S).close()
    except (OSError, OverflowError) as error:
        raise BadInput(f"--ray {address}: nothing answers there ({one_line(error)}); {_REMEDY}") from error


def _check_answers(address: str) -> None:
    """Ask before ``ray.init`` does, which is long in giving up, and says so in many lines."""
    where = () if address == RUNNING else ("--address", address)
    command = (sys.executable, "-m", "ray.scripts.scripts", "status", *where)
    try:
        asked = subprocess.run(command, capture_output=True, text=True, timeout=_WITHIN_S, check=False)
        problem = asked.stderr.strip().rpartition("\n")[2] if asked.returncode else ""
    except subprocess.TimeoutExpired:
        problem = f"silent for {_WITHIN_S:.0f} s"
    if problem:
        raise BadInput(f"--ray {address}: no Ray answers there ({problem[:200]}); {_REMEDY}")


# ---- on a worker -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Origin:
    """What a worker has in common with the process that handed it the work, or the results would be others."""

    code: str
    versions: tuple[tuple[str, str], ...]
    folder: Path  # that relative paths of plans, policies and results begin at

    @classmethod
    def here(cls) -> _Origin:
        return cls(project_digest(), tuple(versions().items()), Path.cwd())


@functools.cache
def _become_worker_of(origin: _Origin) -> None:
    own, host = _Origin.here(), socket.gethostname()
    for name, version in origin.versions:
        if (here := dict(own.versions).get(name, "none")) != version:
            raise BadInput(f"{host} has {name} {here}, not {version}; install the same on every node")
    if own.code != origin.code:
        raise BadInput(f"{host} has other code of mecanum-slam; install the same on every node")
    cv2.setNumThreads(1)
    with suppress(OSError):  # a node need not have the folder, as long as nobody asks for files in it
        os.chdir(origin.folder)


def _work(origin: _Origin, call: bytes) -> bytes:
    # Pickled here and not by Ray: versions are compared before anything of theirs is read, and arrays come as they
    # do from a process, not as read-only views of Ray's memory.
    _become_worker_of(origin)
    function, args, kwargs = pickle.loads(call)
    return pickle.dumps(function(*args, **kwargs), pickle.HIGHEST_PROTOCOL)


# ---- here ------------------------------------------------------------------------------------------------------


class RayPool(Executor):
    """Processes of a Ray cluster, as an executor: for so many items at a time; None: all are Ray's to schedule."""

    def __init__(self, most: int | None) -> None:
        import ray

        self._ray, self._most = ray, most or sys.maxsize
        self._task = ray.remote(_work).options(num_cpus=1, max_retries=RETRIES)
        self._origin = _Origin.here()
        self._events: queue.SimpleQueue[tuple[Future[Any], bytes] | None] = queue.SimpleQueue()
        self._running: set[Any] = set()
        self._ended = self._stopped = False
        self._thread = threading.Thread(target=self._hand_out, daemon=True)
        self._thread.start()

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        """Have a worker call ``fn``; what it needs and returns has to be picklable."""
        future: Future[Result] = Future()
        self._events.put((future, pickle.dumps((fn, args, kwargs), pickle.HIGHEST_PROTOCOL)))
        return future

    def _hand_out(self) -> None:
        """Give Ray what there is to do, never more at a time than was asked for."""
        waiting: deque[tuple[Future[Any], bytes]] = deque()
        while not self._stopped and (waiting or self._running or not self._ended):
            event = self._events.get()  # None: an item is done, or all shall end
            if event is not None:
                waiting.append(event)
            while waiting and len(self._running) < self._most and not self._stopped:
                future, call = waiting.popleft()
                if future.set_running_or_notify_cancel():
                    reference = self._task.remote(self._origin, call)
                    self._running.add(reference)
                    reference.future().add_done_callback(functools.partial(self._finish, future, reference))

    def _finish(self, future: Future[Any], reference: Any, done: Future[bytes]) -> None:
        self._running.discard(reference)
        try:
            future.set_result(pickle.loads(done.result()))
        except self._ray.exceptions.RayTaskError as error:  # what the item itself raised
            error.cause.__cause__ = error  # with the traceback there
            future.set_exception(error.cause)
        except self._ray.exceptions.RayError as error:
            said = f"{type(error).__name__}: {one_line(error)}"
            future.set_exception(RuntimeError(f"an item was begun {RETRIES + 1} times and never ended ({said})"))
        except Exception as error:
            future.set_exception(error)
        self._events.put(None)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End, once all is done; with ``cancel_futures`` stop what runs, too."""
        self._ended, self._stopped = True, cancel_futures
        self._events.put(None)
        if wait or cancel_futures:
            self._thread.join()  # whoever hands work to a Ray that is gone starts another
        if cancel_futures:
            for reference in list(self._running):
                self._ray.cancel(reference, force=True)

    @contextmanager
    def channel(self) -> Iterator[queue.Queue[Any]]:
        """Give a queue that work may be handed, to say something before it is done."""
        from ray.util.queue import Queue
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        # On the node that this process is on: any other may die.
        here = self._ray.get_runtime_context().get_node_id()
        where = NodeAffinitySchedulingStrategy(here, soft=False)
        said: Any = Queue(actor_options={"num_cpus": 0, "scheduling_strategy": where})
        try:
            yield said
        finally:
            said.shutdown()


@contextmanager
def ray_pool(cluster: Cluster) -> Iterator[RayPool]:
    """Give the processes of a cluster; what they do is stopped where Ctrl-C ends the block.

    Raises
    ------
    BadInput
        Where Ray cannot be started, or does not let this process in.
    """
    with _connected(cluster):
        pool = RayPool(cluster.most)
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()


@contextmanager
def _connected(cluster: Cluster) -> Iterator[None]:
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # nothing is told to anybody
    import ray

    settings = {}
    if cluster.address == LOCAL:
        settings = {"num_cpus": cluster.most or os.cpu_count(), "include_dashboard": False}
    before = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(
            cluster.address, runtime_env={"env_vars": ONE_THREAD}, log_to_driver=False, logging_level="ERROR",
            **settings,
        )  # fmt: skip
    except SystemExit:  # SIGTERM, which Ray has taken for itself already
        signal.signal(signal.SIGTERM, before)
        signal.raise_signal(signal.SIGTERM)
        raise
    except Exception as error:
        raise BadInput(
            f"--ray {cluster.address}: cannot use it ({one_line(error)[:300]}); it needs a node on this machine "
            "(ray start), and the same Python and Ray on every node"
        ) from error
    finally:
        # Ray takes SIGTERM for itself, and would end with what is not stored yet.
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)
    try:
        nodes = [node for node in ray.nodes() if node["Alive"]]
        cores = sum(node["Resources"].get("CPU", 0) for node in nodes)
        print(f"Ray, {cluster.address}: nodes {len(nodes)}, cores {cores:g}", file=sys.stderr, flush=True)
        yield
    finally:
        ray.shutdown()
