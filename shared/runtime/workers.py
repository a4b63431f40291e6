"""Worker processes with one thread each; none outlives its parent process."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from sextant.shared.runtime.operating_system import signal_at_end_of

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

Result = TypeVar("Result")


def share_out(
    work: Callable[..., Result], tasks: Iterable[tuple[Any, ...]], jobs: int, *, in_order: bool = True
) -> Iterator[Result]:
    """Yield the result of each task as soon as it is available.

    When a task fails or the caller stops, running tasks are terminated.

    Args:
        work: A function of a module, called with the arguments of a task.
        tasks: Arguments, a tuple per call.
        jobs: Number of parallel processes; 1 runs the tasks in this process.
        in_order: Yield results in the order of the tasks, else as they finish.
    """
    todo = list(tasks)
    if jobs <= 1 or len(todo) <= 1:
        for task in todo:
            yield work(*task)
        return
    others = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    with (
        _one_thread_each(),
        ProcessPoolExecutor(jobs, mp_context=context, initializer=_prepare, initargs=(os.getpid(),)) as pool,
    ):
        running = [pool.submit(work, *task) for task in todo]
        try:
            for future in running if in_order else as_completed(running):
                yield future.result()
        except BaseException:  # an error, or the caller has stopped
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()
            raise


def in_copy(work: Callable[[], Result]) -> Result:
    """Return the result of work done in a fork of this process.

    The fork has a single thread. The state of this process does not change.

    Raises:
        RuntimeError: The work did not finish; the reason is on stderr.
    """
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    copy = context.Process(target=_answer, args=(os.getpid(), work, theirs))
    copy.start()
    theirs.close()
    with ours:
        try:
            return ours.recv()  # type: ignore[no-any-return]
        except EOFError:
            copy.join()
            words = f"a worker process ended with exit code {copy.exitcode} and without a result; stderr shows the cause"
            raise RuntimeError(words) from None
        finally:
            copy.join()


def _answer(parent: int, work: Callable[[], object], result: Connection) -> None:
    """Do work in a fork, and send its result to the original process."""
    _prepare(parent)
    result.send(work())


def _prepare(parent: int) -> None:
    """Make a worker end silently at Ctrl-C, and with its parent process."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if not signal_at_end_of(parent, signal.SIGKILL):
        os._exit(1)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Limit processes started in the block to one thread each.

    Parallel jobs then do not compete for cores.
    """
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(_ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
