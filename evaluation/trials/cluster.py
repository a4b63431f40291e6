"""Work on the workers of a Dask cluster, of this machine or of many.

Only names and values are sent, never code: a worker imports the same function that a local process would. A worker gets no work
before a check of its environment has passed. A worker that is lost loses nothing, because its task runs again on another one.
"""

import contextlib
import logging
import re
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pkgutil import resolve_name
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeVar

from sextant.shared.errors import SextantError

_LOCAL = re.compile(r"local:([1-9]\d{0,2})")
_REMOTE = re.compile(r"(tcp|tls|ucx|wss?)://\S+:\d{1,5}")
_MOST_LOSSES = 3  # workers that may be lost with one task, which is then given up
_CONNECT_S = 15.0  # [s] for which a scheduler may take to answer
_IMPORT, _CHECK = -1, -2  # in place of a task
_LOOK_S = 5.0  # [s] between two checks that the scheduler is still there
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

Result = TypeVar("Result")


class ClusterError(SextantError):
    """A cluster cannot be reached, or does not finish its work."""

    exit_status = 1


@dataclass(frozen=True, slots=True)
class Cluster:
    """A Dask cluster to share work out to."""

    client: Any  # distributed.Client
    local: bool  # whether its workers are processes of this machine, in this folder
    say: Callable[[str], None]  # receives a line for each worker that is refused or lost

    @property
    def size(self) -> int:
        """Number of workers that are there now."""
        return len(self.client.nthreads())

    def share_out(
        self,
        work: Callable[..., Result],
        tasks: Sequence[tuple[Any, ...]],
        check: Callable[..., str],
        of_check: tuple[Any, ...],
        names: Sequence[str],
    ) -> Iterator[Result]:
        """Yield the result of each task as soon as it is available.

        A worker runs one task at a time. When a task fails or the caller stops, running tasks end by themselves, unseen.

        Args:
            work: A function of a module, called with the arguments of a task.
            tasks: Arguments, a tuple per call.
            check: A function of a module that each worker calls first. It returns why the worker gets no work, or "".
            of_check: Arguments of the check, of built-in types, which every worker can receive.
            names: Names of the tasks, for messages.

        Raises:
            ClusterError: The scheduler is lost, all workers are refused, or a task has lost too many workers.
        """
        yield from _Dispatch[Result](self.client, self.say, work, tasks, check, of_check, names).results()


def checked_address(address: str) -> str:
    """Return the address of a cluster.

    Raises:
        ValueError: It is neither `local:N` nor the address of a scheduler.
    """
    if not (_LOCAL.fullmatch(address) or _REMOTE.fullmatch(address)):
        raise ValueError(f"local:N or a scheduler's address such as tcp://10.0.0.1:8786 expected, found {address!r}")
    return address


