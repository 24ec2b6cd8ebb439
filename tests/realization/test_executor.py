"""Executors with forks or Dask workers: ordered results, no loss when a worker dies."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from pytest_twin.errors import TwinError
from pytest_twin.realization.executor import Dask, Executor, Forks

forks = pytest.mark.skipif(sys.platform != "linux", reason="forks are used on Linux only")


def work(item: int, folder: Path, here: int, fatal: int | None = None) -> int:
    """Square an item and write a file per attempt; the item ``fatal`` kills its first worker."""
    first = not list(folder.glob(f"{item}.*"))
    (folder / f"{item}.{os.getpid()}.{time.monotonic_ns()}").touch()
    time.sleep(0.05)
    if item == fatal and first and os.getpid() != here:
        os.kill(os.getpid(), signal.SIGKILL)
    return item * item


def work_with_dying_forks(item: int, folder: Path, here: int) -> int:
    """As :func:`work`, but each fork dies at its second item."""
    mine = [p for p in folder.iterdir() if p.name.split(".")[1] == str(os.getpid())]
    (folder / f"{item}.{os.getpid()}").touch()
    time.sleep(0.05)
    if os.getpid() != here and len(mine) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return item * item


@forks
def test_forks_return_results_in_the_order_of_items(tmp_path: Path) -> None:
    function = partial(work, folder=tmp_path, here=os.getpid())
    assert Forks(3).map(function, range(9)) == [i * i for i in range(9)]
    assert len({p.name.split(".")[1] for p in tmp_path.iterdir()}) > 1


@forks
def test_only_the_last_item_of_a_dying_fork_is_repeated(tmp_path: Path) -> None:
    function = partial(work_with_dying_forks, folder=tmp_path, here=os.getpid())
    assert Forks(2).map(function, range(8)) == [i * i for i in range(8)]
    # The item at which the fork died runs twice; its finished items are kept.
    attempts = [int(p.name.split(".")[0]) for p in tmp_path.iterdir()]
    assert sorted(set(attempts)) == list(range(8))
    assert len(attempts) == 9


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """Address of a Dask scheduler with two worker processes of one thread each."""
    pytest.importorskip("distributed")
    script = (
        "import sys\nfrom distributed import LocalCluster\n"
        "if __name__ == '__main__':\n"
        "    cluster = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)\n"
        "    print(cluster.scheduler_address, flush=True)\n"
        "    sys.stdin.read()\n"
    )
    (tmp_path / "cluster.py").write_text(script)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "cluster.py")],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        env=environment, cwd=tmp_path,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdin is not None
    yield process.stdout.readline().strip()
    process.stdin.close()
    process.wait(timeout=60)
    process.stdout.close()


@pytest.mark.filterwarnings("default")
def test_no_result_is_lost_when_a_dask_worker_is_killed(scheduler: str, tmp_path: Path) -> None:
    folder = tmp_path / "attempts"
    folder.mkdir()
    executor: Executor = Dask(scheduler)
    function = partial(work, folder=folder, here=os.getpid(), fatal=3)
    assert executor.map(function, range(10)) == [i * i for i in range(10)]
    attempts = [p.name.split(".") for p in folder.iterdir()]
    assert len([1 for item, *_ in attempts if item == "3"]) == 2
    assert len({pid for _, pid, _ in attempts}) >= 2


@pytest.mark.filterwarnings("default")
def test_an_unreachable_dask_scheduler_is_reported_with_its_address(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("pytest_twin.realization.executor._CONNECT_SECONDS", 0.2)
    with pytest.raises(TwinError, match=r"no Dask scheduler answers.*tcp://127\.0\.0\.1:1"):
        Dask("tcp://127.0.0.1:1").map(len, ["a"])


def test_without_dask_the_error_names_the_package_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(TwinError, match=r"pip install 'pytest-twin\[dask\]'"):
        Dask("tcp://127.0.0.1:1").map(len, ["a"])
