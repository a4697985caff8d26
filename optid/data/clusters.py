"""Dask clusters: connect to a scheduler, compare the versions of its workers, and explain lost tasks."""

import json
import re
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from optid.errors import ClusterError

REACH = 3.0  # seconds to connect to the machine of a scheduler
ANSWER = 10.0  # seconds until a busy scheduler answers
LOOKS = 3  # comparisons of versions before a difference counts: source files may be edited meanwhile

NO_SCHEDULER = (
    "what answers at {} is no Dask scheduler, or one of another version. Is this the port of the scheduler (8786 by "
    "default), not of its dashboard (8787)?"
)

PACKAGES = ("optid", "numpy", "scipy", "numba")
"""Packages that must be equal on workers and here: their objects are exchanged, and digits must agree."""

SOURCES = ("optid", "formulations")
"""Packages also compared by their source files: an editable installation keeps its version number."""


@contextmanager
def connect_cluster(scheduler: Any) -> Iterator[Any]:
    """Give a `distributed.Client` whose workers run the same versions as this process.

    The scheduler is an address ("tcp://host:8786", "host:8786"), the path of a scheduler file (.json), or an open
    Client, which stays open; for a cluster with certificates open the Client yourself. `ClusterError`: Dask is not
    installed, no scheduler at the address, no worker, or workers with other versions.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ClusterError('a scheduler needs dask and distributed: pip install "optid[distributed]"') from None
    if isinstance(scheduler, Client):
        if scheduler.asynchronous:
            raise ClusterError("an asynchronous Client cannot be used here: open Client(address).")
        if scheduler.status != "running":
            raise ClusterError(f"the Client is {scheduler.status}, not running: open it again.")
        opened = nullcontext(scheduler)
    else:
        opened = _opened(Client, scheduler)
    with opened as client:
        check_workers(client)
        yield client


def _opened(client: Callable[..., Any], scheduler: Any) -> Any:
    if not isinstance(scheduler, str) and not hasattr(scheduler, "__fspath__"):
        raise ClusterError(f"scheduler={scheduler!r}: give an address such as 'tcp://host:8786', the path of a "
                           "scheduler file, or a distributed.Client.")
    text = str(scheduler)
    if text.endswith(".json"):
        try:
            text = json.loads(Path(text).read_text())["address"]
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise ClusterError(f"{text!r} is not the scheduler file of a running scheduler "
                               f"({type(error).__name__}: {error}).") from error
    address = _reached(text)
    try:
        return client(address, timeout=ANSWER, set_as_default=False)
    except Exception as error:  # whatever the handshake with something else than a scheduler comes to
        raise ClusterError(f"{NO_SCHEDULER.format(text)} ({type(error).__name__})") from error


def _reached(text: str) -> str:
    """Return the complete address of a scheduler that accepts connections."""
    address = text if "://" in text else f"tcp://{text}"
    try:
        parts = urlsplit(address)
        kind, host, port = parts.scheme, parts.hostname, parts.port
    except ValueError:
        kind = host = port = None
    if not kind or not host or not port or not re.fullmatch(r"tcp|tls|ws|wss|ucxx?", kind):
        raise ClusterError(f"{text!r} is not the address of a scheduler: write tcp://host:8786.")
    try:
        with socket.create_connection((host, port), timeout=REACH) as connection:
            if kind == "tcp" and not _greets(connection):
                raise ClusterError(NO_SCHEDULER.format(address))
    except OSError as error:
        why = error.strerror or ("no answer" if isinstance(error, TimeoutError) else str(error))
        raise ClusterError(f"no scheduler can be reached at {address} ({why}). Is it running (dask scheduler), and is "
                           "the port open from here?") from error
    return address


def _greets(connection: socket.socket) -> bool:
    """Whether the server speaks the protocol of Dask: it starts with the length of a short message.

    A Client would wait without limit for most other servers.
    """
    connection.settimeout(ANSWER)
    try:
        greeting = connection.recv(8, socket.MSG_WAITALL)
    except TimeoutError:
        return False
    return len(greeting) == 8 and int.from_bytes(greeting, "little") < 1 << 20


def _reader(packages: Sequence[str]) -> Callable[[], dict[str, str]]:
    """Return a function that reads the versions of a process, with a digest of the source files."""
    names, sources = tuple(packages), SOURCES

    def read() -> dict[str, str]:  # nested: it travels by value, and so runs where optid is not installed
        import hashlib
        import sys
        from importlib.metadata import PackageNotFoundError, version
        from importlib.util import find_spec
        from pathlib import Path

        found = {"python": "{}.{}".format(*sys.version_info)}
        for name in names:
            try:
                found[name] = version(name)
            except PackageNotFoundError:
                found[name] = "not installed"
        for name in sources:
            spec = find_spec(name)
            if spec is None or spec.origin is None:
                found[f"source files of {name}"] = "none"
                continue
            digest, folder = hashlib.sha256(), Path(spec.origin).parent
            for path in sorted(folder.rglob("*.py")):
                digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
            found[f"source files of {name}"] = digest.hexdigest()[:12]
        return found

    return read


def check_workers(client: Any, packages: Sequence[str] = PACKAGES) -> None:
    """Raise a `ClusterError` if there are no workers, or workers with other versions."""
    reader, refusal = _reader(packages), ""
    for _ in range(LOOKS):
        here, there = reader(), client.run(reader, on_error="return")
        if not there:
            address = client.scheduler.address
            raise ClusterError(f"the scheduler at {address} has no worker yet: start some (dask worker {address}).")
        other = next((worker for worker, versions in there.items() if versions != here), None)
        if other is None:
            return
        if isinstance(there[other], BaseException):
            refusal = f"cannot say which versions it has: {type(there[other]).__name__}: {there[other]}"
        else:
            differing = ", ".join(f"{name}: {version} here, {there[other].get(name, 'not installed')} there"
                                  for name, version in here.items() if there[other].get(name) != version)
            refusal = f"has other packages: {differing}. Install the same versions there."
            if len(there) > 1:
                same = sum(versions == there[other] for versions in there.values())
                refusal = f"({same} of {len(there)} workers) {refusal}"
        refusal = f"worker {other} {refusal}"
    raise ClusterError(refusal)


def result_of(client: Any, task: Any) -> Any:
    """Return the result of a delayed task; `ClusterError` for dead workers or a lost scheduler, else its own error."""
    from distributed import CancelledError, KilledWorker
    from distributed.comm.core import CommClosedError

    try:
        future = client.compute(task)
        try:
            return future.result()
        finally:
            future.release()
    except KilledWorker as error:
        count = error.allowed_failures + 1
        raise ClusterError(f"{count} worker{'s' * (count > 1)} died over the same task, the last at "
                           f"{error.last_worker.address}. Most often memory ran out: give workers more, or open the "
                           "record with a smaller chunk or smaller partitions.") from error
    except (CancelledError, CommClosedError) as error:
        raise ClusterError(f"the scheduler went away while it was waited for ({type(error).__name__}: "
                           f"{error}).") from error