@contextlib.contextmanager
def open_cluster(address: str, say: Callable[[str], None]) -> Iterator[Cluster]:
    """Connect to a scheduler, or start one with workers on this machine.

    Args:
        address: Address of a scheduler, such as `tcp://10.0.0.1:8786`; or `local:N` for N processes of this machine.
        say: Receives a line for each worker that is refused or lost.

    Raises:
        ClusterError: There is no scheduler at the address.
        ValueError: It is no address.
    """
    local = _LOCAL.fullmatch(checked_address(address))
    from distributed import Client, LocalCluster

    with contextlib.ExitStack() as stack:
        stack.enter_context(_quiet())
        if local is not None:
            place: Any = stack.enter_context(
                LocalCluster(
                    n_workers=int(local[1]),
                    threads_per_worker=1,
                    host="127.0.0.1",
                    security=True,  # certificates of this cluster alone, so that other users of this machine do not get in
                    dashboard_address="127.0.0.1:0",
                    memory_limit=0,  # as for other processes
                    silence_logs=logging.CRITICAL,
                    env=_ONE_THREAD,
                )
            )
        try:
            client = stack.enter_context(Client(place if local else address, timeout=_CONNECT_S, set_as_default=False))
        except OSError as error:
            words = f"a Dask scheduler expected at {address}, found none ({error}); start `dask scheduler`, then `dask worker`"
            raise ClusterError(words) from None
        yield Cluster(client, local is not None, say)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the log of Dask while entered, because the dispatch reports lost workers."""
    log = logging.getLogger("distributed")
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(before)


@dataclass(frozen=True, slots=True)
class _Event:
    """A worker has joined or left, or something that was submitted has ended."""

    kind: str  # add-worker, remove-worker or done
    worker: str
    future: Any = None
    result: Any = None
    error: BaseException | None = None


@dataclass(slots=True)
class _Dispatch(Generic[Result]):
    """One call of `Cluster.share_out`: which worker runs which task."""

    client: Any
    say: Callable[[str], None]
    work: Callable[..., Result]
    tasks: Sequence[tuple[Any, ...]]
    check: Callable[..., str]
    of_check: tuple[Any, ...]
    names: Sequence[str]
    events: "SimpleQueue[_Event]" = field(default_factory=SimpleQueue)
    todo: deque[int] = field(default_factory=deque)  # indices of tasks
    running: dict[str, tuple[Any, int]] = field(default_factory=dict)  # worker -> future, and task or _IMPORT or _CHECK
    free: list[str] = field(default_factory=list)  # workers whose check has passed, and that have no task
    any_passed: bool = False  # whether the check of any worker has passed
    refused: dict[str, str] = field(default_factory=dict)  # worker -> reason
    losses: dict[int, list[str]] = field(default_factory=dict)  # task -> workers that were lost with it

    def results(self) -> Iterator[Result]:
        """Yield the results as they come."""
        from distributed import KilledWorker

        self.todo.extend(range(len(self.tasks)))
        self.client.subscribe_topic("all", self._hear)
        try:
            for worker in self.client.nthreads():
                self._join(worker)
            if not self.running and self.todo:
                self.say("the cluster has no worker yet; waiting for one")
            while self.todo or any(task >= 0 for _, task in self.running.values()):
                self._expect_workers()
                event = self._next_event()
                if event.kind == "add-worker":
                    self._join(event.worker)
                elif event.kind == "remove-worker":
                    self._leave(event.worker)
                elif event.worker in self.running and self.running[event.worker][0] is event.future:
                    if isinstance(event.error, KilledWorker):
                        self._leave(event.worker)
                    elif self.running[event.worker][1] < 0:
                        self._checked(event)
                    else:
                        yield self._finished(event)
                while self.todo and self.free:
                    self._submit(self.free.pop(), self.todo.popleft())
        finally:
            if self.client.status == "running":
                self.client.unsubscribe_topic("all")
                self.client.cancel([future for future, _ in self.running.values()])
        self._expect_all_done()

    def _hear(self, event: Any) -> None:
        """Queue a message of the scheduler; called in another thread."""
        message = event[1]
        if isinstance(message, dict) and message.get("action") in ("add-worker", "remove-worker"):
            self.events.put(_Event(message["action"], message["worker"]))

    def _next_event(self) -> _Event:
        while True:
            with contextlib.suppress(Empty):
                return self.events.get(timeout=_LOOK_S)
            self._expect_scheduler()

    def _join(self, worker: str) -> None:
        """Let a worker import the check by its name: a worker that receives a function that it lacks ends itself."""
        if worker not in self.running and worker not in self.refused and worker not in self.free:
            self._start(worker, _IMPORT, resolve_name, (f"{self.check.__module__}:{self.check.__qualname__}",))

    def _submit(self, worker: str, task: int) -> None:
        self._start(worker, task, self.work, self.tasks[task])

    def _start(self, worker: str, task: int, work: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        self._expect_scheduler()
        future = self.client.submit(work, *arguments, workers=[worker], allow_other_workers=False, pure=False)
        self.running[worker] = future, task

        def end(future: Any) -> None:  # in another thread
            try:
                self.events.put(_Event("done", worker, future, future.result()))
            except BaseException as error:  # noqa: BLE001 - the work may raise anything
                self.events.put(_Event("done", worker, future, error=error))

        future.add_done_callback(end)

    def _checked(self, event: _Event) -> None:
        """Let a worker check its environment, or work, or refuse it."""
        _, stage = self.running.pop(event.worker)
        self._expect_scheduler(event.error)
        reason = f"{type(event.error).__name__}: {event.error}" if event.error else ""
        if stage == _IMPORT and not reason:
            self._start(event.worker, _CHECK, self.check, self.of_check)
            return
        reason = reason or str(event.result)
        if reason:
            self.refused[event.worker] = reason
            self.say(f"worker {event.worker} is refused: {reason}")
        else:
            self.any_passed = True
            self.free.append(event.worker)

    def _finished(self, event: _Event) -> Result:
        """Return the result of a task."""
        del self.running[event.worker]
        self._expect_scheduler(event.error)
        if event.error is not None:
            raise event.error
        self.free.append(event.worker)
        return event.result  # type: ignore[no-any-return]

    def _leave(self, worker: str) -> None:
        """Run the task of a lost worker again, unless it has lost too many."""
        self.refused.pop(worker, None)
        if worker in self.free:
            self.free.remove(worker)
        if worker not in self.running:
            return
        future, task = self.running.pop(worker)
        future.cancel()
        if task < 0:
            self.say(f"worker {worker} is lost during the check of its environment")
            return
        lost = self.losses.setdefault(task, [])
        lost.append(worker)
        if len(lost) < _MOST_LOSSES:
            self.todo.appendleft(task)
            self.say(f"worker {worker} is lost; its {self.names[task]} runs again")
        else:
            self.say(f"worker {worker} is lost; its {self.names[task]} has lost {len(lost)} workers and is given up")

    def _expect_workers(self) -> None:
        """Raise a ClusterError if all workers are refused, also those that have joined since."""
        if self.refused and not self.running and not self.any_passed:
            for worker in self.client.nthreads():
                self._join(worker)
        if self.refused and not self.running and not self.any_passed:
            some = "; ".join(f"{worker}: {reason}" for worker, reason in list(self.refused.items())[:3])
            raise ClusterError(f"a worker with this machine's environment expected, found {len(self.refused)} others: {some}")

    def _expect_scheduler(self, error: BaseException | None = None) -> None:
        """Raise a ClusterError if the scheduler is lost.

        Futures are then cancelled. This dispatch itself cancels only futures that it no longer waits for.
        """
        from distributed import CancelledError

        if self.client.status != "running" or isinstance(error, CancelledError):
            raise ClusterError("the Dask scheduler is lost; results so far are stored, and the same command goes on")

    def _expect_all_done(self) -> None:
        """Raise a ClusterError if tasks were given up."""
        given_up = [task for task, lost in self.losses.items() if len(lost) >= _MOST_LOSSES]
        if given_up:
            words = "; ".join(f"{self.names[task]} with {', '.join(self.losses[task])}" for task in given_up)
            raise ClusterError(f"the workers of these tasks were lost {_MOST_LOSSES} times each: {words}; do they lack memory?")
