"""Rows from a Dask cluster of real processes, one of which is killed at work, equal the rows of this process."""

import os
import signal
import threading
import time
from os import kill
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haptether.bridge import controller_time, register_controller, sweep_to_file
from haptether.bridge.scene.load import loaded
from haptether.bridge.scene.research import count_controller_time
from haptether.bridge.scene.sweep import SweepSettings
from haptether.bridge.scene.sweeps import cluster

GRID: dict[str, list[Any]] = {"link.forward.delay_s": [0.01, 0.02], "safety.controllers": [["wsc"], []]}
SAMPLES = {"run.seed": np.arange(1.0, 201.0)}
SHORT = ["run.duration_s=0.3"]


@pytest.fixture
def local(tmp_path: Path) -> bytes:
    """Return the file written without a cluster."""
    path = tmp_path / "local.csv"
    sweep_to_file("remote_push", path, GRID, SAMPLES, overrides=SHORT, threads=1)
    return path.read_bytes()


@pytest.mark.timeout(120)
def test_a_cluster_that_loses_a_worker_writes_the_same_bytes(
    local: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "BATCH", 50)
    path, killed = tmp_path / "cluster.csv", threading.Event()
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as workers:

        def lose_one(done: int) -> None:
            if done and not killed.is_set():
                killed.set()
                kill(workers.workers[0].process.process.pid, signal.SIGKILL)

        stored = sweep_to_file(
            "remote_push", path, GRID, SAMPLES, overrides=SHORT, engine="dask", address=workers.scheduler_address,
            threads=1, progress=lose_one,
        )  # fmt: skip
    assert killed.is_set()
    assert stored.rows == 800
    assert path.read_bytes() == local


@pytest.mark.timeout(120)
def test_without_an_address_workers_are_processes_of_this_machine(local: bytes, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    path = tmp_path / "own.csv"
    sweep_to_file("remote_push", path, GRID, SAMPLES, overrides=SHORT, engine="dask", threads=2)
    assert path.read_bytes() == local
    here, there, asked = tmp_path / "here.csv", tmp_path / "there.csv", ["peak_device_force"]
    sweep_to_file("remote_push", here, GRID, SAMPLES, overrides=SHORT, threads=2, metrics=asked)
    sweep_to_file("remote_push", there, GRID, SAMPLES, overrides=SHORT, engine="dask", threads=2, metrics=asked)
    assert here.read_bytes() == there.read_bytes() != local


class Idle:
    """A controller in Python that never intervenes."""

    def step(self, tick: object) -> None:
        """Do nothing."""


def test_a_batch_reports_the_time_of_its_own_controllers_only() -> None:
    register_controller("idle-here", Idle)
    base = loaded("paper_wall", ["run.duration_s=0.2", "safety.research.controller=idle-here"])
    # Count earlier work of the same process.
    count_controller_time(1_000_000, 1e3)
    columns = {"run.seed": np.array([1.0, 2.0])}
    first, metrics, taken = cluster._batch(base, 4, columns, SweepSettings(threads=1))
    assert first == 4
    assert taken.ticks == metrics["ticks"].sum() > 0
    assert 0.0 < taken.seconds < 1e3
    _, _, again = cluster._batch(base, 4, columns, SweepSettings(threads=1))
    assert again.ticks == taken.ticks


@pytest.mark.timeout(120)
def test_what_controllers_in_python_take_on_workers_is_counted_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    package = tmp_path / "installed"
    (package / "idle-0.1.dist-info").mkdir(parents=True)
    (package / "idle_controller.py").write_text("class Idle:\n    def step(self, tick):\n        return None\n")
    (package / "idle-0.1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: idle\nVersion: 0.1\n")
    (package / "idle-0.1.dist-info" / "entry_points.txt").write_text(
        "[haptether.controllers]\nidle = idle_controller:Idle\n"
    )
    monkeypatch.syspath_prepend(str(package))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(package), *filter(None, [os.environ.get("PYTHONPATH")])]))
    monkeypatch.setattr(cluster, "BATCH", 2)
    before = controller_time()
    stored = sweep_to_file(
        "paper_wall", tmp_path / "rows.csv", samples={"run.seed": np.arange(1.0, 7.0)}, engine="dask", threads=2,
        overrides=["run.duration_s=0.2", "safety.research.controller=idle"], collect=True,
    )  # fmt: skip
    assert stored.whole is not None
    after = controller_time()
    assert after.ticks - before.ticks == sum(stored.whole["ticks"].tolist()) > 0
    assert after.seconds > before.seconds


def test_a_scheduler_that_does_not_answer_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "ANSWER_S", "1 s")
    begun_s = time.monotonic()
    with pytest.raises(OSError, match=r"tcp://127\.0\.0\.1:9"):
        sweep_to_file(
            "remote_push", tmp_path / "a.csv", GRID, SAMPLES, overrides=SHORT, engine="dask",
            address="tcp://127.0.0.1:9",
        )  # fmt: skip
    assert time.monotonic() - begun_s < 30.0


@pytest.mark.parametrize(("engine", "address"), [("ray", None), ("local", "tcp://127.0.0.1:1")])
def test_an_engine_that_there_is_not_is_refused(engine: str, address: str | None, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"engine = '{engine}'"):
        # mypy refuses these arguments; a caller without it may pass them.
        sweep_to_file("remote_push", tmp_path / "a.csv", GRID, SAMPLES, engine=engine, address=address)  # type: ignore[arg-type]
