"""Work on many processors or machines, by Ray: each piece in a process that may die, and is then tried again."""

from __future__ import annotations

import os
import socket
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from lodestone.errors import InvalidConfig

T = TypeVar("T")

SECONDS_TO_ANSWER = 10.0


def require_ray() -> Any:
    """The module. Raises `InvalidConfig` where it is not installed."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # or it warns that this will be so
    os.environ.setdefault("RAY_worker_niceness", "0")  # its own choice, 15, starves beside any other work
    try:
        import ray
    except ImportError:
        raise InvalidConfig("A sweep needs Ray: pip install 'lodestone[cluster]'.") from None
    return ray


def require_answer(address: str) -> None:
    """Ask at HOST:PORT before Ray does, which waits for minutes. Raises `InvalidConfig`."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=SECONDS_TO_ANSWER).close()
    except OSError as error:
        raise InvalidConfig(f"No Ray cluster answers at {address}: {error.strerror or error}.") from None
    except (ValueError, OverflowError):
        raise InvalidConfig(f"{address} is no address: it has to be like 192.0.2.1:6379, or auto.") from None


def run_all(
    work: Callable[[T], str | None], pieces: Sequence[T], address: str | None, workers: int | None, retries: int
) -> Iterator[tuple[T, str | None]]:
    """Yields each piece when it is over, with the sentence that `work` returned about it.

    On this machine, `workers` at a time, or on the cluster at `address`. A piece whose process dies is begun again, at
    most `retries` times: `work` has to go on from what it has left on the disk. Raises `InvalidConfig` where no cluster
    answers. Whoever stops asking ends what is running.
    """
    ray = require_ray()
    try:
        with warnings.catch_warnings():  # JAX warns of a fork, which here another program follows at once
            warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called", category=RuntimeWarning)
            ray.init(
                address=address or "local",
                num_cpus=workers,
                include_dashboard=None if address else False,
                log_to_driver=False,
                logging_level="error",
                runtime_env={"env_vars": {"JAX_PLATFORMS": "cpu"}},  # processes that share a GPU run out of its memory
            )
    except (ImportError, ConnectionError, ValueError, RuntimeError) as error:
        first = _lines(error)[0].rstrip(".")
        token = ""
        if address is not None and "RAY_AUTH_MODE" not in os.environ:
            token = " A cluster that asks for Ray's token needs RAY_AUTH_MODE=token."
        raise InvalidConfig(f"Ray cannot be used at {address or 'this machine'}: {first}.{token}") from None
    try:
        start = ray.remote(num_cpus=1, max_retries=retries)(work).remote
        waiting = {start(piece): piece for piece in pieces}
        while waiting:
            (over,), _ = ray.wait(list(waiting))
            piece = waiting.pop(over)
            try:
                sentence = ray.get(over)
            except ray.exceptions.WorkerCrashedError:
                sentence = f"its process died {retries + 1} times."
            except ray.exceptions.RayError as error:
                sentence = _lines(error)[-1]
            yield piece, sentence
    finally:
        ray.shutdown()


def _lines(error: Exception) -> list[str]:
    return str(error).strip().splitlines() or [type(error).__name__]
